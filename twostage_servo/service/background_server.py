"""Background work between the ticks: clients are served in the time that a tick leaves, never in the tick itself."""

import asyncio
import contextlib
import enum
from collections import deque
from collections.abc import AsyncIterator
from typing import Final

from twostage_servo.api.requests import DisarmRequest, Request, StopRequest

_SHARE: Final = 0.3
"""Share of a period for all requests together: a flooding client cannot use more, and never delays a tick."""
_SHARE_OF_CONNECTIONS: Final = 0.45
"""Share of a period for accepting connections: a client that wants to stop must not wait behind those that connect.
With 0.3 a `stop` among 64 connectors and five other loads took up to 22 ms on eight axes (99th percentile), with this
18."""
_LONGEST_SHARE: Final = 0.2
"""Cap of the expected length of a slot, as a share of the period: one long slot must not shut the others out."""
_SLICE_SHARE: Final = 0.05
"""Longest that a slot of divisible work should take, as a share of the period."""
_FORGETTING: Final = 0.995
"""Factor by which the longest slot decays with each shorter one."""


class Priority(enum.Enum):
    """What a slot is for, most urgent first."""

    URGENT = 0
    CONNECTION = 1
    READING = 2
    REQUEST = 3
    WATCHING = 4


def priority_of(request: Request) -> Priority:
    """Return how urgent a request is, by what it asks for."""
    return Priority.URGENT if isinstance(request, StopRequest | DisarmRequest) else Priority.REQUEST


_SHARE_OF_READING: Final = 0.1
"""Share of a period after which reading gives way to what has been read, if that waits."""


class BackgroundServer:
    """Runs background work between ticks, one item at a time, in priority order, within a budget of time per period.

    Within a priority the order is first in, first out. Requests may take 0.3 of a period in all, and accepting
    connections 0.45. No slot begins so late that it could last until the loop has to wait for the deadline. A slot
    counts from the moment at which it is granted, so that the passes of the loop between two slots count as well. One
    slot of each priority is granted after each tick, however little time there is. Urgent ones may use all of the time.
    Accepting and reading go before carrying out, since a `stop` may be among what is read; reading has 0.1 of a period
    while a request that has been read waits.

    Parameters
    ----------
    period_s
        Period of the ticks, s.

    Attributes
    ----------
    period_s
        As given.
    slice_s
        Longest that a slot of divisible work should take, s.
    """

    def __init__(self, period_s: float) -> None:
        self.slice_s = _SLICE_SHARE * period_s
        self.period_s = period_s
        self._largest_s = _LONGEST_SHARE * period_s
        self._longest_s = 0.0
        self._until_s = 0.0
        self._left_s = 0.0
        self._left_of_reading_s = self._left_of_connections_s = 0.0
        self._granted_s: float | None = None  # when a slot was granted that has not begun
        self._occupied = False  # a slot is granted and has not ended
        self._ended = False
        self._queues: dict[Priority, deque[asyncio.Future[None]]] = {priority: deque() for priority in Priority}
        self._owed: set[Priority] = set()  # of each of these one slot is granted before the next tick, in time or not

    def open(self, until_s: float) -> None:
        """Begin to grant slots after a tick; the loop has to be free from `until_s` on, on its clock in s."""
        self._until_s = until_s - self._longest_s
        self._left_s = _SHARE * self.period_s
        self._left_of_reading_s = _SHARE_OF_READING * self.period_s
        self._left_of_connections_s = _SHARE_OF_CONNECTIONS * self.period_s
        self._owed = set(Priority)
        if self._granted_s is not None:  # the tick itself counts for no slot
            self._granted_s = asyncio.get_running_loop().time()
        self._grant_next()

    def end(self) -> None:
        """Grant a slot to everybody from now on: there are no more ticks."""
        self._ended = True
        for queue in self._queues.values():
            while _wake_first(queue):
                pass

    @contextlib.asynccontextmanager
    async def slot(self, priority: Priority) -> AsyncIterator[None]:
        """Wait for a slot; the block is the slot, and must not wait for anything."""
        queue = self._queues[priority]
        if not self._ended and (queue or self._occupied or not self._has_time(priority)):
            await self._wait_in(queue)
        self._occupied = True
        clock = asyncio.get_running_loop().time
        begun_s = clock() if self._granted_s is None else self._granted_s
        self._granted_s = None
        try:
            yield
        finally:
            used_s = clock() - begun_s
            if priority is Priority.CONNECTION:
                self._left_of_connections_s -= used_s
            else:
                self._left_s -= used_s
            if priority is Priority.READING:
                self._left_of_reading_s -= used_s
            self._longest_s = min(max(used_s, _FORGETTING * self._longest_s), self._largest_s)
            self._owed.discard(priority)
            self._occupied = False
            self._grant_next()

    async def _wait_in(self, queue: "deque[asyncio.Future[None]]") -> None:
        mine = asyncio.get_running_loop().create_future()
        queue.append(mine)
        try:
            await mine
        except asyncio.CancelledError:
            if mine.done() and not mine.cancelled():  # granted, and not used: the next one gets it
                self._occupied, self._granted_s = False, None
                self._grant_next()
            else:  # a cancelled wait must not stay in the queue
                with contextlib.suppress(ValueError):
                    queue.remove(mine)
            raise

    def _has_time(self, priority: Priority) -> bool:
        if asyncio.get_running_loop().time() >= self._until_s:
            return False
        if priority is Priority.URGENT:
            return True
        if priority is Priority.CONNECTION:
            return self._left_of_connections_s > 0.0
        if priority is Priority.READING and self._left_of_reading_s <= 0.0 and self._queues[Priority.REQUEST]:
            return False
        return self._left_s > 0.0

    def _grant_next(self) -> None:
        for priority, queue in self._queues.items():
            if self._occupied:
                return
            if queue and (self._has_time(priority) or priority in self._owed):
                self._occupied = _wake_first(queue)
                self._granted_s = asyncio.get_running_loop().time() if self._occupied else None


def _wake_first(queue: "deque[asyncio.Future[None]]") -> bool:
    """Resume the first that still waits; return whether there was one."""
    while queue:
        future = queue.popleft()
        if not future.done():
            future.set_result(None)
            return True
    return False
