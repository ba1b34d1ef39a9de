"""From a disarmed axis to one that holds its place: what has to be there first, and what is waited for."""

from twostage_servo.axis.admission import Admission
from twostage_servo.axis.count_watch import CountWatch
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.operation import Operation
from twostage_servo.axis.reference import Reference
from twostage_servo.axis.refusals import Obstacle, RefusalCode
from twostage_servo.axis.state import ENABLED, Event
from twostage_servo.axis.state_machine import StateMachine
from twostage_servo.axis.supervision import Supervision
from twostage_servo.axis.trip_latch import TripLatch
from twostage_servo.axis.trips import TripCode

_DISABLED_TICKS = 2
"""Disable commands that must have left before the axis may be armed: one may have been lost."""


class Obstacles:
    """Tells what keeps a disarmed axis from being armed.

    Parameters
    ----------
    machine
        The state of the axis.
    drive, count, reference
        What its drive reports, whether that still counts from the same place, and on what positions rest.
    admission
        The checks that stand before every request.
    """

    __slots__ = ("_admission", "_count", "_disabled_ticks", "_drive", "_machine", "_reference")

    def __init__(
        self,
        machine: StateMachine,
        drive: DriveReport,
        count: CountWatch,
        reference: Reference,
        admission: Admission,
    ) -> None:
        self._machine = machine
        self._drive = drive
        self._count = count
        self._reference = reference
        self._admission = admission
        self._disabled_ticks = 0

    def count_tick(self) -> None:
        """Close a tick: count the disable commands that have left in a row."""
        self._disabled_ticks = 0 if self._machine.state in ENABLED else self._disabled_ticks + 1

    def first(self) -> Obstacle | None:
        """Return code and text of what is in the way, or None."""
        if self._disabled_ticks < _DISABLED_TICKS:
            return RefusalCode.STILL_ENABLED, "the drive is still being disabled: try again."
        if self._count.known.awaits_proof and not self._drive.is_stale:
            return (
                RefusalCode.HEARTBEAT_LOST,
                "the drive was silent, and no heartbeat has come since to show whether it rebooted: try again.",
            )
        return self._admission.obstacle_to_arming(referenced=self._reference.source is not None)


class Arming:
    """Waits for the drive to report that it is enabled, then holds the place.

    Parameters
    ----------
    design
        The axis.
    machine
        Its state.
    drive
        What its drive reports.
    motion, supervision, operation
        What begins when the drive is enabled.
    latch
        Where it trips if that takes too long.
    """

    __slots__ = (
        "_acceleration", "_drive", "_latch", "_machine", "_motion", "_operation", "_rest_velocity", "_supervision",
        "_ticks", "_ticks_allowed", "_timeout_ms",
    )  # fmt: skip

    def __init__(
        self,
        design: AxisDesign,
        machine: StateMachine,
        drive: DriveReport,
        motion: Motion,
        supervision: Supervision,
        operation: Operation,
        latch: TripLatch,
    ) -> None:
        self._timeout_ms = design.settings.arming_timeout_ms
        self._ticks_allowed = design.ticks(self._timeout_ms)
        self._acceleration = design.settings.limits.acceleration
        self._rest_velocity = design.rest_velocity
        self._machine = machine
        self._drive = drive
        self._motion = motion
        self._supervision = supervision
        self._operation = operation
        self._latch = latch
        self._ticks = 0

    def begin(self) -> None:
        """Let the drive be told to enable."""
        self._ticks = 0
        self._machine.apply(Event.ARM)

    def step(self) -> None:
        """Check a tick of waiting."""
        self._ticks += 1
        ready = self._drive.enabled is not False and self._drive.fresh and self._ticks > 1
        # Not on a sample in doubt: what holds from here on takes the latest one for where the axis is.
        if ready and self._motion.knows_speed and not self._motion.doubts_sample:
            self._hold()
        elif self._ticks > self._ticks_allowed:
            if self._drive.enabled is False:
                missing = "the drive did not report that it is enabled"
            else:
                missing = "the speed is unknown, because no two consecutive fresh samples came without a missed tick"
            self._latch.raise_trip(TripCode.DRIVE_NOT_ENABLED, f"{missing} within {self._timeout_ms:g} ms of arming")

    def _hold(self) -> None:
        self._motion.start()
        self._supervision.start()
        self._operation.forget()
        moving = abs(self._motion.law.observer.velocity) > self._rest_velocity
        self._machine.apply(Event.ENABLED_MOVING if moving else Event.ENABLED)
        if moving:  # pushed by hand, or still coasting: caught, not jerked back
            self._operation.brake(self._acceleration, MoveOutcome.STOPPED)
