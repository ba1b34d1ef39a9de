"""What comes from the drive and about it, and what an axis loses or trips by."""

from twostage_servo.axis.count_watch import CountWatch
from twostage_servo.axis.disabled_drive import DisabledDriveWatch
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.drive_states import DriveState
from twostage_servo.axis.hazards import Hazards
from twostage_servo.axis.messages import IN_TIME, Feedback, Reception
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.reference import Reference
from twostage_servo.axis.state import COMMANDED, DRIVEN, ENABLED, LATCHED, State
from twostage_servo.axis.state_machine import StateMachine
from twostage_servo.axis.trip_latch import TripLatch
from twostage_servo.axis.trips import TripCode


class DriveWatch:
    """Records what the drive sends, and evaluates it once a tick.

    Parameters
    ----------
    machine
        The state of the axis.
    drive, disabled, count
        What the drive reports, whether it obeys while it is told to be disabled, and whether its encoder counts on.
    motion
        What moves the axis.
    reference
        On what its positions rest.
    hazards
        What is wrong with the drive.
    latch
        Where the axis trips.
    """

    __slots__ = (
        "_count", "_disabled", "_drive", "_hazards", "_latch", "_machine", "_missed", "_motion", "_reference",
        "_was_enabled",
    )  # fmt: skip

    def __init__(
        self,
        machine: StateMachine,
        drive: DriveReport,
        disabled: DisabledDriveWatch,
        count: CountWatch,
        motion: Motion,
        reference: Reference,
        hazards: Hazards,
        latch: TripLatch,
    ) -> None:
        self._machine = machine
        self._drive = drive
        self._disabled = disabled
        self._count = count
        self._motion = motion
        self._reference = reference
        self._hazards = hazards
        self._latch = latch
        self._missed = 0
        self._was_enabled = False

    def begin_tick(self, missed: int) -> None:
        """Open a tick, before which so many were missed."""
        self._missed = missed
        self._was_enabled = self._machine.state in ENABLED

    def accept_feedback(self, feedback: Feedback, reception: Reception = IN_TIME) -> None:
        """Accept one decoded feedback frame; the newest of a tick counts."""
        if not self._drive.accept_feedback(feedback, reception, driven=self._machine.state in DRIVEN):
            self._reference.lose(
                "no feedback came for so long that the axis may have moved half of its encoder's counting range"
            )

    def record_heartbeat(
        self, boot_counter: int | None, state: DriveState | None = None, *, late: bool = False
    ) -> None:
        """Record a heartbeat with its count of the drive's boots; a drive that has rebooted has lost its position."""
        if self._drive.record_heartbeat(boot_counter, state, late=late):
            self._reference.lose("the drive has rebooted, and its encoder has restarted its count")
            self._count.restart()
            self._disabled.motion.begin(0.0)
            self._latch.raise_trip(TripCode.DRIVE_REBOOTED, "the drive rebooted while it was enabled")
        elif boot_counter is not None and not late:
            self._count.confirm_count()

    def record_foreign_command(self, frame: str, *, enables: bool | None = None) -> None:
        """Record a command to this axis' drive that is not its own; two masters can't hold one axis.

        It trips an enabled axis. One that is disabled is told of it for as long as it lasts, and trips as soon as the
        drive may be enabled by it.

        Parameters
        ----------
        frame
            The frame and what it asks for, in words.
        enables
            Whether it enables the drive; None where that cannot be read from it.
        """
        self._drive.foreign.record(frame, enables=enables)
        if self._machine.state in ENABLED:
            self._latch.raise_trip(TripCode.FOREIGN_COMMAND, self._hazards.foreign_text())

    def look_for_troubles(self) -> None:
        """Trip by what the drive reports while it is told to be enabled."""
        state = self._machine.state
        if state in ENABLED:
            for code, cause in self._drive.troubles(arming=state is State.ARMING):
                self._latch.raise_trip(code, cause)

    def check_obedience(self, *, told_enabled: bool) -> None:
        """Trip by what must not last, whether the axis is enabled or not."""
        drive, latch = self._drive, self._latch
        drive.compare_states(self._missed, told_enabled=told_enabled)
        if told_enabled:
            self._disabled.release(drive.enabled_report)
        else:
            position = drive.position if drive.fresh else None
            self._disabled.update(self._missed, drive.enabled_report, position, self._motion.law.observer.velocity)
        for trip in self._hazards.present(latch.tick):
            if trip.code not in latch.trips:
                latch.raise_trip(trip.code, trip.cause)

    def check_count(self) -> None:
        """Lose the reference if the encoder may not count on from where it was, and trip if the axis moves by it."""
        state, law = self._machine.state, self._motion.law
        speed = abs(law.observer.velocity)
        if state in COMMANDED:
            speed = max(speed, abs(law.cruise_velocity))
        reason = self._count.update(
            self._missed,
            self._drive.position if self._drive.fresh else None,
            speed,
            # What disables the drive in this tick comes after its sample, and leaves late if the service is held up.
            driven=self._was_enabled or state in ENABLED,
            homed=self._reference.is_homed,
            counts_boots=self._drive.counts_boots,
            age_s=self._drive.age_s,
        )
        if reason is None:
            return
        if state in DRIVEN and state not in LATCHED:
            self._latch.raise_trip(TripCode.POSITION_JUMP, reason)
        self._reference.lose(reason)
