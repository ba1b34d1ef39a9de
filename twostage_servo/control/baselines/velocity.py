"""Where a law without observer gets its velocity from."""

from collections.abc import Callable

VelocitySource = Callable[[float], float]
"""Returns the velocity (axis unit/s) for the position sample of a tick (axis unit)."""


class Differentiator:
    """Velocity by the backward difference ``(y(k) - y(k-1)) / T_s``; 0 at the first sample.

    White noise of variance s² on y comes out with variance ``2 s² / T_s²``: that is what Fig. 2 (a) shows.
    """

    __slots__ = ("_before", "_period_s")

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._before: float | None = None

    def __call__(self, sample: float) -> float:
        """Process a sample in axis unit; return the velocity in axis unit/s."""
        before = sample if self._before is None else self._before
        self._before = sample
        return (sample - before) / self._period_s


def speed_sensor(read: Callable[[], float]) -> VelocitySource:
    """Return the second output of a 1 input 2 output plant: its velocity at the instant of the sample."""
    return lambda _sample: read()
