"""What is said of a drive that does not do what it is told, for as long as that lasts."""

from twostage_servo.axis.disabled_drive import DisabledDriveWatch
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.state import ENABLED
from twostage_servo.axis.state_machine import StateMachine
from twostage_servo.axis.trips import Trip, TripCode


class Hazards:
    """Finds out what is wrong with the drive at this moment, with its present numbers.

    Parameters
    ----------
    settings
        Of the axis.
    machine
        Its state, which says whether the drive is told to be enabled.
    drive
        What the drive reports.
    disabled
        Whether a drive that is told to be disabled obeys.
    """

    __slots__ = ("_disabled", "_drive", "_machine", "_settings")

    def __init__(
        self, settings: AxisSettings, machine: StateMachine, drive: DriveReport, disabled: DisabledDriveWatch
    ) -> None:
        self._settings = settings
        self._machine = machine
        self._drive = drive
        self._disabled = disabled

    def present(self, tick: int) -> tuple[Trip, ...]:
        """Return what trips an axis that is disabled as well, in a tick of this index; no reset is possible meanwhile.

        That is a drive that is not disabled, one that contradicts itself, and one that another node commands while it
        may be enabled by that.
        """
        found = []
        if self._disabled.not_disabled:
            found.append(Trip(TripCode.DRIVE_NOT_DISABLED, self._not_disabled_text(), tick))
        if contradiction := self._drive.states.contradiction:
            found.append(Trip(TripCode.DRIVE_STATE_MISMATCH, contradiction, tick))
        if self._obeys_another:
            found.append(Trip(TripCode.FOREIGN_COMMAND, self.foreign_text(), tick))
        return tuple(found)

    def lasting(self, tick: int) -> tuple[Trip, ...]:
        """Return all that is wrong.

        Beside what is present that is a drive that has fallen silent before it reported that it is off, and somebody
        else's commands also to a drive that is seen to be disabled.
        """
        found = self.present(tick)
        if self._disabled.silent_while_enabled:
            found = (*found, Trip(TripCode.STALE_FEEDBACK, self._silent_text(), tick))
        if self._drive.foreign.lasts and all(one.code is not TripCode.FOREIGN_COMMAND for one in found):
            found = (*found, Trip(TripCode.FOREIGN_COMMAND, self.foreign_text(), tick))
        return found

    def foreign_text(self) -> str:
        """Return the sentence that tells of somebody else's commands."""
        return f"another node on the bus commands this drive: {self._drive.foreign}"

    @property
    def _obeys_another(self) -> bool:
        """Whether somebody else commands a drive that is told to be disabled, and it may be enabled by that."""
        foreign = self._drive.foreign
        if self._machine.state in ENABLED or not foreign.lasts:
            return False
        # One whose feedback does not tell is taken at what it has been told.
        return self._disabled.seen_enabled or (self._drive.enabled is None and foreign.latest.enables is not False)

    def _not_disabled_text(self) -> str:
        watch, unit = self._disabled, self._settings.unit
        moved = "" if watch.moved is None else f"; the axis has moved by {watch.moved:+.4g} {unit} meanwhile"
        foreign = self._drive.foreign
        told_by = f"; another node on the bus has commanded it: {foreign}" if foreign.came_within(watch.told_ms) else ""
        return (
            f"the drive was told to disable {watch.told_ms:g} ms ago, and has since reported for {watch.enabled_ms:g} "
            f"ms that it is enabled{moved}{told_by}; axis.arming_timeout_ms is {self._settings.arming_timeout_ms:g}"
        )

    def _silent_text(self) -> str:
        watch = self._disabled
        return (
            f"the drive was told to disable {watch.told_ms:g} ms ago, and has been silent for {watch.silent_ms:g} ms: "
            "the last that it has reported is that it is enabled, and nobody knows whether it is off. Its own command "
            "time-out should have stopped the axis: look at it"
        )
