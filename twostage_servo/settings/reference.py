"""What every configuration key means: type, unit, default, bounds, description; read from the settings themselves."""

import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from twostage_servo.settings.base import Settings
from twostage_servo.settings.toml_text import key_text, value_text

_TYPE_TEXTS: Mapping[Any, str] = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "a text in quotes",
    Any: "any value",
}


@dataclass(frozen=True, slots=True)
class Row:
    """One configuration key, in words for the operator.

    Parameters
    ----------
    key
        Dotted key, e.g. ``axis.limits.velocity``.
    type
        E.g. ``a number`` or ``one of "crc8_j1850", "none"``.
    unit
        Unit of a number; None where there is none to speak of (texts, switches, tables).
    default
        The default in TOML notation, ``not set`` for an optional key, None if the key is required.
    lower, upper
        Bounds, e.g. ``greater than 0``, ``at most 100``; empty if there is none.
    pattern
        Regular expression that a text must match; empty if there is none.
    description
        One line: what the key does.
    """

    key: str
    type: str
    unit: str | None
    default: str | None
    lower: str
    upper: str
    pattern: str
    description: str

    @property
    def bounds(self) -> str:
        """Both bounds, and the pattern, as one text."""
        pattern = f"matching {self.pattern}" if self.pattern else ""
        return ", ".join(filter(None, (self.lower, self.upper, pattern)))

    @property
    def needed(self) -> str:
        """What a right value looks like: type, unit, bounds, description."""
        unit = f"in {self.unit}" if self.unit not in (None, "1") else ""
        text = ", ".join(filter(None, (f"{self.type} is needed", unit, self.bounds)))
        return f"{text} ({self.description})" if self.description else text


class Located(typing.NamedTuple):
    """The part of a path that the settings know, with its declaration."""

    path: tuple[str | int, ...]
    annotation: Any
    field: FieldInfo | None


def describe(model: type[BaseModel]) -> list[Row]:
    """List every key of a settings tree, in the order of declaration.

    Parameters
    ----------
    model
        The settings class to list.

    Returns
    -------
    list of Row
        One row for each key that is not itself a table of settings.
    """
    return list(_rows(model, ()))


def _rows(model: type[BaseModel], path: tuple[str, ...]) -> Iterator[Row]:
    for name, field in fields_of(model).items():
        table = table_of(field.annotation)
        if table is None:
            yield row(Located((*path, name), field.annotation, field))
        else:
            yield from _rows(table, (*path, name))


def locate(model: type[BaseModel], path: Sequence[str | int]) -> Located:
    """Follow a path into a settings tree as far as the settings know it.

    Parameters
    ----------
    model
        Root of the tree.
    path
        Keys and list indices; what pydantic appends to an error's location (the member of a union) is left off.
    """
    found = Located((), model, None)
    for part in path:
        table = table_of(found.annotation)
        if table is not None:
            field = fields_of(table).get(str(part))
            if field is None:
                break
            found = Located((*found.path, part), field.annotation, field)
        else:
            entry = _entry_annotation(found.annotation, part)
            if entry is None:
                break
            found = Located((*found.path, part), entry, found.field)
    return found


def row(located: Located) -> Row:
    """Describe one located key."""
    path, annotation, field = located
    description = (field.description or "").removesuffix(".") if field is not None else ""
    if field is None or annotation is not field.annotation:  # an entry of a list or table: the bounds are the whole's
        return Row(key_text(path), _type_text(annotation), None, None, "", "", "", description)
    extra = field.json_schema_extra
    lower, upper, pattern = _bounds(field)
    return Row(
        key=key_text(path),
        type=_type_text(annotation),
        unit=str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else None,
        default=None if field.is_required() else value_text(field.get_default(call_default_factory=True)),
        lower=lower,
        upper=upper,
        pattern=pattern,
        description=description,
    )


def fields_of(model: type[BaseModel]) -> Mapping[str, FieldInfo]:
    """Return all keys that a table may have."""
    return model.all_fields() if issubclass(model, Settings) else model.model_fields


def table_of(annotation: Any) -> type[BaseModel] | None:
    """Give the settings class that a field holds, None for every other field."""
    for kind in _alternatives(annotation):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind
    return None


def _alternatives(annotation: Any) -> list[Any]:
    if typing.get_origin(annotation) is typing.Annotated:
        return _alternatives(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [kind for member in typing.get_args(annotation) for kind in _alternatives(member)]
    return [] if annotation in (None, types.NoneType) else [annotation]


def _entry_annotation(annotation: Any, part: str | int) -> Any:
    for kind in _alternatives(annotation):
        origin, arguments = typing.get_origin(kind), typing.get_args(kind)
        if origin is dict and isinstance(part, str):
            return arguments[1]
        if origin is list and isinstance(part, int):
            return arguments[0]
    return None


def _type_text(annotation: Any) -> str:
    return " or ".join(dict.fromkeys(_one_type_text(kind) for kind in _alternatives(annotation)))


def _one_type_text(kind: Any) -> str:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return ("one of " if len(arguments) > 1 else "") + ", ".join(value_text(choice) for choice in arguments)
    if origin is list:
        return f"a list (each entry {_type_text(arguments[0])})"
    if origin is dict:
        return f"a table (each entry {_type_text(arguments[1])})"
    if table_of(kind) is not None:
        return "a table"
    return _TYPE_TEXTS.get(kind) or str(kind)


def _bounds(field: FieldInfo) -> tuple[str, str, str]:
    lower = upper = pattern = ""
    parts = "characters" if str in _alternatives(field.annotation) else "entries"
    for constraint in field.metadata:
        match constraint:
            case annotated_types.Gt(gt=bound):
                lower = f"greater than {_number_text(bound)}"
            case annotated_types.Ge(ge=bound):
                lower = f"at least {_number_text(bound)}"
            case annotated_types.Lt(lt=bound):
                upper = f"less than {_number_text(bound)}"
            case annotated_types.Le(le=bound):
                upper = f"at most {_number_text(bound)}"
            case annotated_types.MinLen(min_length=bound):
                lower = "not empty" if bound == 1 else f"at least {bound} {parts}"
            case annotated_types.MaxLen(max_length=bound):
                upper = f"at most {bound} {parts}"
            case _:
                pattern = str(getattr(constraint, "pattern", None) or pattern)
    return lower, upper, pattern


def _number_text(number: Any) -> str:
    short = f"{number:g}"
    return short if float(short) == number else str(number)
