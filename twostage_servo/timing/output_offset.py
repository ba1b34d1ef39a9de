"""How long after the deadline of a tick the commands leave, so that the drive gets them at even intervals.

What the arithmetic before a command takes varies from tick to tick. A command that waits for a fixed time after the
deadline does not show it: this is the output at a fixed instant of a logical execution time (T. A. Henzinger,
B. Horowitz, C. M. Kirsch: Giotto, Proceedings of the IEEE 91, 2003).
"""

from typing import Final, Literal, Protocol

from twostage_servo.timing.wake_margin import LARGEST_MARGIN_S, LARGEST_SHARE

_DECAY_S: Final = 0.1e-6
"""By so much each command that is ready in time lets the offset sink: 10 µs a second with a tick of 10 ms."""
_LARGEST_STEP_S: Final = 50e-6
"""What a single outlier can cost: it is waited off within 5 s, and no longer, however late it was."""
_FIRST_OFFSET_S: Final = 150e-6


class OutputOffset(Protocol):
    """How long after the deadline of a tick its commands leave; they leave later if they are not ready by then."""

    @property
    def offset_s(self) -> float:
        """The offset for the next tick, s, not negative."""

    def learn(self, ready_s: float) -> None:
        """Adapt to how long after the deadline the commands of a tick were ready, s."""


class LearnedOffset:
    """Offset at which commands are late by 0.1 µs in the mean of all ticks, where at most 50 µs count of each.

    A command that is not ready in time moves the offset up to where it was ready, but by 50 µs at most; each that is
    lets it sink by 0.1 µs. So the offset rests where both come to the same (stochastic approximation, Robbins and
    Monro, 1951, of the level that the times exceed by 0.1 µs in the mean): where they have an exponential tail with a
    mean of 20 µs, one command in 200 is late. The next one leaves as long after its deadline as the late one did, so
    each costs one interval, not two: with the 99.5 % quantile in its place, approached in steps of 8 µs, the 99th
    percentile of the intervals' deviation was twice to three times as large (measured in a virtual machine).

    A time above the cap is not learnt from, as with the margin of the wake-up: no offset would have made up for it.

    Parameters
    ----------
    period_s
        Period of the ticks, s; the offset is at most a tenth of it, and at most 1 ms.

    Attributes
    ----------
    offset_s : float
        The offset for the next tick, s.
    """

    __slots__ = ("_largest_s", "offset_s")

    def __init__(self, period_s: float) -> None:
        self._largest_s = min(LARGEST_MARGIN_S, LARGEST_SHARE * period_s)
        self.offset_s = min(_FIRST_OFFSET_S, self._largest_s)

    def learn(self, ready_s: float) -> None:
        """Adapt to one time, s after the deadline."""
        late_s = ready_s - self.offset_s
        if late_s <= 0.0:
            self.offset_s = max(0.0, self.offset_s - _DECAY_S)
        elif ready_s <= self._largest_s:
            self.offset_s += min(late_s, _LARGEST_STEP_S)


class FixedOffset:
    """Offset that stays as it is.

    Parameters
    ----------
    offset_s
        The offset, s.
    period_s
        Period of the ticks, s; the offset is at most half of it.
    """

    __slots__ = ("offset_s",)

    def __init__(self, offset_s: float, period_s: float) -> None:
        self.offset_s = min(offset_s, 0.5 * period_s)

    def learn(self, ready_s: float) -> None:
        """Do nothing."""


def output_offset(
    asked: Literal["off", "auto"] | float, busy_wait: Literal["off", "auto"] | float, period_s: float
) -> OutputOffset | None:
    """Return the offset that ``realtime.output_offset`` asks for, for a loop that runs in real time.

    ``"auto"`` without a busy-wait before the tick means none: the ticks are uneven then, and whoever saves that
    processor time does not want to spend it here.

    Parameters
    ----------
    asked
        ``"off"``, ``"auto"``, or the offset in µs.
    busy_wait
        What ``realtime.busy_wait`` asks for; see :func:`twostage_servo.timing.wake_margin.wake_margin`.
    period_s
        Period of the ticks, s.
    """
    if isinstance(asked, str):
        return LearnedOffset(period_s) if asked == "auto" and busy_wait != "off" else None
    return FixedOffset(1e-6 * asked, period_s) if asked > 0.0 else None
