"""The JSON schema of what crosses the control socket, made from the requests themselves."""

from typing import Final

from twostage_servo.api.fields import JsonObject, kinds_of, required_of
from twostage_servo.api.requests import OPERATIONS, Request

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"


def schema_of_request(request: type[Request]) -> JsonObject:
    """Return the schema of one request; what its fields must not say together is told in its description."""
    properties = {name: kind.schema() for name, kind in kinds_of(request).items()}
    return {
        "title": request.op,
        "description": (request.__doc__ or "").strip(),
        "type": "object",
        "properties": {"op": {"const": request.op}, **properties},
        "required": ["op", *required_of(request)],
        "additionalProperties": False,
    }


def schema_of_requests() -> JsonObject:
    """Return the schema of all requests: each line is exactly one of them."""
    return {"$schema": DIALECT, "oneOf": [schema_of_request(request) for request in OPERATIONS.values()]}
