"""Makes the lines: valid requests, such with numbers that no field takes, of another structure, or damaged."""

import json
import random
from typing import Any, NamedTuple

from tools.fuzz.bench import Bench
from tools.fuzz.request_maker import RequestMaker, numeric_fields, request_schemas
from twostage_servo.api.request_reading import LONGEST_LINE

NOT_FINITE = ("NaN", "Infinity", "-Infinity", "1e400", "-1e400", "1" + "0" * 400 + ".0")
"""Numbers that no field takes, in the words of JSON and of its parsers."""

HUGE = ("1e308", "-1.7976931348623157e308", "9" * 3000, "-" + "9" * 3000, "1e17", "18446744073709551616")
"""Numbers that no axis takes."""

_NUMBERS = (
    *NOT_FINITE,
    *HUGE,
    "-0.0",
    "0",
    "-0",
    "1e-400",
    "5e-324",
    "1E2",
    "0.1e1",
    "00",
    "+1",
    "1.",
    ".5",
    "0x10",
    "1_0",
)
_VALUES = (
    "null", "true", "false", '""', '"10"', '"NaN"', "[]", "{}", "[1]", '{"a":1}', '"\\u0000"', '"\\ud800"', '"é漢😀"',
    '"' + "x" * 3000 + '"', "[" * 300 + "]" * 300, '{"op":"arm"}',
)  # fmt: skip


class Line(NamedTuple):
    """A line, and whether it must not be carried out: it has a number in a field that no request may hold."""

    data: bytes
    refused: bool


class LineMaker:
    """Makes lines.

    Parameters
    ----------
    rng
        Decides.
    bench
        For requests that suit its axis.
    """

    def __init__(self, rng: random.Random, bench: Bench) -> None:
        self._rng = rng
        self._requests = RequestMaker(rng)
        self._settings = bench.drive.loaded.config.axis
        self._fields = numeric_fields()
        self._ops = list(request_schemas())

    def line(self) -> Line:
        """Return a line without its end, of a length that the socket takes."""
        while len((line := self._any()).data) >= LONGEST_LINE:
            pass
        return line

    def _any(self) -> Line:
        rng = self._rng
        kind = rng.random()
        if kind < 0.15:
            return Line(json.dumps(self._valid()).encode(), refused=False)
        if kind < 0.4:
            return self._poisoned()
        if kind < 0.65:
            return Line(self._restructured().encode("utf-8", "surrogatepass"), refused=False)
        if kind < 0.9:
            return Line(self._damaged(json.dumps(self._valid()).encode()), refused=False)
        if kind < 0.97:
            return Line(rng.randbytes(rng.randrange(200)).replace(b"\n", b" "), refused=False)
        return Line(self._nested(), refused=False)

    def too_long(self) -> bytes:
        """Return a line that is longer than the socket takes."""
        return self._rng.choice((b" ", b"x", b"[", b"9", b"\x00", b"\xff")) * (
            LONGEST_LINE + self._rng.randrange(1, 5000)
        )

    def _valid(self) -> dict[str, Any]:
        request = self._requests.sensible(self._settings)
        if request["op"] == "recording" and self._rng.random() < 0.95:  # whose answers are long
            request = self._requests.motion(self._settings)
        return request

    def _poisoned(self) -> Line:
        """Make a valid request with a number in one of its fields that must not be taken."""
        rng = self._rng
        field = rng.choice(self._fields)
        request: dict[str, Any] = {"op": field.op}
        while field.field not in request:
            request = self._requests.of(field.op, self._settings)
        number = rng.choice(NOT_FINITE + HUGE)
        return Line(json.dumps(request | {field.field: "@"}).replace('"@"', number).encode(), refused=True)

    def _restructured(self) -> str:
        """Make a valid request with other values, keys or braces."""
        rng = self._rng
        request: dict[str, Any] = self._valid()
        for _ in range(1 + rng.getrandbits(1)):
            action = rng.randrange(6)
            key = rng.choice(list(request)) if request else "op"
            if action == 0:
                request[key] = f"@{rng.choice(_NUMBERS)}@"
            elif action == 1:
                request[key] = f"@{rng.choice(_VALUES)}@"
            elif action == 2:
                request[rng.choice(("x", "", "Op", "op ", "__class__", "\0", "é", key))] = f"@{rng.choice(_VALUES)}@"
            elif action == 3:
                request.pop(key, None)
            elif action == 4:
                request["op"] = rng.choice([*self._ops, "", "ARM", "arm ", "\ud800", "arm\0", "fly"])
            else:
                request = {rng.choice(("op", "request", "a")): request}
        text = json.dumps(request, ensure_ascii=rng.random() < 0.5)
        text = text.replace('"@', "").replace('@"', "").replace('\\"', '"').replace("\\\\u", "\\u")
        each_key_twice = text[:-1] + "," + text[1:]
        return rng.choice((f"[{text}]", text + text, each_key_twice, "\ufeff" + text, *8 * (text,)))

    def _damaged(self, data: bytes) -> bytes:
        rng = self._rng
        line = bytearray(data)
        for _ in range(1 + rng.getrandbits(2)):
            if not line:
                break
            at, action = rng.randrange(len(line)), rng.randrange(6)
            if action == 0:
                line[at] ^= 1 << rng.getrandbits(3)
            elif action == 1:
                line[at : at + 1 + rng.getrandbits(3)] = b""
            elif action == 2:
                line[at:at] = rng.choice(
                    (b"\0", b"\xff", b"\xc3", b"\xed\xa0\x80", b"\r", b"{", b'"', b"\\", b",", b"9" * 30)
                )
            elif action == 3:
                del line[at:]
            elif action == 4:
                line[at:at] = line[: rng.randrange(len(line))]
            else:
                line[at] = rng.getrandbits(8)
        return bytes(line).replace(b"\n", b"\t")

    def _nested(self) -> bytes:
        rng = self._rng
        depth = rng.choice((2, 100, 250, 1000, 4000))
        opening = rng.choice(("[", '{"op":', '{"op":"move","position":', '[{"":'))
        closing = rng.choice(("", "]" * depth, "}" * depth))
        return (opening * min(depth, 4_000 // len(opening)) + rng.choice(("", "1", "null")) + closing)[:4_000].encode()
