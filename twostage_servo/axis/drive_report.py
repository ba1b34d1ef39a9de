"""What the axis knows of its drive: the newest feedback, how old it is, and what it says of the drive's state."""

import math

from twostage_servo.axis.feedback import FeedbackMonitor
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.trips import TripCode


class DriveReport:
    """Keeps the newest fresh feedback of the drive.

    Parameters
    ----------
    settings
        Limits and time-outs of the axis.
    period_s
        Length of a tick in s.
    counter_modulus
        Number of values of the feedback's alive counter.

    Attributes
    ----------
    position
        Position of the newest fresh feedback, in axis unit; None before the first and after the bus was lost.
    enabled
        Whether the drive says it is enabled; None where it does not tell.
    fault_code
        The drive's fault code while it reports a fault, else None.
    fresh
        Whether this tick had fresh feedback.
    monitor
        The alive counter's bookkeeping.
    """

    def __init__(self, settings: AxisSettings, period_s: float, counter_modulus: int) -> None:
        self.monitor = FeedbackMonitor(counter_modulus)
        self.position: float | None = None
        self.enabled: bool | None = None
        self.fault_code: int | None = None
        self.fresh = False
        self._ticks_since_foreign: int | None = None
        self._settings = settings
        self._period_ms = 1e3 * period_s
        self._stale_ticks = math.ceil(settings.limits.stale_feedback_ms / self._period_ms)
        self._foreign_ticks = math.ceil(settings.arming_timeout_ms / self._period_ms)

    def begin_tick(self, missed: int) -> None:
        """Let everything known grow older by this tick and those missed before it."""
        self.fresh = False
        self.monitor.begin_tick(missed)
        if self._ticks_since_foreign is not None:
            self._ticks_since_foreign += 1 + missed

    def take(self, position: float, enabled: bool | None, fault_code: int | None) -> None:
        """Take fresh feedback with a finite position; a fault or drop-out in an earlier frame of this tick stays."""
        if self.fresh:
            enabled = False if self.enabled is False else enabled
            fault_code = fault_code if self.fault_code is None else self.fault_code
        self.fresh = True
        self.position = position
        self.enabled = enabled
        self.fault_code = fault_code

    def notice_foreign_command(self) -> None:
        """Remember that somebody else commands the drive."""
        self._ticks_since_foreign = 0

    def forget(self) -> None:
        """Start afresh, as after the bus was lost."""
        self.monitor.forget()
        self.position = self.enabled = self.fault_code = None

    @property
    def is_stale(self) -> bool:
        """Whether the last fresh feedback is as old as the limit, or there has been none."""
        age = self.monitor.ticks_since_fresh
        return age is None or age >= self._stale_ticks

    def trouble(self, *, arming: bool) -> tuple[TripCode, str] | None:
        """Return code and cause of what must trip an enabled axis, or None."""
        if self.is_stale:
            age_ms = self._period_ms * (self.monitor.ticks_since_fresh or 0)
            return (
                TripCode.STALE_FEEDBACK,
                (
                    f"no fresh feedback from the drive for {age_ms:g} ms; axis.limits.stale_feedback_ms is "
                    f"{self._settings.limits.stale_feedback_ms:g}"
                ),
            )
        if self.fault_code is not None:
            return TripCode.DRIVE_FAULT, f"the drive reports fault code {self.fault_code}"
        if self.enabled is False and not arming:
            return TripCode.DRIVE_DROPPED_OUT, "the drive reports that it is no longer enabled"
        return None

    def obstacle_to_arming(self) -> tuple[str, str] | None:
        """Return code and text of what on the drive's side keeps the axis from being armed, or None."""
        if self.position is None or self.is_stale:
            return (
                "no_feedback",
                "there is no fresh feedback from the drive: check its supply, its bus and its identifiers.",
            )
        if self._ticks_since_foreign is not None and self._ticks_since_foreign < self._foreign_ticks:
            return (
                "foreign_command",
                "another node on the bus commands this drive: end the other service or tool first.",
            )
        if self.fault_code is not None:
            return "drive_fault", f"the drive reports fault code {self.fault_code}: remove its cause first."
        if self.enabled is True:
            return "still_enabled", "the drive has not been disabled yet: ask again."
        return None
