"""The fixed tick: absolute deadlines on the running loop's clock, the same in real and in simulated time."""

import asyncio
import math
import selectors
from dataclasses import dataclass
from typing import Final, Protocol, Self

# The loop runs a timer up to its clock resolution early; such a wake-up still belongs to its deadline.
_EARLY_PERIODS = 1e-6

_LEAD_S: Final = 20e-6
"""The busy-wait of :class:`Ticks` ends this much early, since the way from it to the body of the tick takes some
microseconds; :meth:`Ticks.begin` waits for the rest."""

_STANDING_READS: Final = 1000
"""Equal readings of the clock in a row at which it counts as standing still: a real one moves on with each of them."""


class WakeMargin(Protocol):
    """How long before a deadline the timer is to wake :class:`Ticks`, which then wait busily until the deadline.

    Only for a loop that runs in real time: in simulated time there is nothing to wait for but the deadline itself.
    """

    @property
    def margin_s(self) -> float:
        """The margin for the next tick, s, not negative."""

    def learn(self, wake_latency_s: float) -> None:
        """Adapt to how long after the requested time a timer woke the task, s. Called once a tick, in the loop."""


@dataclass(slots=True)  # not frozen: that takes a microsecond, between the deadline and the body of the tick
class Tick:
    """One pass of the loop.

    Attributes
    ----------
    index : int
        Whole periods since the start; the deadline is ``start_s + index * period_s``.
    deadline_s : float
        When the tick was due, on the loop's clock.
    lateness_s : float
        How long after `deadline_s` it began, never negative. The periods in `missed` are not in it.
    missed : int
        Deadlines that passed unserved since the tick before. This index is the last one's plus ``1 + missed``.
    """

    index: int
    deadline_s: float
    lateness_s: float
    missed: int


class Ticks:
    """Asynchronous iterator of ticks, to be run through once by one task.

    A late tick keeps the phase: it is served with the newest deadline that has passed, the older ones are skipped and
    counted. There is never a burst, and the index never lags behind the clock.

    Parameters
    ----------
    period_s : float
        Period, s.
    start_s : float, optional
        Loop time of index 0, which is not itself served: the first tick is due one period later. By default the time at
        which the iteration begins. One that lies in the past makes the first tick count what it missed.
    margin : WakeMargin, optional
        Wake early by this margin and wait busily until the deadline, which is more punctual than the host's timers.
        None, the default, lets the timer itself serve the deadline; it is the only choice that makes sense in
        simulated time.

    Attributes
    ----------
    margin : WakeMargin or None
        As given.

    Raises
    ------
    ValueError
        If the period is not finite and greater than 0.
    """

    __slots__ = ("_index", "_start_s", "_stopped", "_waiter", "margin", "period_s")

    def __init__(self, period_s: float, start_s: float | None = None, margin: WakeMargin | None = None) -> None:
        if not (math.isfinite(period_s) and period_s > 0):
            raise ValueError(f"tick period {period_s} s: a finite number greater than 0 is needed")
        self.period_s = period_s
        self.margin = margin
        self._start_s = start_s
        self._index = 0
        self._stopped = False
        self._waiter: asyncio.Future[None] | None = None

    def __aiter__(self) -> Self:
        """Give the iterator itself."""
        return self

    async def __anext__(self) -> Tick:
        """Wait for the next deadline.

        An overdue tick goes through the loop as well, so that a body slower than its period cannot starve other tasks.
        """
        if self._stopped:
            raise StopAsyncIteration
        loop = asyncio.get_running_loop()
        start_s = self._start_s
        if start_s is None:
            start_s = self._start_s = loop.time()
        expected = self._index + 1
        deadline_s = start_s + expected * self.period_s
        if self.margin is None:
            await self._wait(loop, deadline_s)
            now_s = loop.time()
        else:
            await self._wait_early(loop, deadline_s, self.margin)
            busy_end_s = deadline_s - _LEAD_S
            now_s = busy_wait(loop, busy_end_s)
            if now_s < busy_end_s:
                await self._wait(loop, deadline_s)
                now_s = loop.time()
        if now_s - deadline_s < 0.5 * self.period_s:  # what is punctual shall begin without more ado
            self._index = expected
            return Tick(expected, deadline_s, max(0.0, now_s - deadline_s), 0)
        index = max(expected, math.floor((now_s - start_s) / self.period_s + _EARLY_PERIODS))
        self._index = index
        deadline_s = start_s + index * self.period_s
        return Tick(index, deadline_s, max(0.0, now_s - deadline_s), index - expected)

    def begin(self, tick: Tick) -> float:
        """Let the deadline come and stamp the tick, as the first thing in its body; return the loop's time in s.

        With a margin the wait for a tick ends a little early, since it takes some microseconds until the body runs, and
        never the same: what is left of them is spun away here. A tick that is not begun has the lateness with which the
        wait for it ended.
        """
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        if self.margin is not None and now_s < tick.deadline_s:
            now_s = busy_wait(loop, tick.deadline_s)
        tick.lateness_s = max(0.0, now_s - tick.deadline_s)
        return now_s

    @property
    def margin_s(self) -> float:
        """How long before the next deadline the timer is to wake, s; 0 without a margin."""
        return 0.0 if self.margin is None else self.margin.margin_s

    async def _wait(self, loop: asyncio.AbstractEventLoop, when_s: float) -> None:
        waiter = self._waiter = loop.create_future()
        timer = loop.call_at(when_s, _wake, waiter)
        try:
            await waiter
        finally:
            timer.cancel()
            self._waiter = None
        if self._stopped:
            raise StopAsyncIteration

    async def _wait_early(self, loop: asyncio.AbstractEventLoop, deadline_s: float, margin: WakeMargin) -> None:
        """Wake up by the margin before the deadline, and tell it how late that was."""
        when_s = deadline_s - margin.margin_s
        slept = loop.time() < when_s  # what comes of an overdue timer says nothing about the host's wake-ups
        await self._wait(loop, when_s)
        if slept:
            margin.learn(loop.time() - when_s)

    def stop(self) -> None:
        """End the iteration for good, also one that waits just now. Call it from the loop's thread."""
        self._stopped = True
        if self._waiter is not None:
            _wake(self._waiter)


def _wake(waiter: "asyncio.Future[None]") -> None:
    if not waiter.done():
        waiter.set_result(None)


def busy_wait(loop: asyncio.AbstractEventLoop, until_s: float) -> float:
    """Read the loop's clock until it says so; give its last reading, which is short of that if the clock stands still.

    Parameters
    ----------
    loop
        The running loop.
    until_s
        The time to wait for, on the loop's clock in s.
    """
    time = loop.time
    last_s, standing = time(), 0
    while (now_s := time()) < until_s:
        if now_s != last_s:
            last_s, standing = now_s, 0
        else:
            standing += 1
            if standing >= _STANDING_READS:
                break
    return now_s


def real_time_loop() -> asyncio.SelectorEventLoop:
    """Make an event loop that waits in ``select``: epoll rounds a wait up to whole milliseconds, a tenth of a tick."""
    return asyncio.SelectorEventLoop(selectors.SelectSelector())
