"""What came at another time than planned in a period, and the law that accounts for it."""

from typing import Final, NamedTuple, Protocol, runtime_checkable

from twostage_servo.control.laws.law import Law


class Timing(NamedTuple):
    """What was not in time in a period; nothing by default.

    Attributes
    ----------
    late_effort
        The mean effort that acted in it less the last one, in effort unit: until that one came, the one before acted.
    late_share
        Share of the period after which it came.
    lag_s
        How much older the sample is than the instant that it is given for, in s.
    dating
        What has been added to it for that, by the observer's estimate, in axis unit.
    """

    late_effort: float = 0.0
    late_share: float = 0.0
    lag_s: float = 0.0
    dating: float = 0.0

    @property
    def more_way(self) -> float:
        """The effort over the whole period, in effort unit, that makes up what the axis has gone beyond the mean's way.

        An effort u from the share s of a period on, and u' before it, have the mean u + s (u' - u); twice integrated
        they come to that of u + s (2 - s) (u' - u).
        """
        return (1.0 - self.late_share) * self.late_effort


IN_TIME: Final = Timing()


@runtime_checkable
class TimedLaw(Law, Protocol):
    """A law that accounts for what came at another time than planned."""

    def tell_timing(self, timing: Timing) -> None:
        """Tell of the period that the next :meth:`step` or :meth:`skip` accounts for; what is not told was in time."""
