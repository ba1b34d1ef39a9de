"""What kind of value each attribute has in the objects of the package that hang together."""

import enum
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
from pydantic import BaseModel


class Kinds(dict[str, set[str]]):
    """By ``Class.attribute``."""


def attributes(thing: object) -> Iterator[tuple[str, Any]]:
    """Return what an object holds by name, whether in slots or in a dictionary."""
    names = [name for base in type(thing).__mro__ for name in getattr(base, "__slots__", ())]
    for name in [*names, *getattr(thing, "__dict__", {})]:
        if hasattr(thing, name):
            yield name, getattr(thing, name)


def kind(value: object) -> str:
    """Return what sort of value it is; whole and broken numbers are one sort, a flag is none of them."""
    if isinstance(value, bool):
        return "flag"
    if isinstance(value, int | float | np.number) and not isinstance(value, enum.Enum):
        return "number"
    return "nothing" if value is None else type(value).__name__


def collect(thing: object, into: Kinds) -> None:
    """Add the kinds of values of an object, and of all of the package that it holds but settings, which are checked."""
    seen: set[int] = set()
    waiting = [thing]
    while waiting:
        one = waiting.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        if isinstance(one, tuple | list):
            waiting += one
        elif isinstance(one, dict):
            waiting += one.values()
        elif type(one).__module__.startswith("twostage_servo.") and not isinstance(one, enum.Enum | BaseModel):
            for name, value in attributes(one):
                into.setdefault(f"{type(one).__name__}.{name}", set()).add(kind(value))
                waiting.append(value)


def assert_kinds(kinds: Kinds, at_times: Collection[str]) -> None:
    """Check that only what is named is nothing at times, and that numbers, flags and texts stay what they are."""
    assert {name for name, found in kinds.items() if "nothing" in found} <= set(at_times)
    plain = {"flag", "number", "str"}
    assert {name: found for name, found in kinds.items() if found & plain and len(found - {"nothing"}) > 1} == {}
