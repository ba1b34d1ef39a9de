"""Random and mutated request lines to the control socket of a service whose axis is armed or moving meanwhile."""

import asyncio
import contextlib
import json
import math
import random
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from tools.fuzz.bench import Bench, Failed
from tools.fuzz.drives import all_drives
from tools.fuzz.outcome import Outcome
from tools.fuzz.reproducible import reproducible
from tools.fuzz.request_maker import RequestMaker, numeric_fields, request_schemas
from twostage_servo.api.request_reading import LONGEST_LINE, parse_request
from twostage_servo.api.requests import BadRequestError
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.state import State
from twostage_servo.service import answers

PER_EPISODE = 2000
"""Lines of one episode, which is a service from its start to its end."""

_SOCKET_SHARE = 0.15
_LINES_A_TICK = 12
_TICKS_AT_END = 400

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


def check_answer(data: bytes, line: Line) -> dict[str, Any]:
    """Check that the bytes are one strict JSON line that says ok, or what is wrong; return it."""
    if data.count(b"\n") != 1 or not data.endswith(b"\n"):
        raise Failed(f"{line.data[:300]!r} is answered by {data.count(10)} lines: {data[:300]!r}")
    answer = strict_json(data)
    if not isinstance(answer, dict) or not isinstance(answer.get("ok"), bool):
        raise Failed(f"{line.data[:300]!r} is answered by {data[:300]!r}, without ok")
    if answer["ok"]:
        if line.refused:
            raise Failed(f"{line.data[:300]!r} is carried out, in spite of its number")
        return answer
    error = answer.get("error")
    if not isinstance(error, dict) or not all(
        isinstance(error.get(key), str) and error[key] for key in ("code", "message")
    ):
        raise Failed(f"{line.data[:300]!r} is answered by {data[:300]!r}, without a code and a message")
    if not error["code"].replace("_", "").isalnum() or not error["code"].islower():
        raise Failed(f"{line.data[:300]!r} is refused with the code {error['code']!r}")
    return answer


def strict_json(data: bytes) -> Any:
    """Parse JSON as its standard has it: UTF-8, no NaN or infinity, no key twice.

    Raises
    ------
    Failed
        If it is not that.
    """

    def no_constant(name: str) -> Any:
        raise Failed(f"{name} in {data[:300]!r}")

    def no_infinity(text: str) -> float:
        number = float(text)
        if not math.isfinite(number):
            raise Failed(f"{text} in {data[:300]!r}")
        return number

    def no_double(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) != len(pairs):
            raise Failed(f"a key twice in {data[:300]!r}")
        return dict(pairs)

    try:
        return json.loads(
            data.decode("utf-8"), parse_constant=no_constant, parse_float=no_infinity, object_pairs_hook=no_double
        )
    except ValueError as error:
        raise Failed(f"not JSON: {data[:300]!r}: {error}") from error


class ControlSocketRig:
    """The control socket of a bench, asked without a connection: its own parsing, handling and encoding.

    Parameters
    ----------
    bench
        The service.
    path
        Path for the socket.
    """

    def __init__(self, bench: Bench, path: Path) -> None:
        self.bench = bench
        self.socket = bench.harness.control_socket(path)
        self.codes: Counter[str] = Counter()

    def ask(self, line: Line) -> dict[str, Any]:
        """Return the checked answer to a line."""
        try:
            request = parse_request(line.data)
        except BadRequestError as error:
            answer = answers.failure(RefusalCode.BAD_REQUEST, str(error))
        else:
            answer = b"".join(self.bench.harness.requests.answer(request, _Asker()).pieces)
        return self.look(check_answer(answer, line), line)

    def look(self, answer: dict[str, Any], line: Line) -> dict[str, Any]:
        """Count an answer, and check that nothing in the axis has become other than finite by its request."""
        self.codes["ok" if answer["ok"] else answer["error"]["code"]] += 1
        axis = self.bench.axis_loop.axis
        estimate = axis.estimate
        total = estimate.position + estimate.velocity + estimate.disturbance + axis.set_point + axis.effort
        if not math.isfinite(total + axis.cruise_velocity + axis.speed_reference):
            raise Failed(f"{line.data[:300]!r} has left the axis with a number that is not finite")
        return answer

    def close(self) -> None:
        """Give the bus back."""
        self.bench.bus.shutdown()


class _Asker:
    """Asks without a connection, and waits for the answer."""

    peer = "pid 1 uid 0 #1"
    arrived_after_s = math.inf
    gone = False


