"""Records that are written to JSON and read from it, by the types of their fields."""

import enum
import types
import typing
from collections.abc import Callable
from typing import Any, ClassVar, Self

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.plain import Plain

_Reader = Callable[[Any], Any]


class UnreadableError(ValueError):
    """An object of JSON is not what it should be; the text says which part of it."""


class JsonRecord(Plain):
    """Base of the records: it writes and reads them."""

    _readers: ClassVar[dict[str, _Reader] | None] = None

    def to_json(self) -> JsonObject:
        """Return the record as an object of JSON, with everything in it."""
        return {name: _written(value) for name, value in vars(self).items()}

    @classmethod
    def from_json(cls, fields: JsonObject) -> Self:
        """Return the record that an object of JSON is; keys that it does not know are left out.

        Raises
        ------
        UnreadableError
            If a field is missing, or is of another type.
        """
        readers = cls.__dict__.get("_readers")
        if readers is None:
            hints = cls.__annotations__
            readers = {name: _reader_of(hints[name]) for name in cls.field_names}
            cls._readers = readers
        if not isinstance(fields, dict):
            raise UnreadableError(f"{cls.__name__}: an object is needed")
        values = {}
        for name, read in readers.items():
            try:
                values[name] = read(fields[name])
            except KeyError:
                raise UnreadableError(f"{name} is missing") from None
            except ValueError as error:
                raise UnreadableError(f"{name}: {error}") from error
        return cls(**values)


def _written(value: Any) -> Any:
    if isinstance(value, JsonRecord):
        return value.to_json()
    if isinstance(value, list | tuple):
        return [_written(one) for one in value]
    if isinstance(value, dict):
        return {name: _written(one) for name, one in value.items()}
    return value


def _reader_of(hint: Any) -> _Reader:
    """Return what makes a value of a type out of JSON."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is None:
        return _reader_of_one(hint)
    if origin in {types.UnionType, typing.Union}:
        kinds = [one for one in arguments if one is not types.NoneType]
        inner = _reader_of(kinds[0]) if len(kinds) == 1 else lambda value: _checked(value, tuple(kinds))
        return lambda value: None if value is None and types.NoneType in arguments else inner(value)
    if origin is dict:
        inner = _reader_of(arguments[1])
        return lambda value: {name: inner(one) for name, one in _checked(value, dict).items()}
    inner = _reader_of(arguments[0])  # of a list or a tuple
    return lambda value: origin(map(inner, _checked(value, list)))


def _reader_of_one(kind: type[Any]) -> _Reader:
    if issubclass(kind, JsonRecord):
        return kind.from_json
    if issubclass(kind, enum.Enum):
        return typing.cast("_Reader", kind)
    if kind is float:
        return lambda value: float(_checked(value, (int, float)))
    return lambda value: _checked(value, kind)


def _checked(value: Any, kind: Any) -> Any:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise UnreadableError(f"{value!r:.40} is of another type")
    return value
