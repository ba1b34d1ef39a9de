"""When clients are served: in the time that a tick leaves, not in the moments before the next one."""

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator, Iterator
from typing import Final

_SHARE: Final = 0.3
"""Share of a period for all clients together: who floods the service takes no more of a core, and no tick waits."""
_LONGEST_SHARE: Final = 0.2
"""Cap of what a turn is expected to take, as a share of the period: one long turn must not shut the others out."""
_FORGETTING: Final = 0.995
"""By this factor the longest turn is forgotten with each one that is shorter."""


class Turns:
    """Hands out turns, one at a time and first come, first served, while there is time for them.

    Between a tick and the next one turns may take 0.3 of a period in all, and none begins so late that it could last
    into the moment at which the loop has to wait for the deadline. At least one is given after each tick, however
    little time there is. Urgent ones go before the others, and none of them waits for more than the end of a tick.

    Parameters
    ----------
    period_s
        Period of the ticks, s.
    """

    def __init__(self, period_s: float) -> None:
        self._share_s = _SHARE * period_s
        self._largest_s = _LONGEST_SHARE * period_s
        self._longest_s = 0.0
        self._until_s = 0.0
        self._left_s = 0.0
        self._ended = False
        self._waiting: deque[asyncio.Future[None]] = deque()
        self._urgent: deque[asyncio.Future[None]] = deque()

    def open(self, until_s: float) -> None:
        """Begin to hand out turns after a tick; the loop has to be free from `until_s` on, on its clock in s."""
        self._until_s = until_s - self._longest_s
        self._left_s = self._share_s
        while _wake_first(self._urgent):
            pass
        _wake_first(self._waiting)

    def end(self) -> None:
        """Give everybody a turn from now on: there are no more ticks."""
        self._ended = True
        for queue in (self._urgent, self._waiting):
            while _wake_first(queue):
                pass

    @contextlib.asynccontextmanager
    async def turn(self, *, urgent: bool = False) -> AsyncIterator[None]:
        """Wait for a turn; the block is the turn, and must not wait for anything."""
        if not self._is_free(urgent=urgent):
            await self._queue(self._urgent if urgent else self._waiting)
        with self._timed():
            yield

    def _is_free(self, *, urgent: bool) -> bool:
        return self._ended or (self._has_time() and (urgent or not self._waiting))

    def _has_time(self) -> bool:
        return self._left_s > 0.0 and asyncio.get_running_loop().time() < self._until_s

    async def _queue(self, queue: "deque[asyncio.Future[None]]") -> None:
        mine = asyncio.get_running_loop().create_future()
        queue.append(mine)
        try:
            await mine
        except asyncio.CancelledError:
            if mine.done() and not mine.cancelled():  # it was given and is not used: the next one shall have it
                self._pass_on()
            raise

    @contextlib.contextmanager
    def _timed(self) -> Iterator[None]:
        clock = asyncio.get_running_loop().time
        begun_s = clock()
        try:
            yield
        finally:
            taken_s = clock() - begun_s
            self._left_s -= taken_s
            self._longest_s = min(max(taken_s, _FORGETTING * self._longest_s), self._largest_s)
            self._pass_on()

    def _pass_on(self) -> None:
        if self._has_time():
            _wake_first(self._waiting)


def _wake_first(queue: "deque[asyncio.Future[None]]") -> bool:
    """Let the first one that still waits go on; return whether there was one."""
    while queue:
        future = queue.popleft()
        if not future.done():
            future.set_result(None)
            return True
    return False
