"""Requests to the control socket, made from the schema of the request models, whatever requests there are."""

import random
from functools import cache
from typing import Any, NamedTuple

from twostage_servo.api.requests import REQUESTS
from twostage_servo.axis.settings import AxisSettings

Schema = dict[str, Any]


class NumericField(NamedTuple):
    """A field that takes a number: its request, its name, and whether it takes whole numbers only."""

    op: str
    field: str
    whole: bool


@cache
def request_schemas() -> dict[str, Schema]:
    """Return the JSON schema of each request by its ``op``; references are resolved."""
    schema = REQUESTS.json_schema()
    definitions = schema.get("$defs", {})
    schemas = {}
    for option in schema["oneOf"]:
        resolved = _resolve(option, definitions)
        properties = resolved["properties"]
        schemas[properties["op"]["const"]] = resolved
    return schemas


@cache
def numeric_fields() -> tuple[NumericField, ...]:
    """Return every field of every request that takes a number."""
    fields = []
    for op, schema in request_schemas().items():
        for name, field in schema["properties"].items():
            types = {option.get("type") for option in _options(field)}
            if types & {"number", "integer"}:
                fields.append(NumericField(op, name, "number" not in types))
    return tuple(fields)


def minimal_request(op: str, **given: Any) -> dict[str, Any]:
    """Return a request with its required fields and those that are given."""
    schema = request_schemas()[op]
    required = {name: _example(schema["properties"][name]) for name in schema.get("required", []) if name != "op"}
    return {"op": op, **required, **given}


def _resolve(schema: Any, definitions: Schema) -> Any:
    if isinstance(schema, dict):
        if "$ref" in schema:
            return _resolve(definitions[schema["$ref"].rpartition("/")[2]], definitions)
        return {key: _resolve(value, definitions) for key, value in schema.items()}
    if isinstance(schema, list):
        return [_resolve(value, definitions) for value in schema]
    return schema


def _options(field: Schema) -> list[Schema]:
    options = field.get("anyOf") or field.get("oneOf")
    return [field] if options is None else list(options)


def _example(field: Schema) -> Any:
    option = _options(field)[0]
    if "const" in option or "enum" in option:
        return option.get("const", (option.get("enum") or [None])[0])
    low, high = option.get("minimum", option.get("exclusiveMinimum", -10)), option.get("maximum", 10)
    kind = option.get("type")
    if kind in {"number", "integer"}:
        return max(low, min(high, 1))
    return {"string": "x", "boolean": True, "array": [], "object": {}}.get(str(kind))


class RequestMaker:
    """Makes requests that the models accept, or nearly.

    Parameters
    ----------
    rng
        Decides.
    """

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._schemas = request_schemas()
        self._ops = list(self._schemas)
        self._motions = [field.op for field in numeric_fields() if field.op != "watch"]

    def sensible(self, settings: AxisSettings) -> dict[str, Any]:
        """Return a request of any kind that the models accept, most often within the limits of an axis."""
        return self.of(self._rng.choice(self._ops), settings)

    def motion(self, settings: AxisSettings) -> dict[str, Any]:
        """Return one that sets an axis in motion."""
        return self.of(self._rng.choice(self._motions), settings)

    def of(self, op: str, settings: AxisSettings) -> dict[str, Any]:
        """Return one of this kind."""
        rng = self._rng
        schema = self._schemas[op]
        request: dict[str, Any] = {"op": op}
        for name, field in schema["properties"].items():
            if name != "op" and (name in schema.get("required", ()) or rng.random() < 0.6):
                value = self._value(field, settings, name)
                if value is not None:
                    request[name] = value
        try:
            REQUESTS.validate_python(request)
        except ValueError:  # such as neither of two, or both
            return self.of(op, settings)
        return request

    def _value(self, field: Schema, settings: AxisSettings, name: str) -> Any:
        rng = self._rng
        option = rng.choice(_options(field))
        if "const" in option or "enum" in option:
            return option.get("const", rng.choice(option.get("enum") or [None]))
        kind = option.get("type")
        if kind == "boolean":
            return rng.random() < 0.5
        if kind == "integer":
            low = option.get("minimum", 0)
            return rng.randint(low, min(option.get("maximum", 1000), low + rng.choice((5, 10_000))))
        if kind == "number":
            limits = settings.limits
            largest = limits.velocity if "velocity" in name else limits.position_maximum
            value: float = rng.uniform(-largest, largest) * rng.choice((0.001, 0.1, 1.0, 1.0, 1.05, 1e3))
            positive = "exclusiveMinimum" in option or option.get("minimum", -1.0) >= 0.0
            return abs(value) + 1e-9 if positive else value
        return {"string": "x", "array": [], "object": {}}.get(str(kind))
