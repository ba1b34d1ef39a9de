"""When clients are served: in the time that a tick leaves, not in the moments before the next one."""

import asyncio
import contextlib
import enum
from collections import deque
from collections.abc import AsyncIterator
from typing import Final

from twostage_servo.api.requests import DisarmRequest, Request, StopRequest

_SHARE: Final = 0.3
"""Share of a period for all requests together: who floods the service takes no more of a core, and no tick waits."""
_SHARE_OF_CONNECTIONS: Final = 0.3
"""Share of a period for letting clients in: whoever wants to stop must not wait long behind those who only connect."""
_LONGEST_SHARE: Final = 0.2
"""Cap of what a turn is expected to take, as a share of the period: one long turn must not shut the others out."""
_SLICE_SHARE: Final = 0.05
"""What a turn that could go on for long should take at most, as a share of the period."""
_FORGETTING: Final = 0.995
"""By this factor the longest turn is forgotten with each one that is shorter."""


class Priority(enum.Enum):
    """What a turn is for, in the order in which they go."""

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
    """Hands out turns, one at a time, while there is time for them: by rank, and first come, first served within one.

    Between a tick and the next one requests may take 0.3 of a period in all, and letting clients in as much; no turn
    begins so late that it could last into the moment at which the loop has to wait for the deadline. A turn lasts from
    the moment at which it is given, so that the passes of the loop between two turns count as well. At least one of
    each rank is given after each tick, however little time there is. Urgent ones may use all of the time that there is.
    Letting clients in and reading what they ask go before carrying it out, since a `stop` may be among it, reading only
    up to 0.1 of a period while something that has been read waits.

    Parameters
    ----------
    period_s
        Period of the ticks, s.

    Attributes
    ----------
    period_s
        As given.
    slice_s
        How long a turn that could go on for long should take at most, s.
    """

    def __init__(self, period_s: float) -> None:
        self.slice_s = _SLICE_SHARE * period_s
        self.period_s = period_s
        self._largest_s = _LONGEST_SHARE * period_s
        self._longest_s = 0.0
        self._until_s = 0.0
        self._left_s = 0.0
        self._left_of_reading_s = self._left_of_connections_s = 0.0
        self._given_s: float | None = None  # since when somebody has a turn that he has not begun
        self._called = False  # somebody has been given a turn and is not done with it
        self._ended = False
        self._queues: dict[Priority, deque[asyncio.Future[None]]] = {rank: deque() for rank in Priority}
        self._owed: set[Priority] = set()  # those of which one is served before the next tick, in time or not

    def open(self, until_s: float) -> None:
        """Begin to hand out turns after a tick; the loop has to be free from `until_s` on, on its clock in s."""
        self._until_s = until_s - self._longest_s
        self._left_s = _SHARE * self.period_s
        self._left_of_reading_s = _SHARE_OF_READING * self.period_s
        self._left_of_connections_s = _SHARE_OF_CONNECTIONS * self.period_s
        self._owed = set(Priority)
        if self._given_s is not None:  # the tick itself is nobody's turn
            self._given_s = asyncio.get_running_loop().time()
        self._call_next()

    def end(self) -> None:
        """Give everybody a turn from now on: there are no more ticks."""
        self._ended = True
        for queue in self._queues.values():
            while _wake_first(queue):
                pass

    @contextlib.asynccontextmanager
    async def slot(self, rank: Priority) -> AsyncIterator[None]:
        """Wait for a turn; the block is the turn, and must not wait for anybody."""
        queue = self._queues[rank]
        if not self._ended and (queue or self._called or not self._has_time(rank)):
            await self._stand_in(queue)
        self._called = True
        clock = asyncio.get_running_loop().time
        begun_s = clock() if self._given_s is None else self._given_s
        self._given_s = None
        try:
            yield
        finally:
            taken_s = clock() - begun_s
            if rank is Priority.CONNECTION:
                self._left_of_connections_s -= taken_s
            else:
                self._left_s -= taken_s
            if rank is Priority.READING:
                self._left_of_reading_s -= taken_s
            self._longest_s = min(max(taken_s, _FORGETTING * self._longest_s), self._largest_s)
            self._owed.discard(rank)
            self._called = False
            self._call_next()

    async def _stand_in(self, queue: "deque[asyncio.Future[None]]") -> None:
        mine = asyncio.get_running_loop().create_future()
        queue.append(mine)
        try:
            await mine
        except asyncio.CancelledError:
            if mine.done() and not mine.cancelled():  # it was given and is not used: the next one shall have it
                self._called, self._given_s = False, None
                self._call_next()
            else:  # clients that come and go must not leave the queue full of those who have gone
                with contextlib.suppress(ValueError):
                    queue.remove(mine)
            raise

    def _has_time(self, rank: Priority) -> bool:
        if asyncio.get_running_loop().time() >= self._until_s:
            return False
        if rank is Priority.URGENT:
            return True
        if rank is Priority.CONNECTION:
            return self._left_of_connections_s > 0.0
        if rank is Priority.READING and self._left_of_reading_s <= 0.0 and self._queues[Priority.REQUEST]:
            return False
        return self._left_s > 0.0

    def _call_next(self) -> None:
        for rank, queue in self._queues.items():
            if self._called:
                return
            if queue and (self._has_time(rank) or rank in self._owed):
                self._called = _wake_first(queue)
                self._given_s = asyncio.get_running_loop().time() if self._called else None


def _wake_first(queue: "deque[asyncio.Future[None]]") -> bool:
    """Let the first one that still waits go on; return whether there was one."""
    while queue:
        future = queue.popleft()
        if not future.done():
            future.set_result(None)
            return True
    return False
