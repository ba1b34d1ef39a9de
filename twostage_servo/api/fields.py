"""What a field of a request may hold: its kind, its bounds, its unit, and what is said of a value that does not fit."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

from twostage_servo.api.plain import Plain

JsonObject = dict[str, Any]
"""An object of JSON, as the standard library reads and writes it."""

_LONGEST_WORD: Final = 40
"""Characters of what a client has sent that an answer repeats."""


class Kind(Protocol):
    """A kind of value."""

    @property
    def description(self) -> str:
        """One line about what the field says."""

    def problems(self, name: str, value: object) -> Sequence[str]:
        """Return what is wrong with a value of the field of this name; as a rule nothing."""

    def validated(self, value: Any) -> Any:
        """Return a value without problems in the type that the program uses."""

    def schema(self) -> JsonObject:
        """Return the JSON schema of the field."""


class Text(Plain):
    """Characters, up to a number of them."""

    description: str
    longest: int

    def problems(self, name: str, value: object) -> Sequence[str]:
        """Return what is wrong with a value."""
        if not isinstance(value, str):
            return [f"{name}: should be a string"]
        if len(value) > self.longest:
            return [f"{name}: should have at most {self.longest} characters, and has {len(value)}"]
        return ()

    def validated(self, value: str) -> str:
        """Return the value."""
        return value

    def schema(self) -> JsonObject:
        """Return the JSON schema."""
        return {"type": "string", "maxLength": self.longest, "description": self.description}


class Flag(Plain):
    """True or false."""

    description: str

    def problems(self, name: str, value: object) -> Sequence[str]:
        """Return what is wrong with a value."""
        return () if isinstance(value, bool) else [f"{name}: should be true or false"]

    def validated(self, value: bool) -> bool:
        """Return the value."""
        return value

    def schema(self) -> JsonObject:
        """Return the JSON schema."""
        return {"type": "boolean", "description": self.description}


class Number(Plain):
    """A finite number with a unit and bounds.

    Attributes
    ----------
    minimum, maximum
        Bounds, which belong to what is possible.
    above
        A bound that does not; None: there is none.
    whole
        Whether it has no fraction.
    """

    description: str
    unit: str
    maximum: float
    minimum: float | None = None
    above: float | None = None
    whole: bool = False

    def problems(self, name: str, value: object) -> Sequence[str]:
        """Return what is wrong with a value."""
        if isinstance(value, bool) or not isinstance(value, int if self.whole else int | float):
            said = f"a valid {'whole number' if self.whole else 'number'}"
        elif isinstance(value, float) and not math.isfinite(value):
            said = "a finite number"
        elif self.minimum is not None and value < self.minimum:
            said = f"greater than or equal to {_in_short(self.minimum)}"
        elif self.above is not None and value <= self.above:
            said = f"greater than {_in_short(self.above)}"
        elif value > self.maximum:
            said = f"less than or equal to {_in_short(self.maximum)}"
        else:
            return ()
        return [f"{name}: should be {said}"]

    def validated(self, value: float) -> float:
        """Return the value as an int, if it is whole, or a float."""
        return value if self.whole else float(value)

    def schema(self) -> JsonObject:
        """Return the JSON schema, with the unit."""
        lower = {"minimum": self.minimum, "exclusiveMinimum": self.above}
        return {
            "type": "integer" if self.whole else "number",
            **{key: bound for key, bound in lower.items() if bound is not None},
            "maximum": self.maximum,
            "unit": self.unit,
            "description": self.description,
        }


class NumbersByName(Plain):
    """An object whose values are numbers, from 1 of them up to the most."""

    description: str
    number: Number
    most: int

    def problems(self, name: str, value: object) -> Sequence[str]:
        """Return what is wrong with a value."""
        if not isinstance(value, Mapping):
            return [f"{name}: should be an object of axes and their numbers"]
        if not value:
            return [f"{name}: should name at least 1 axis"]
        if len(value) > self.most:
            return [f"{name}: {len(value)} axes, but at most {self.most} are allowed"]
        low, high = -math.inf if self.number.minimum is None else self.number.minimum, self.number.maximum
        needed = f"a finite number from {_in_short(low)} to {_in_short(high)} is needed"
        return [
            f"{name}.{shortened(axis)}: {needed}"
            for axis, one in value.items()
            if isinstance(one, bool) or not isinstance(one, int | float) or not low <= one <= high
        ]

    def validated(self, value: Mapping[str, float]) -> dict[str, float]:
        """Return the values as floats."""
        return {name: float(one) for name, one in value.items()}

    def schema(self) -> JsonObject:
        """Return the JSON schema."""
        return {
            "type": "object",
            "additionalProperties": self.number.schema(),
            "minProperties": 1,
            "maxProperties": self.most,
            "description": self.description,
        }


def shortened(text: str) -> str:
    """Return as much of what a client has sent as an answer repeats."""
    return text if len(text) <= _LONGEST_WORD else text[:_LONGEST_WORD] + "…"


def _in_short(number: float) -> str:
    return f"{number:g}".replace("e+0", "e")
