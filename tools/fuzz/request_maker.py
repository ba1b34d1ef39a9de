"""Requests to the control socket, made from the schema of the request models, whatever requests there are."""

import random
from functools import cache
from typing import Any, NamedTuple

from twostage_servo.api.request_reading import read_request
from twostage_servo.api.requests import OPERATIONS
from twostage_servo.api.schema import schema_of_request
from twostage_servo.axis.settings import AxisSettings

Schema = dict[str, Any]


class NumericField(NamedTuple):
    """A field that takes a number: its request, its name, and whether it takes whole numbers only."""

    op: str
    field: str
    whole: bool


@cache
def request_schemas() -> dict[str, Schema]:
    """Return the JSON schema of each request by its ``op``."""
    return {op: schema_of_request(request) for op, request in OPERATIONS.items()}


@cache
def numeric_fields() -> tuple[NumericField, ...]:
    """Return every field of every request that takes a number."""
    fields = []
    for op, schema in request_schemas().items():
        for name, field in schema["properties"].items():
            if (kind := field.get("type")) in {"number", "integer"}:
                fields.append(NumericField(op, name, kind == "integer"))
    return tuple(fields)


def minimal_request(op: str, **given: Any) -> dict[str, Any]:
    """Return a request with its required fields and those that are given."""
    schema = request_schemas()[op]
    required = {name: _example(schema["properties"][name]) for name in schema.get("required", []) if name != "op"}
    return {"op": op, **required, **given}


def _example(field: Schema) -> Any:
    low, high = field.get("minimum", field.get("exclusiveMinimum", -10)), field.get("maximum", 10)
    kind = field["type"]
    if kind in {"number", "integer"}:
        return max(low, min(high, 1))
    return {"string": "x", "boolean": True, "object": {"x": 1.0}}[kind]


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
                request[name] = self._value(field, settings, name)
        try:
            read_request(request)
        except ValueError:  # such as neither of two, or both
            return self.of(op, settings)
        return request

    def _value(self, field: Schema, settings: AxisSettings, name: str) -> Any:
        rng = self._rng
        kind = field["type"]
        if kind == "boolean":
            return rng.random() < 0.5
        if kind == "integer":
            low = field["minimum"]
            return rng.randint(low, min(field["maximum"], low + rng.choice((5, 10_000))))
        if kind == "number" and field["unit"] == "%":
            return rng.choice((0.0, 100.0, rng.uniform(field["minimum"], field["maximum"])))
        if kind == "number":
            limits = settings.limits
            largest = limits.velocity if "velocity" in name else limits.position_maximum
            value: float = rng.uniform(-largest, largest) * rng.choice((0.001, 0.1, 1.0, 1.0, 1.05, 1e3))
            positive = "exclusiveMinimum" in field
            return abs(value) + 1e-9 if positive else value
        return {"string": "x", "object": {"x": rng.uniform(-10.0, 10.0)}}[kind]
