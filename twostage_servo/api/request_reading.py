"""From the bytes of a line to a request, in bounded time: what is wrong is told up to the fifth problem."""

import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from twostage_servo.api.fields import JsonObject, shortened
from twostage_servo.api.requests import MOST_PROBLEMS, OPERATIONS, READING, BadRequestError, Request

LONGEST_LINE: Final = 4096
"""Bytes of a request, its end included, on a service with few axes."""
_LONGEST_NUMBER: Final = 30
_MOST_BRACKETS: Final = 200
"""Of those that open: a request has 2, and what nests a thousand may be too deep for the reader of JSON."""
_STRING: Final = re.compile(r'"(?:[^"\\]|\\.)*"')

_ESCAPE: Final = b"\\"
"""What begins an escape: a word written with it is not found as such."""
URGENT_WORDS: Final = (b"stop", b"disarm", _ESCAPE)
"""A line without any of these asks for nothing urgent."""
COMMAND_WORDS: Final = (_ESCAPE, *(op.encode() for op, model in OPERATIONS.items() if model not in READING))
"""A line without any of these commands nothing."""
LONGEST_URGENT: Final = 512
"""Bytes of a first request that is looked at for being urgent before its turn comes."""


def longest_line(names: Iterable[str]) -> int:
    """Return how many bytes a request may have: those of a move of all axes, where that needs more than others do.

    Parameters
    ----------
    names
        The axes' names.
    """
    return max(LONGEST_LINE, 256 + sum(len(json.dumps(name)) + 2 + _LONGEST_NUMBER for name in names))


def parse_request(line: bytes) -> Request:
    """Return the request that a line holds.

    Raises
    ------
    BadRequestError
        If it holds none.
    """
    try:
        text = line.decode()
        _check_nesting(text)
        fields = _READER.decode(text)
        if "\\u" in text:
            json.dumps(fields, ensure_ascii=False).encode()  # half of a character can't be logged, nor answered
    except BadRequestError:
        raise
    except json.JSONDecodeError as error:
        what = error.msg if text[error.pos :].strip() else f"EOF: {error.msg}, and the line ends"
        raise BadRequestError(f"invalid JSON: {what} (character {error.pos + 1})") from error
    except ValueError as error:
        raise BadRequestError(f"invalid JSON: {error}") from error
    return read_request(fields)


def read_request(fields: object) -> Request:
    """Return the request that an object of JSON is.

    Raises
    ------
    BadRequestError
        If it is none.
    """
    if not isinstance(fields, dict):
        raise BadRequestError('a request should be an object, such as {"op": "status"}')
    op = fields.get("op")
    model = OPERATIONS.get(op) if isinstance(op, str) else None
    if model is None:
        named = f"{shortened(op)} is not a request" if isinstance(op, str) else "it must name the request"
        raise BadRequestError(f"op: {named}; the requests are {', '.join(OPERATIONS)}")
    problems = list(itertools.islice(_problems(fields, model), MOST_PROBLEMS))
    if problems:
        raise BadRequestError("; ".join(problems))
    return model(**{name: value for name, value in fields.items() if name != "op"})


def _check_nesting(text: str) -> None:
    if text.count("[") + text.count("{") > _MOST_BRACKETS:
        bare = _STRING.sub("", text)
        if bare.count("[") + bare.count("{") > _MOST_BRACKETS:
            raise BadRequestError(f"invalid JSON: recursion: more than {_MOST_BRACKETS} arrays and objects")


def _each_key_once(pairs: list[tuple[str, Any]]) -> JsonObject:
    """Refuse an object that says the same key twice: of `stop` and `arm` only one would be heard."""
    fields = dict(pairs)
    if len(fields) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for number, name in enumerate(names) if name in names[:number])
        raise BadRequestError(f"{shortened(twice)} is given twice: give it once")
    return fields


_READER: Final = json.JSONDecoder(object_pairs_hook=_each_key_once)


def _problems(fields: JsonObject, model: type[Request]) -> Iterator[str]:
    """Yield what is wrong with the names of the fields, and with what is missing; the rest is the request's own."""
    kinds = model.kinds
    for name, value in fields.items():
        if name not in kinds and name != "op":
            yield f"{shortened(name)}: no such key (there are {', '.join(_keys_of(kinds))})"
        elif value is None:
            yield f"{name} is null: give it a value, or leave it out"
    for name in model.required_names:
        if name not in fields:
            yield f"{name}: is missing, and must be given"


def _keys_of(kinds: Mapping[str, object]) -> list[str]:
    names = list(kinds)
    return [*names[: "axis" in kinds], "op", *names["axis" in kinds :]]
