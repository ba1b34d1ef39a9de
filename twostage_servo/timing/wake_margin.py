"""How early a timer has to wake for a tick to be punctual: learnt from the host's own wake-up latency, or fixed."""

import math
from typing import Final, Literal

from twostage_servo.timing.ticks import WakeMargin

LARGEST_MARGIN_S: Final = 1e-3
LARGEST_SHARE: Final = 0.1
"""Cap of the learnt margin, s and of the period: what spinning may cost at the very most."""

_QUANTILE: Final = 0.95
_GAIN: Final = 0.1
_SMALLEST_MARGIN_S: Final = 5e-6
_FIRST_MARGIN_S: Final = 250e-6


class LearnedMargin:
    """Margin that follows the 95 % quantile of the wake-up latency: an early enough wake-up in 19 of 20 ticks.

    Stochastic approximation (Robbins and Monro, 1951) of the quantile in the logarithm: a latency above the margin
    multiplies it by exp(0.1 · 0.95), one below by exp(-0.1 · 0.05). It rests where the first comes once in 20 ticks.
    One outlier raises it by 10 % at most; a host that becomes three times slower is followed within 12 ticks, one that
    becomes three times quicker within 220.

    A latency above the cap is not learnt from: no margin within the cap would have made that tick punctual, and while a
    loaded host has many of them, a margin at the cap would only add to its load.

    Parameters
    ----------
    period_s
        Period of the ticks, s; the margin is at most a tenth of it, and at most 1 ms.

    Attributes
    ----------
    margin_s : float
        The margin for the next tick, s.
    """

    __slots__ = ("_largest_s", "_smallest_s", "margin_s")

    _UP: Final = math.exp(_GAIN * _QUANTILE)
    _DOWN: Final = math.exp(-_GAIN * (1.0 - _QUANTILE))

    def __init__(self, period_s: float) -> None:
        self._largest_s = min(LARGEST_MARGIN_S, LARGEST_SHARE * period_s)
        self._smallest_s = min(_SMALLEST_MARGIN_S, self._largest_s)
        self.margin_s = min(_FIRST_MARGIN_S, self._largest_s)

    def learn(self, wake_latency_s: float) -> None:
        """Adapt to one wake-up latency, s."""
        margin_s = self.margin_s
        if wake_latency_s <= margin_s:
            self.margin_s = max(self._smallest_s, margin_s * self._DOWN)
        elif wake_latency_s <= self._largest_s:
            self.margin_s = min(self._largest_s, margin_s * self._UP)


class FixedMargin:
    """Margin that stays as it is.

    Parameters
    ----------
    margin_s
        The margin, s.
    period_s
        Period of the ticks, s; the margin is at most half of it.
    """

    __slots__ = ("margin_s",)

    def __init__(self, margin_s: float, period_s: float) -> None:
        self.margin_s = min(margin_s, 0.5 * period_s)

    def learn(self, wake_latency_s: float) -> None:
        """Do nothing."""


def wake_margin(busy_wait: Literal["off", "auto"] | float, period_s: float) -> WakeMargin | None:
    """Return the margin that ``realtime.busy_wait`` asks for, for a loop that runs in real time.

    Parameters
    ----------
    busy_wait
        ``"off"``, ``"auto"``, or the margin in µs.
    period_s
        Period of the ticks, s.
    """
    if isinstance(busy_wait, str):
        return LearnedMargin(period_s) if busy_wait == "auto" else None
    return FixedMargin(1e-6 * busy_wait, period_s) if busy_wait > 0.0 else None
