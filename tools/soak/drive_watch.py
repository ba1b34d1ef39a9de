"""What must hold of a drive that does not obey: whoever runs the axis is told, for as long as it lasts."""

from typing import Protocol

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import ENABLED
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.plant import MODEL_ERROR

_SLACK_TICKS = 4
"""A command acts a tick later, its report comes a tick after that, and both may have just been missed."""


class MovingDrive(Protocol):
    """What is looked at of a drive: the true axis, in axis unit and axis unit/s, and its power stage."""

    @property
    def position(self) -> float: ...  # noqa: D102

    @property
    def velocity(self) -> float: ...  # noqa: D102

    @property
    def enabled(self) -> bool: ...  # noqa: D102

    @property
    def effort(self) -> float: ...  # noqa: D102


class DriveWatch:
    """Looks at an axis whose drive is told to be disabled.

    Parameters
    ----------
    axis, drive
        The axis and its drive.

    Attributes
    ----------
    disobeyed
        Whether the drive has moved an axis that was disarmed, which may be anywhere until it has been armed again.
    """

    def __init__(self, axis: Axis, drive: MovingDrive) -> None:
        self._axis = axis
        self._drive = drive
        settings, design = axis.settings, axis.design
        # Reports that have waited do not count, and may be as old as the limit for that.
        waited = design.ticks(settings.limits.stale_feedback_ms)
        self._allowed_ticks = design.ticks(settings.arming_timeout_ms) + waited + _SLACK_TICKS
        self._ticks_enabled = 0
        self._ticks_heard = 0
        self._anchor: float | None = None  # where it was first seen since it was told to be disabled, in axis unit
        # The first samples tell the speed from which it coasts; one of them may be a spike.
        self._coasting = self._coasts(settings.limits.overspeed)
        self.disobeyed = False

    def rebooted(self) -> None:
        """Take notice that the axis has been told that its drive has rebooted: its encoder counts its way anew."""
        self._anchor = None
        self._ticks_heard = 0

    def moved_by_hand(self, before: float, after: float) -> None:
        """Take notice that somebody has moved the axis from a true place to another (axis unit): not its drive did."""
        if self._anchor is not None:
            self._anchor += after - before

    def check(self, *, reported: bool) -> str | None:
        """Check a tick in which the drive has reported, or not; return what is wrong, or None."""
        axis, drive = self._axis, self._drive
        if axis.state in ENABLED:
            self._ticks_enabled = 0
            self._anchor = None
            self.disobeyed = False
            return None
        if reported and self._anchor is None:
            self._anchor = drive.position
        self._ticks_heard = self._ticks_heard + 1 if reported else 0
        if drive.effort == 0.0 and not drive.enabled:
            self._ticks_enabled = 0
            return None
        self.disobeyed = True
        if drive.enabled:
            self._ticks_enabled += reported
            return self._say_enabled() if self._ticks_enabled > self._allowed_ticks else None
        return None if self._anchor is None else self._check_motion(drive.position - self._anchor)

    def _say_enabled(self) -> str | None:
        axis = self._axis
        told = (
            f"the drive has been told to disable, and has reported for {self._ticks_enabled} ticks that it is enabled"
        )
        if TripCode.DRIVE_NOT_DISABLED not in axis.trips:
            return f"{told}; the axis is {axis.state}, and its trips are {', '.join(axis.trips) or 'none'}"
        try:
            axis.check_reset()
        except Refused:
            return None
        return f"{told}, and a reset would be carried out"

    def _check_motion(self, moved: float) -> str | None:
        seen = self._ticks_heard > _SLACK_TICKS and abs(moved) > self._coasting + self._unseen()
        if not seen or self._axis.disabled.moved is not None:
            return None
        unit = self._axis.settings.unit
        return f"the axis is {self._axis.state} and has moved by {moved:.4g} {unit}, and nobody is told"

    def _coasts(self, speed: float) -> float:
        """Return how far an axis of this speed may go by itself: until it is told, and then against its friction."""
        design = self._axis.design
        return speed * (1.0 / (design.settings.plant.pole * (1.0 - MODEL_ERROR)) + _SLACK_TICKS * design.period_s)

    def _unseen(self) -> float:
        """Return how far it may go before that is seen: what a sample may be off, twice, and what it goes meanwhile."""
        limits = self._axis.settings.limits
        on_the_way = abs(self._drive.velocity) * _SLACK_TICKS * self._axis.design.period_s
        return 2.0 * limits.innovation_gate + on_the_way
