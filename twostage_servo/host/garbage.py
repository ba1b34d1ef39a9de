"""Looks for cyclic garbage in the idle time after a tick, where Python would do so in the middle of one."""

import contextlib
import gc
import time
from collections.abc import Callable, Iterator
from typing import Final

_DUE: Final = 700
"""Objects made and not freed since the last collection, at which the next is due: Python's own threshold."""

_ROOM: Final = 3.0
"""How many times as long as the last collections took the idle time has to be."""

_FADING: Final = 0.9


@contextlib.contextmanager
def postponed() -> Iterator[None]:
    """Switch Python's own collections off, until the block ends or :func:`resume` is called.

    For the start of a service: what it makes stays, and to look for garbage in it again and again takes a twentieth of
    the start.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def resume() -> None:
    """Let Python collect at any time again."""
    gc.enable()


class GarbageCollection:
    """The collector of cyclic garbage, called by the loop.

    A full collection looks at every object there is: some 60 000 once the service has started, which takes several
    ticks. So those are exempt from the beginning (:func:`gc.freeze`). What has been made since is looked at in some
    tenths of a millisecond, always all of it.

    Parameters
    ----------
    collect, count, clock
        :func:`gc.collect`, the number of objects made and not freed since it was last called, a clock in s.

    Attributes
    ----------
    collections : int
        Collections after a tick so far.
    postponed : int
        Ticks after which one was due that did not fit.
    longest_s : float
        Longest collection after a tick so far.
    """

    def __init__(
        self,
        collect: Callable[[], int] = gc.collect,
        count: Callable[[], int] = lambda: gc.get_count()[0],
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._collect = collect
        self._count = count
        self._clock = clock
        self._expected_s = 0.0
        self.collections = 0
        self.postponed = 0
        self.longest_s = 0.0

    def begin(self) -> int:
        """Replace Python's own collections: collect, exempt what is left, and switch its own collections off.

        Returns
        -------
        int
            The number of objects that are exempt from now on.
        """
        self._collect()
        gc.freeze()
        gc.disable()
        self._timed()  # the first one of what is left tells how long the next will take
        return gc.get_freeze_count()

    def end(self) -> None:
        """Give it back to Python."""
        gc.unfreeze()
        gc.enable()

    def after_tick(self, idle_s: float, *, driven: bool) -> None:
        """Collect if that is due and fits into the idle time.

        Parameters
        ----------
        idle_s
            Time until the loop is to wake up for the next deadline, s.
        driven
            Whether the axis is driven. If it is not, a late tick moves nothing, and a collection may take its time.
        """
        if self._count() < _DUE:
            return
        if driven and _ROOM * self._expected_s > idle_s:
            self.postponed += 1
            self._expected_s *= _FADING  # one that took long once, on a busy host, must not end all of them
            return
        self.longest_s = max(self.longest_s, self._timed())
        self.collections += 1

    def _timed(self) -> float:
        begun_s = self._clock()
        self._collect()
        took_s = self._clock() - begun_s
        self._expected_s = max(took_s, self._expected_s * _FADING)
        return took_s
