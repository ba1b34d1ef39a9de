"""The drive's heartbeat: whether it still comes, and whether the drive has booted."""

import math
from dataclasses import dataclass

from twostage_servo.axis.settings import AxisSettings


@dataclass(slots=True)
class Heard:
    """What the heartbeat has told.

    Attributes
    ----------
    boot_counter
        The drive's own count of its boots, by the latest one that was heard; None where it does not tell.
    boots
        How often it has rebooted since the first.
    is_heard
        Whether one has come since the bus was opened.
    ticks_since
        Ticks since the latest.
    """

    boot_counter: int | None = None
    boots: int = 0
    is_heard: bool = False
    ticks_since: int = 0


class Heartbeat:
    """Follows the heartbeat of a drive.

    Parameters
    ----------
    settings
        Of the axis.
    period_s
        Length of a tick in s.
    expected
        Whether the drive has one, which is then missed from the first tick on.

    Attributes
    ----------
    state
        What it has told.
    """

    __slots__ = ("_expected", "_limit_ms", "_period_ms", "_ticks_allowed", "state")

    def __init__(self, settings: AxisSettings, period_s: float, *, expected: bool) -> None:
        self.state = Heard()
        self._expected = expected
        self._period_ms = 1e3 * period_s
        self._limit_ms = settings.limits.heartbeat_ms
        self._ticks_allowed = math.ceil(self._limit_ms / self._period_ms)

    def begin_tick(self, missed: int) -> None:
        """Open a tick, before which so many were missed."""
        self.state.ticks_since += 1 + missed

    def record(self, boot_counter: int | None, *, late: bool) -> bool:
        """Record one; return whether the drive has booted since the last. A late one is no sign of life."""
        state = self.state
        if not late:
            state.ticks_since, state.is_heard = 0, True
        before, state.boot_counter = state.boot_counter, boot_counter
        rebooted = before is not None and boot_counter is not None and boot_counter != before
        state.boots += rebooted
        return rebooted

    def continue_from(self, former: "Heartbeat") -> None:
        """Know what a former one of the same drive knew."""
        self.state = former.state

    def forget(self) -> None:
        """Start afresh, as after the bus was lost."""
        self.state.ticks_since, self.state.is_heard = 0, False

    @property
    def is_awaited(self) -> bool:
        """Whether the first has still to come."""
        return self._expected and not self.state.is_heard

    @property
    def loss(self) -> str | None:
        """What is to be said of a heartbeat that has not come for too long, or None."""
        if not self._expected or self.state.ticks_since < self._ticks_allowed:
            return None
        return (
            f"no heartbeat from the drive for {self._period_ms * self.state.ticks_since:g} ms; "
            f"axis.limits.heartbeat_ms is {self._limit_ms:g}"
        )
