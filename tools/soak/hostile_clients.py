"""Hostile clients of a control socket, by seed: ``PARENT SOCKET SEED COUNTS``.

Each of a number of clients does one thing after the other, most of which no sensible program would. The file COUNTS
says once a second how often each has been done. The process is meant to be stopped and killed at any moment.
"""

import asyncio
import contextlib
import json
import socket
import sys
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any, Final

from twostage_servo.faults.child import die_with

_CLIENTS: Final = 12
_LONGEST_S: Final = 3.0
_CROWD: Final = 70
"""More than the service lets in at once."""

Character = Callable[[], Awaitable[None]]


class HostileClients:
    """Clients of one service.

    Parameters
    ----------
    path
        Of its control socket.
    seed
        Of all that they do.
    """

    def __init__(self, path: str, seed: int) -> None:
        self.counts: Counter[str] = Counter()
        self._path = path
        self._random = Random(seed)  # noqa: S311 - a soak, no secret
        self._characters: tuple[Character, ...] = (
            *[self.operate] * 4, self.read, self.read_nothing, self.connect_in_a_loop, self.half_close,
            self.send_heavy_lines, self.send_garbage, self.abort, self.crowd, self.ask_in_a_row,
        )  # fmt: skip

    async def run(self, counts: Path) -> None:
        """Go on for ever."""
        await asyncio.gather(*(self._one_after_the_other() for _ in range(_CLIENTS)), self._tell(counts))

    async def _one_after_the_other(self) -> None:
        while True:
            character = self._random.choice(self._characters)
            try:
                await asyncio.wait_for(character(), 2.0 * _LONGEST_S)
            except (OSError, TimeoutError, asyncio.IncompleteReadError, ValueError):
                self.counts["cut off"] += 1
            self.counts[getattr(character, "__name__", "")] += 1
            await asyncio.sleep(self._random.expovariate(10.0))

    async def _tell(self, counts: Path) -> None:
        while True:
            await asyncio.sleep(1.0)
            unfinished = counts.with_suffix(".part")
            unfinished.write_text(json.dumps(self.counts), encoding="utf-8")
            unfinished.replace(counts)

    # What they do ----------------------------------------------------------------------------------------------------

    async def operate(self) -> None:
        """Command the axis, as an operator might."""
        random = self._random
        reader, writer = await self._connect()
        try:
            for _ in range(random.randrange(1, 12)):
                await self._ask(reader, writer, self._request())
                await asyncio.sleep(random.uniform(0.0, 0.3))
            if random.random() < 0.5:
                await self._ask(reader, writer, {"op": "release"})
        finally:
            self._leave(writer)

    def _request(self) -> dict[str, Any]:
        random = self._random
        return dict(random.choice((
            {"op": "preempt"}, {"op": "arm"}, {"op": "arm"}, {"op": "reset"}, {"op": "reset"}, {"op": "stop"},
            {"op": "stop", "quick": True}, {"op": "disarm"}, {"op": "home"}, {"op": "home", "position": 0.0},
            {"op": "jog", "velocity": random.uniform(-50.0, 50.0)}, {"op": "status"}, {"op": "recording"},
            {"op": "reload"}, {"op": "forget"}, {"op": "move", "by": random.uniform(-5.0, 5.0)},
            {"op": "move", "position": random.uniform(-200.0, 200.0), "velocity": random.uniform(1.0, 200.0)},
            {"op": "move", "position": random.choice((1e300, -1e9))},
        )))  # fmt: skip

    async def read(self) -> None:
        """Watch every tick, and read."""
        reader, writer = await self._connect()
        try:
            writer.write(b'{"op":"watch","every":1}\n')
            for _ in range(self._random.randrange(200)):
                await reader.readline()
        finally:
            self._leave(writer)

    async def read_nothing(self) -> None:
        """Watch every tick, and do not read."""
        with self._raw() as client:
            client.send(b'{"op":"watch","every":1}\n' * self._random.choice((1, 50)))
            await self._wait()

    async def connect_in_a_loop(self) -> None:
        """Connect and leave, again and again."""
        for _ in range(self._random.randrange(300)):
            with contextlib.suppress(BlockingIOError), self._raw():
                await asyncio.sleep(0.0)

    async def half_close(self) -> None:
        """Ask a lot, shut down the own side, and read nothing."""
        with contextlib.ExitStack() as clients:
            for _ in range(self._random.randrange(1, 20)):
                client = clients.enter_context(self._raw())
                with contextlib.suppress(BlockingIOError):
                    client.send(b'{"op":"status"}\n' * self._random.choice((1, 60, 2000)))
                client.shutdown(socket.SHUT_WR)
            await self._wait()

    async def send_heavy_lines(self) -> None:
        """Send lines that take long to read, and say that they are urgent."""
        reader, writer = await self._connect()
        bad = {f"axis{number}": "stop" for number in range(self._random.choice((1, 100, 6500)))}
        try:
            for _ in range(self._random.randrange(1, 20)):
                await self._ask(reader, writer, {"op": "move", "positions": bad, "note": '"stop"'})
        finally:
            self._leave(writer)

    async def send_garbage(self) -> None:
        """Send bytes, with and without an end of line."""
        random = self._random
        reader, writer = await self._connect()
        try:
            for _ in range(random.randrange(1, 20)):
                line = random.randbytes(random.choice((1, 100, 70_000))).replace(b"\n", b"")
                writer.write(line + b"\n" * random.randrange(2))
                await writer.drain()
            writer.write(b"\n")
            await reader.readline()
        finally:
            self._leave(writer)

    async def abort(self) -> None:
        """Ask for a lot, or for half of something, and go without reading the answer."""
        for _ in range(self._random.randrange(1, 30)):
            with self._raw() as client, contextlib.suppress(BlockingIOError):
                client.send(self._random.choice((b'{"op":"recording"}\n', b'{"op":"sta', b'{"op":"arm"}\n', b"\n")))
                await asyncio.sleep(self._random.choice((0.0, 0.0, 0.02)))

    async def crowd(self) -> None:
        """Take every place that there is, and do nothing."""
        with contextlib.ExitStack() as clients:
            for _ in range(_CROWD):
                with contextlib.suppress(BlockingIOError):
                    clients.enter_context(self._raw())
                await asyncio.sleep(0.01)
            await self._wait()

    async def ask_in_a_row(self) -> None:
        """Ask hundreds of times without waiting for an answer."""
        reader, writer = await self._connect()
        count = self._random.randrange(1, 500)
        try:
            writer.write(b'{"op":"status"}\n' * count)
            for _ in range(count):
                await reader.readline()
        finally:
            self._leave(writer)

    # How they do it --------------------------------------------------------------------------------------------------

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_unix_connection(self._path, limit=1 << 24)

    def _raw(self) -> socket.socket:
        client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        client.setblocking(False)
        try:
            client.connect(self._path)
        except BaseException:
            client.close()
            raise
        return client

    async def _ask(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: dict[str, Any]
    ) -> dict[str, Any]:
        writer.write(json.dumps(request).encode() + b"\n")
        answer: dict[str, Any] = json.loads(await reader.readline())
        self.counts["answered"] += 1
        return answer

    async def _wait(self) -> None:
        await asyncio.sleep(self._random.uniform(0.0, _LONGEST_S))

    def _leave(self, writer: asyncio.StreamWriter) -> None:
        if self._random.random() < 0.5:
            writer.transport.abort()
        else:
            writer.close()


def main(arguments: Sequence[str]) -> int:
    """Be a nuisance until somebody ends it."""
    parent, path, seed, counts = arguments
    die_with(int(parent))
    asyncio.run(HostileClients(path, int(seed)).run(Path(counts)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
