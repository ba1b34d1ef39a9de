"""Answers as JSON lines, in pieces of little work each: a tick may come between two of them."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.records import JsonRecord
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.printable import ready_for_json

_RECORDS_A_PIECE: Final = 50
_ENCODER: Final = json.JSONEncoder(allow_nan=False, check_circular=False, separators=(",", ":"), default=vars)
"""Writes a record as an object of its fields, without an object in between."""

Answer = JsonObject


def encode(answer: Mapping[str, Any] | JsonRecord) -> bytes:
    """Return an answer as a JSON line; NaN and infinity never leave."""
    return _ENCODER.encode(answer).encode() + b"\n"


def failure(code: RefusalCode, message: str) -> bytes:
    """Return the line that says why a request is not carried out."""
    return encode({"ok": False, "error": {"code": code, "message": message}})


def recording(fields: Sequence[str], records: Sequence[Iterable[Any]]) -> Iterator[bytes]:
    """Yield the line of a recording, which may hold thousands of ticks, in pieces of less than a millisecond's work."""
    yield encode({"ok": True, "fields": fields}).removesuffix(b"}\n") + b',"records":['
    for start in range(0, len(records), _RECORDS_A_PIECE):
        piece = [ready_for_json(record) for record in records[start : start + _RECORDS_A_PIECE]]
        yield (b"," if start else b"") + encode({"": piece})[5:-3]
    yield b"]}\n"