def run_episode(seed: int, episode: int, lines: int) -> Outcome:
    """Ask one service; raises whatever goes wrong.

    Parameters
    ----------
    seed, episode
        Decide on everything.
    lines
        Lines to send.
    """
    rng = reproducible("lines", seed, episode)
    drives = all_drives()
    bench = Bench(drives[episode % len(drives)], rng)
    with (
        tempfile.TemporaryDirectory(prefix="fuzz") as folder,
        contextlib.closing(ControlSocketRig(bench, Path(folder) / "s")) as socket_rig,
    ):
        talk = _Conversation(socket_rig, lines)
        talk.run()
    return Outcome(
        cases=lines,
        counts={
            "ticks": sum(bench.states.values()),
            "over_a_socket": talk.over_socket,
            "too_long": talk.too_long,
            **{f"answer.{code}": number for code, number in socket_rig.codes.items()},
            **{f"state.{name}": number for name, number in bench.states.items()},
            **{f"trip.{name}": number for name, number in bench.trips.items()},
        },
    )


class _Conversation:
    def __init__(self, socket_rig: ControlSocketRig, lines: int) -> None:
        self._socket_rig, self._bench, self._left = socket_rig, socket_rig.bench, lines
        self._rng = socket_rig.bench.rng
        self._maker = LineMaker(self._rng, socket_rig.bench)
        self._over = self._rng.random() < _SOCKET_SHARE
        self._connection: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._ticks_over = 0
        self.over_socket = self.too_long = 0

    def run(self) -> None:
        self._bench.run(self._prepare)

    async def _prepare(self) -> None:
        bench, rng = self._bench, self._rng
        bench.answer_as_drive()
        if self._left <= 0:
            await self._end()
            return
        state = bench.axis_loop.axis.state
        if rng.random() < 0.3:
            bench.ask(op={State.DISARMED: "arm", State.TRIPPED: "reset"}.get(state, "status"))
        lines = [self._maker.line() for _ in range(min(self._left, rng.randrange(2 * _LINES_A_TICK)))]
        self._left -= len(lines)
        if self._over:
            await self._exchange(lines)
        else:
            for line in lines:
                self._socket_rig.ask(line)
        if rng.random() < 0.05:
            bench.harness.requests.disconnect(bench.harness.requests.authority.holder or "")

    async def _connected(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        if self._connection is None:
            if not self._socket_rig.socket.path.exists():
                await self._socket_rig.socket.start()
            self._connection = await asyncio.open_unix_connection(str(self._socket_rig.socket.path), limit=1 << 24)
        return self._connection

    async def _exchange(self, lines: list[Line]) -> None:
        reader, writer = await self._connected()
        self._bench.harness.parts.background.open(math.inf)  # no tick comes before all are answered
        for line in lines:
            writer.write(line.data + b"\n")
        self.over_socket += len(lines)
        for line in lines:
            self._socket_rig.look(check_answer(await self._answer(reader), line), line)
        chance = self._rng.random()
        if chance < 0.03:
            await self._send_too_long(reader, writer)
        elif chance < 0.06:
            writer.write(self._maker.line().data)  # without its end: the client dies in mid-line
            writer.transport.abort()
            self._connection = None
            await asyncio.sleep(0)

    async def _send_too_long(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        line = Line(self._maker.too_long(), refused=True)
        writer.write(line.data + b"\n")
        self.too_long += 1
        self._left -= 1
        try:
            answer = check_answer(await self._answer(reader), line)
        except ConnectionError:
            answer = None  # the answer may be lost with a connection that ends before all of the line is read
        if answer is not None and answer["error"]["code"] != RefusalCode.BAD_REQUEST:
            raise Failed(f"a line that is too long is answered by {answer}")
        writer.close()
        self._connection = None
        await asyncio.sleep(0)

    async def _answer(self, reader: asyncio.StreamReader) -> bytes:
        """Return the next line that is no snapshot for a watcher."""
        while True:
            data = await reader.readline()
            if not data:
                raise ConnectionResetError("the connection was closed")
            if not data.startswith(b'{"event":"snapshot"'):
                return data
            strict_json(data)

    async def _end(self) -> None:
        if self._ticks_over == 0:
            if self._connection is not None:
                self._connection[1].close()
            await self._socket_rig.socket.stop()
            self._bench.service.shut_down()
        self._ticks_over += 1
        if self._ticks_over > _TICKS_AT_END:
            raise Failed(f"the service has not ended after {_TICKS_AT_END} ticks")


def corpus() -> Iterator[bytes]:
    """Yield lines to begin with: each request alone, and with each number that no field may hold."""
    for op, schema in request_schemas().items():
        yield json.dumps({"op": op}).encode()
        for name in schema["properties"]:
            for value in ("1", "-1.5", "true", *NOT_FINITE, "1e308", '"x"', "null"):
                yield f'{{"op": "{op}", "{name}": {value}}}'.encode()
