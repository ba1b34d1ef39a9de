"""Simulated time: an event loop whose clock jumps to the next timer instead of waiting for it."""

import asyncio
import contextvars
import heapq
import math
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar, TypeVarTuple, Unpack

_Result = TypeVar("_Result")
_Arguments = TypeVarTuple("_Arguments")


class DeadlockError(RuntimeError):
    """Every task waits for another: no timer, callback or file descriptor is left that could wake one of them."""


class VirtualClockLoop(asyncio.SelectorEventLoop):
    """Selector event loop in simulated time, which begins at 0.0 s and costs none to wait for.

    Real file descriptors work: whenever one of them is ready, time stands still until it has been served. Timers of the
    same nanosecond run in the order in which they were scheduled, and functions for an executor run in the caller's
    thread, so that the same program takes the same course in every run.
    """

    _scheduled: list[asyncio.TimerHandle]  # asyncio's heap of timers

    def __init__(self) -> None:
        self._now_s = 0.0
        self._timers_made = 0
        super().__init__(_ClockSelector(self._jump_to_next_timer))

    def time(self) -> float:
        """Give the simulated time, s."""
        return self._now_s

    def _jump_to_next_timer(self) -> None:
        # Not "now + timeout": that sum may miss the deadline by a rounding.
        self._now_s = max(self._now_s, self._scheduled[0].when())
        # asyncio runs what is due before now + resolution: after 97 days a nanosecond would be lost in that sum.
        self._clock_resolution = max(1e-9, math.ulp(self._now_s))

    def call_at(
        self,
        when: float,
        callback: Callable[[Unpack[_Arguments]], object],
        *args: *_Arguments,
        context: contextvars.Context | None = None,
    ) -> asyncio.TimerHandle:
        """Schedule a callback as asyncio does, behind those already scheduled for the same time.

        asyncio's own heap does not keep the order of equal deadlines.
        """
        if self.is_closed():
            raise RuntimeError("Event loop is closed")
        self._timers_made += 1
        timer = _OrderedTimer(self._timers_made, when, callback, args, self, context)
        heapq.heappush(self._scheduled, timer)
        return timer

    def run_in_executor(
        self,
        executor: object,  # noqa: ARG002 - a thread would end at an unpredictable simulated time, so none is used
        func: Callable[[Unpack[_Arguments]], _Result],
        *args: *_Arguments,
    ) -> asyncio.Future[_Result]:
        """Call `func` at once, in this thread; the future that is returned is done."""
        done: asyncio.Future[_Result] = self.create_future()
        try:
            done.set_result(func(*args))
        except Exception as error:  # noqa: BLE001 - it is not swallowed: whoever awaits the future gets it
            done.set_exception(error)
        return done


def run(main: Coroutine[Any, Any, _Result]) -> _Result:
    """Run a coroutine to its end in simulated time, as :func:`asyncio.run` does in real time.

    Raises
    ------
    DeadlockError
        If every task waits and nothing is left that could wake one.
    """
    with asyncio.Runner(loop_factory=VirtualClockLoop) as runner:
        return runner.run(main)


class _OrderedTimer(asyncio.TimerHandle):
    """A timer that gives way to those scheduled before it for the same nanosecond.

    Nominally equal deadlines (7 * 10 ms and 70 * 1 ms) differ by a rounding, which must not decide on the order.
    """

    __slots__ = ("_rank",)

    def __init__(
        self,
        number: int,
        when: float,
        callback: Callable[..., object],
        args: tuple[Any, ...],
        loop: asyncio.AbstractEventLoop,
        context: contextvars.Context | None,
    ) -> None:
        super().__init__(when, callback, args, loop, context)
        self._rank = (round(when, 9), number)
        self._scheduled = True  # asyncio counts the cancelled ones among those scheduled

    def __lt__(self, other: object) -> bool:
        return self._rank < other._rank if isinstance(other, _OrderedTimer) else NotImplemented


class _ClockSelector(selectors.SelectSelector):
    """A selector that looks at its file descriptors and then lets the clock jump instead of waiting."""

    def __init__(self, jump_to_next_timer: Callable[[], None]) -> None:
        super().__init__()
        self._jump_to_next_timer = jump_to_next_timer

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            if len(self.get_map()) <= 1:  # the loop's own self-pipe
                raise DeadlockError(
                    "deadlock in simulated time: every task waits, and no timer, callback or open connection is left "
                    "that could wake one; look for a future, queue or event that nobody sets"
                )
            return super().select(None)
        events = super().select(0)
        if timeout > 0 and not events:
            self._jump_to_next_timer()
        return events
