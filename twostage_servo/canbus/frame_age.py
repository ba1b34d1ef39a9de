"""The age of received frames by their time stamps, where those can be compared with a clock of this machine."""

import time
from collections.abc import Callable
from typing import Final, TypeAlias

import can

Clock: TypeAlias = Callable[[], float]

_ROUNDING_S: Final = 1e-6
"""Seconds since 1970 are rounded to 0.24 us as a float; a frame that came just now may seem to come from the future."""
_BACKLOG_S: Final = 1.0
"""A frame may have waited for longer than since the drain before, when that one ended at its bound."""
_STEP_S: Final = 1e-3
"""By how much two clocks may disagree on the time between two drains, and..."""
_DRIFT: Final = 1e-3
"""...by how much per second: twice what a clock being slewed by NTP or adjtime does."""


def stamp_clock(bus: can.BusABC, interface: str) -> tuple[Clock, Clock] | None:
    """Find the clock that stamps the frames of a bus.

    Returns
    -------
    tuple of two callables, or None
        The clock of the stamps, and one that is monotonic, both in s: a bus's own ``clock`` serves as both, SocketCAN
        stamps by the wall clock. None when nothing is known about the stamps, which may then be of any origin.
    """
    own: Clock | None = getattr(bus, "clock", None)
    if own is not None:
        return own, own
    return (time.time, time.monotonic) if interface == "socketcan" else None


class FrameAge:
    """Tells the age of frames at the time of the drain that brought them.

    Parameters
    ----------
    stamps
        Clock of the time stamps, s.
    monotonic
        A clock that is never set, s. Where the two disagree on the time between two drains, the first one has been set,
        and no age is told.
    """

    __slots__ = ("_bound_s", "_elapsed_s", "_monotonic", "_monotonic_s", "_stamps", "_stamps_s")

    def __init__(self, stamps: Clock, monotonic: Clock) -> None:
        self._stamps = stamps
        self._monotonic = monotonic
        self._stamps_s = stamps()
        self._monotonic_s = monotonic()
        self._bound_s = self._elapsed_s = 0.0

    def drained(self) -> None:
        """Note that frames have been drained just now."""
        stamps_s, monotonic_s = self._stamps(), self._monotonic()
        elapsed_s = self._elapsed_s = monotonic_s - self._monotonic_s
        step_s = stamps_s - self._stamps_s - elapsed_s
        self._bound_s = elapsed_s + _BACKLOG_S if abs(step_s) <= _STEP_S + _DRIFT * elapsed_s else -1.0
        self._stamps_s, self._monotonic_s = stamps_s, monotonic_s

    def age_s(self, timestamp: float) -> float | None:
        """Return the age at the latest :meth:`drained` of a frame with this time stamp; None if it makes no sense."""
        age_s = self._stamps_s - timestamp
        return max(age_s, 0.0) if -_ROUNDING_S <= age_s <= self._bound_s else None

    def waited_s(self, timestamp: float) -> float | None:
        """Return for how long a frame had been there, unread, at the drain before the latest; None without an age."""
        age_s = self.age_s(timestamp)
        return None if age_s is None else max(0.0, age_s - self._elapsed_s)
