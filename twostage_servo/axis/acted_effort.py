"""Which effort has acted since the last tick: not always the one that the law gave last.

A command that a busy host sends late acts late, and the one before acts until then; one that the bus has not taken
never acts. What is taken for what has acted is compared with how the axis has moved, tick by tick.
"""

from typing import Final

from twostage_servo.axis.sample_date import SampleDate
from twostage_servo.control.laws.law import Law
from twostage_servo.control.laws.timing import TimedLaw, Timing

_IN_TIME: Final = 0.005
"""Share of a period up to which something counts as in time: what that does to the speed, no encoder shows."""


class ActedEffort:
    """Follows the efforts of a law.

    Parameters
    ----------
    law
        That gives them; one that accounts for late ones is told.
    date
        Dates this tick's sample.
    period_s
        Length of a tick in s.

    Attributes
    ----------
    last, before
        The last two efforts, in effort unit.
    """

    __slots__ = ("_date", "_largest_lag_s", "_late_share", "_law", "before", "last")

    def __init__(self, law: Law, date: SampleDate, period_s: float) -> None:
        self._law = law if isinstance(law, TimedLaw) else None
        self._date = date
        self._largest_lag_s = _IN_TIME * period_s
        self._late_share = 0.0
        self.last = self.before = 0.0

    def start(self, effort: float) -> None:
        """Begin with an effort (effort unit) that has acted for long."""
        self.last = self.before = effort

    def give(self, effort: float) -> None:
        """Take the next effort, in effort unit."""
        self.before, self.last = self.last, effort

    def begin_late(self, share: float) -> None:
        """Take the last effort to begin to act late, by a share of a period."""
        self._late_share = share if share > _IN_TIME else 0.0

    @property
    def mean(self) -> float:
        """What has acted since the last tick, in effort unit: it has the same effect on the speed.

        What the way differs by is at most a quarter of what the speed makes of it in a period.
        """
        return self.last + self._late_share * (self.before - self.last)

    def tell_law(self) -> None:
        """Tell the law what was not in time, if anything was; from here on the effort acts in time."""
        share, self._late_share = self._late_share, 0.0
        lag_s = self._date.lag_s
        if self._law is not None and (share or abs(lag_s) > self._largest_lag_s):
            self._law.tell_timing(Timing(share * (self.before - self.last), share, lag_s, self._date.dating))
