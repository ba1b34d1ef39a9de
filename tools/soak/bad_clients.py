"""Clients that do not behave, at the real control socket of a service in simulated time."""

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from random import Random

from twostage_servo.api.requests import Request
from twostage_servo.client.async_connection import AsyncConnection
from twostage_servo.client.errors import Refused, ServoError

ANSWERED_WITHIN_S = 1.0
"""Simulated time, which the work itself does not take, until a fresh client's `stop` has been answered."""

LONG_LINE = b'{"op": "move", "positions": {' + b", ".join(b'"axis%d": "far"' % n for n in range(3000)) + b"}}\n"
"""A request of some 50 KB with 3000 mistakes in it."""


class BadClients:
    """Connects to a socket in ways that nobody should; so it has the socket itself, and not a client of ours.

    Parameters
    ----------
    path
        Where they connect.
    random
        Of everything.

    Attributes
    ----------
    path
        The control socket.
    """

    def __init__(self, path: Path, random: Random) -> None:
        self.path = path
        self._random = random
        self._writers: list[asyncio.StreamWriter] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._kinds: tuple[Callable[[], Awaitable[None]], ...] = (
            self._half_closed, self._half_closed, self._reads_nothing, self._comes_and_goes, self._talks_nonsense,
        )  # fmt: skip

    def begin(self) -> None:
        """Let one more of them do what it does, for some seconds."""
        task = asyncio.get_running_loop().create_task(self._quietly(self._random.choice(self._kinds)))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def gone_at_once(self, request: dict[str, object]) -> None:
        """Send a request, and be gone before it can have been read."""
        with contextlib.suppress(OSError):
            _, writer = await asyncio.open_unix_connection(str(self.path))
            writer.write(json.dumps(request).encode() + b"\n")
            writer.transport.abort() if self._random.random() < 0.5 else writer.close()

    async def is_answered(self, request: Request) -> bool:
        """Ask as a fresh client, a good one; return whether an answer comes in time."""
        connection = AsyncConnection(self.path, ANSWERED_WITHIN_S)
        try:
            async with asyncio.timeout(ANSWERED_WITHIN_S):
                await connection.open(ANSWERED_WITHIN_S)
                await connection.ask(request)
        except Refused:
            return True
        except (ServoError, TimeoutError):
            return False
        finally:
            connection.close()
        return True

    async def end(self) -> None:
        """Let all of them go."""
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()
        await asyncio.sleep(0.1)

    async def _quietly(self, act: Callable[[], Awaitable[None]]) -> None:
        with contextlib.suppress(OSError):  # the service may be ending, or refuse one more
            await act()

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_unix_connection(str(self.path))
        self._writers.append(writer)
        return reader, writer

    async def _half_closed(self) -> None:
        """Ask for more than fits into the socket, close the own side, and never read."""
        for _ in range(self._random.randrange(1, 12)):
            _, writer = await self._connect()
            writer.write(b'{"op": "status"}\n' * self._random.choice((1, 50, 400)))
            if writer.can_write_eof():
                writer.write_eof()
            await asyncio.sleep(0.05)

    async def _reads_nothing(self) -> None:
        _, writer = await self._connect()
        writer.write(b'{"op": "watch", "every": 1}\n')
        await asyncio.sleep(self._random.uniform(0.1, 5.0))
        writer.transport.abort()

    async def _comes_and_goes(self) -> None:
        for _ in range(100):
            _, writer = await asyncio.open_unix_connection(str(self.path))
            writer.close()
            await asyncio.sleep(0.001)

    async def _talks_nonsense(self) -> None:
        _, writer = await self._connect()
        for _ in range(10):
            noise = self._random.randbytes(200) + b"\n"
            writer.write(self._random.choice((LONG_LINE, b'{"op": "no \\"stop\\" of mine"}\n', noise)))
            await writer.drain()
            await asyncio.sleep(0.01)
        writer.close()
