"""The JSON schema of what crosses the control socket, made from the requests and the status themselves."""

import enum
import types
import typing
from typing import Any, Final

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.records import JsonRecord
from twostage_servo.api.requests import OPERATIONS, Request
from twostage_servo.api.status import AxisReport, ServiceStatus

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
_PLAIN: Final = {bool: "boolean", int: "integer", float: "number", str: "string"}


def schema_of_request(request: type[Request]) -> JsonObject:
    """Return the schema of one request; what its fields must not say together is told in its description."""
    properties = {name: kind.schema() for name, kind in request.kinds.items()}
    return {
        "title": request.op,
        "description": _text(request),
        "type": "object",
        "properties": {"op": {"const": request.op}, **properties},
        "required": ["op", *request.required_names],
        "additionalProperties": False,
    }


def schema_of_requests() -> JsonObject:
    """Return the schema of all requests: each line is exactly one of them."""
    return {"$schema": DIALECT, "oneOf": [schema_of_request(request) for request in OPERATIONS.values()]}


def schema_of_status() -> JsonObject:
    """Return the schema of what `status` answers, and of each snapshot: of one axis, or of several."""
    definitions: JsonObject = {}
    common, axis = (_schema_of(kind, definitions) for kind in (ServiceStatus, AxisReport))
    several = {
        "type": "object",
        "properties": {"axes": {"type": "object", "additionalProperties": axis}},
        "required": ["axes"],
    }
    return {"$schema": DIALECT, "allOf": [common], "oneOf": [axis, several], "$defs": definitions}


def _schema_of(hint: Any, definitions: JsonObject) -> JsonObject:
    """Return the schema of a type; that of a record goes among the definitions."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in {types.UnionType, typing.Union}:
        return {"anyOf": [_schema_of(one, definitions) for one in arguments]}
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema_of(arguments[1], definitions)}
    if origin is not None:  # a list or a tuple
        return {"type": "array", "items": _schema_of(arguments[0], definitions)}
    return {"type": "null"} if hint is types.NoneType else _schema_of_one(hint, definitions)


def _schema_of_one(kind: type[Any], definitions: JsonObject) -> JsonObject:
    if kind in _PLAIN:
        return {"type": _PLAIN[kind]}
    if kind.__name__ not in definitions:
        definitions[kind.__name__] = (
            {"enum": [one.value for one in kind]}
            if issubclass(kind, enum.Enum)
            else _schema_of_record(kind, definitions)
        )
    return {"$ref": f"#/$defs/{kind.__name__}"}


def _schema_of_record(record: type[JsonRecord], definitions: JsonObject) -> JsonObject:
    hints, names = record.__annotations__, list(record.field_names)
    return {
        "description": _text(record),
        "type": "object",
        "properties": {name: _schema_of(hints[name], definitions) for name in names},
        "required": names,
    }


def _text(described: type[Any]) -> str:
    """Return what a docstring says before its sections."""
    return " ".join((described.__doc__ or "").partition("Attributes")[0].split())
