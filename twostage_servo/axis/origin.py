"""From where the positions of an axis count, for all that hold one."""

from twostage_servo.axis.count_watch import CountWatch
from twostage_servo.axis.disabled_drive import DisabledDriveWatch
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.reference import Reference


class Origin:
    """Moves the origin of everything that holds a position of the axis.

    Parameters
    ----------
    drive, disabled, motion, count
        What holds positions.
    reference
        On what they rest.
    """

    __slots__ = ("_count", "_disabled", "_drive", "_motion", "_reference")

    def __init__(
        self,
        drive: DriveReport,
        disabled: DisabledDriveWatch,
        motion: Motion,
        count: CountWatch,
        reference: Reference,
    ) -> None:
        self._drive = drive
        self._disabled = disabled
        self._motion = motion
        self._count = count
        self._reference = reference

    def refer(self, found: float, position: float) -> float:
        """Count positions so that the place `found` (axis unit, by the former origin) is `position`.

        Returns
        -------
        float
            How much larger positions are now, in axis unit.
        """
        distance = position - found
        self._drive.shift(distance)
        self._disabled.motion.shift(distance)
        self._motion.shift(distance)
        self._count.shift(distance)
        self._reference.find()
        return distance
