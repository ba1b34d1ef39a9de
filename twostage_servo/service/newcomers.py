"""Clients that have connected and whose first request is not served yet: they do not count among the 64 before that.

There are two kinds. The *silent* have not said anything; the kernel watches them all through one descriptor, so each
costs the loop next to nothing, and none of them keeps a client out that has spoken. The *waiting* have asked for
something that can wait until there is room for them.
"""

import asyncio
import contextlib
import select
from collections import deque
from typing import TYPE_CHECKING, Final

from twostage_servo.service.connection import wake

if TYPE_CHECKING:
    from collections.abc import Iterator

    from twostage_servo.api.requests import Request
    from twostage_servo.service.connection import Connection
    from twostage_servo.service.request_age import RequestAge

MOST_SILENT: Final = 128
MOST_WAITING: Final = 32
FAIR_CHANCE_S: Final = 0.02
"""Nobody makes room before he had so long to say what he wants: who connects in a loop waits for that instead."""


class Newcomers:
    """The silent and the waiting ones, each kind with a bound of its own.

    Parameters
    ----------
    age
        Tells the time.
    """

    def __init__(self, age: "RequestAge") -> None:
        self._age = age
        self._poll = select.epoll()
        self._silent: dict[int, tuple[Connection, float]] = {}  # by descriptor, with the time at which each came
        self._waiting: deque[tuple[Connection, Request | None]] = deque()
        self._somebody_waits = asyncio.Event()
        self._room: asyncio.Future[None] | None = None
        self._empty_s = age.now_s()  # none of the silent ones had said anything

    def __len__(self) -> int:
        """Return their number."""
        return len(self._silent) + len(self._waiting)

    # The silent ones -------------------------------------------------------------------------------------------------

    def add_silent(self, connection: "Connection") -> None:
        """Let the kernel watch one that has not said anything. One descriptor more is all that it takes."""
        self._silent[connection.descriptor] = connection, self._age.now_s()
        self._poll.register(connection.descriptor, select.EPOLLIN)

    def remove_silent(self, connection: "Connection") -> None:
        """Forget a silent one, before it is closed, served or waits."""
        if self._silent.pop(connection.descriptor, None) is not None:
            self._poll.unregister(connection.descriptor)
            if self._room is not None:
                wake(self._room)

    @property
    def is_silent_full(self) -> bool:
        """Whether a silent one has to go before another comes."""
        return len(self._silent) >= MOST_SILENT

    def oldest_silent(self) -> "Connection | None":
        """Return the one that has been silent for the longest time."""
        return next((connection for connection, _ in self._silent.values()), None)

    def pause_s(self) -> float:
        """Return for how long nobody may be let in, s: each silent one is given its fair chance."""
        if not self.is_silent_full:
            return 0.0
        _, came_s = next(iter(self._silent.values()))
        return max(0.0, came_s + FAIR_CHANCE_S - self._age.now_s())

    async def room(self) -> None:
        """Wait until somebody may be let in."""
        while (pause_s := self.pause_s()) > 0.0:
            self._room = asyncio.get_running_loop().create_future()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause_s):
                    await self._room
        self._room = None

    async def somebody_speaks(self) -> None:
        """Wait until one of the silent says something, or leaves."""
        loop, watched_since_s = asyncio.get_running_loop(), self._age.now_s()
        future = loop.create_future()
        loop.add_reader(self._poll, wake, future)
        try:
            await future
        finally:
            loop.remove_reader(self._poll)
        empty_until_s = self._age.was_empty_until_s(watched_since_s)
        if empty_until_s is not None:
            self._empty_s = max(self._empty_s, empty_until_s)

    def speaking(self, most: int) -> "Iterator[Connection]":
        """Yield so many at most that have said something, or left; each is told until when it was silent."""
        now_s = self._age.now_s()
        ready = self._poll.poll(0, most)
        for descriptor, _ in ready:
            connection, _ = self._silent[descriptor]
            connection.was_empty(self._empty_s)
            yield connection
        if len(ready) < most:  # all others had not said anything
            self._empty_s = max(self._empty_s, now_s)

    # The waiting ones ------------------------------------------------------------------------------------------------

    @property
    def is_waiting_full(self) -> bool:
        """Whether no more can wait."""
        return len(self._waiting) >= MOST_WAITING

    def add_waiting(self, connection: "Connection", request: "Request | None") -> None:
        """Let one wait, with its request where that has been read already."""
        self._waiting.append((connection, request))
        self._somebody_waits.set()

    async def somebody_waits(self) -> None:
        """Wait until somebody waits."""
        await self._somebody_waits.wait()

    def next_waiting(self) -> "tuple[Connection, Request | None] | None":
        """Return the one that has waited for the longest time, and let it wait no more."""
        if self._waiting:
            return self._waiting.popleft()
        self._somebody_waits.clear()
        return None

    # The end ---------------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Close all of them."""
        for connection, _ in self._silent.values():
            connection.close()
        for connection, _ in self._waiting:
            connection.close()
        self._silent.clear()
        self._waiting.clear()
        self._poll.close()
