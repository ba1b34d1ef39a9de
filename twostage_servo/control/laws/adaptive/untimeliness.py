"""How untimely efforts and samples have been of late: what acts or is seen at another time than planned is a delay."""

from typing import Final

from twostage_servo.control.laws.timing import IN_TIME, Timing

_MOST: Final = 0.1
"""How late efforts may be, and how old samples, as a share of a period, for loops as quick as the tick allows."""

_KEPT: Final = 0.995
"""What is left of it a period later: a host that has been late is expected to be so again for some hundred periods."""


class Untimeliness:
    """The largest share of a period by which anything was untimely, fading; give it each period once.

    Parameters
    ----------
    period_s
        The tick, in s.

    Attributes
    ----------
    is_large
        Whether loops have to be slower for it.
    """

    __slots__ = ("_period_s", "_share", "is_large")

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._share = 0.0
        self.is_large = False

    def update(self, timing: Timing) -> bool:
        """Account for a period; return whether it has become large with it."""
        if timing is IN_TIME and not self._share:
            return False
        was_large = self.is_large
        now = max(timing.late_share, abs(timing.lag_s) / self._period_s)
        self._share = max(now, _KEPT * self._share)
        self.is_large = self._share > _MOST
        return self.is_large and not was_large
