"""How long after the deadline of a tick the commands leave, so that the drive gets them at even intervals.

What the arithmetic before a command takes varies from tick to tick. A command that waits for a fixed time after the
deadline does not show it: this is the output at a fixed instant of a logical execution time (T. A. Henzinger,
B. Horowitz, C. M. Kirsch: Giotto, Proceedings of the IEEE 91, 2003).
"""

from typing import Final, Protocol

from twostage_servo.host.settings import RealtimeSettings
from twostage_servo.host.wake_margin import LARGEST_MARGIN_S, LARGEST_SHARE

_QUANTILE: Final = 0.995
_LARGEST_GAIN_S: Final = 64e-6
_GAIN_S: Final = 8e-6
_SHRINKING: Final = 0.98
"""Of the gain, from each time to the next: the smallest is reached from the largest in 103 ticks."""
_FIRST_OFFSET_S: Final = 150e-6


class SendOffset(Protocol):
    """How long after the deadline of a tick its commands leave; they leave later if they are not ready by then."""

    @property
    def offset_s(self) -> float:
        """The offset for the next tick, s, not negative."""

    def learn(self, ready_s: float) -> None:
        """Take in how long after the deadline the commands of a tick were ready, s."""


class LearnedOffset:
    """Offset that follows the 99.5 % quantile of the times at which the commands are ready.

    Stochastic approximation (Robbins and Monro, 1951): a command that is ready too late moves the offset up by 7.96 µs,
    one in time moves it down by 0.04 µs, so it rests where the first comes once in 200 ticks. The steps are as small as
    they are because each of them changes an interval, too. They are larger at first, and they double when one command
    after another is late, as on a host that has got other work to do: so the new offset is there within a few ticks.

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

    __slots__ = ("_gain_s", "_largest_s", "offset_s")

    def __init__(self, period_s: float) -> None:
        self._largest_s = min(LARGEST_MARGIN_S, LARGEST_SHARE * period_s)
        self._gain_s = _LARGEST_GAIN_S
        self.offset_s = min(_FIRST_OFFSET_S, self._largest_s)

    def learn(self, ready_s: float) -> None:
        """Take in one time, s after the deadline."""
        if ready_s <= self.offset_s:
            self.offset_s = max(0.0, self.offset_s - self._gain_s * (1.0 - _QUANTILE))
        elif ready_s <= self._largest_s:
            self.offset_s = min(self._largest_s, self.offset_s + self._gain_s * _QUANTILE)
            self._gain_s = min(_LARGEST_GAIN_S, 2.0 * self._gain_s)
        self._gain_s = max(_GAIN_S, self._gain_s * _SHRINKING)


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


def send_offset(settings: RealtimeSettings, period_s: float) -> SendOffset | None:
    """Return the offset that ``realtime.send_at`` asks for, for a loop that runs in real time.

    ``"auto"`` without a spin before the tick is none: the ticks are not even then, and who spares the processor that
    spin does not want another one.

    Parameters
    ----------
    settings
        The table ``[realtime]``.
    period_s
        Period of the ticks, s.
    """
    if isinstance(settings.send_at, str):
        return LearnedOffset(period_s) if settings.send_at == "auto" and settings.spin != "off" else None
    return FixedOffset(1e-6 * settings.send_at, period_s) if settings.send_at > 0.0 else None
