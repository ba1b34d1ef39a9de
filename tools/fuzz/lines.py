"""Random and mutated request lines to the control socket of a service whose axis is armed or moving meanwhile."""

import asyncio
import contextlib
import json
import math
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tools.fuzz.bench import Bench
from tools.fuzz.drives import all_drives
from tools.fuzz.line_maker import NOT_FINITE, Line, LineMaker
from tools.fuzz.outcome import Failed, Outcome
from tools.fuzz.reproducible import reproducible
from tools.fuzz.request_maker import request_schemas
from twostage_servo.api.request_reading import parse_request
from twostage_servo.api.requests import BadRequestError
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.state import State
from twostage_servo.service import answers

PER_EPISODE = 2000
"""Lines of one episode, which is a service from its start to its end."""

_SOCKET_SHARE = 0.15
_LINES_A_TICK = 12
_TICKS_AT_END = 400


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
