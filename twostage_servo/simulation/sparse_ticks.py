"""The firmware cycles of a simulated drive in simulated time, without those in which nothing happens."""

import asyncio
import math
from collections.abc import Callable

from twostage_servo.timing.ticks import Tick, Ticks

_EARLY_PERIODS = 1e-6


class SparseTicks(Ticks):
    """Ticks on the grid of the cycle, of which those are left out that nothing is due in.

    The one before a deadline is served as well, so that what is due at the same instant as something else keeps its
    order: as it would with every tick, its timer is set one period before.

    Parameters
    ----------
    period_s
        Period, s.
    due_s
        Gives the loop's time at which something is due next, in s; it may lie in the past.
    """

    __slots__ = ("_due_s",)

    def __init__(self, period_s: float, due_s: Callable[[], float]) -> None:
        super().__init__(period_s)
        self._due_s = due_s

    async def __anext__(self) -> Tick:
        """Wait for the next tick that is needed."""
        loop = asyncio.get_running_loop()
        if self._start_s is None:
            self._start_s = loop.time()
        while not self._stopped:
            now_s, first = loop.time(), self._index + 1
            # A tick that has passed unneeded is gone, as an idle one would be.
            first = max(first, math.ceil((now_s - self._start_s) / self.period_s - _EARLY_PERIODS))
            due = self._due_s()
            index = first
            if due > now_s:
                index = max(first, math.ceil((due - self._start_s) / self.period_s - _EARLY_PERIODS) - 1)
            deadline_s = self._start_s + index * self.period_s
            await self._wait(loop, deadline_s)
            if loop.time() >= deadline_s - _EARLY_PERIODS * self.period_s:
                self._index = index
                return Tick(index, deadline_s, max(0.0, loop.time() - deadline_s), 0)
        raise StopAsyncIteration

    def wake(self) -> None:
        """Look again when the next tick is due: something has come, or has changed."""
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)
