"""A service in which a defect can show."""

from typing import Any, Final, Literal

from twostage_servo.service.servo_service import ServoService
from twostage_servo.timing.ticks import Tick

Part = Literal["read", "update", "write"]
"""What closes the loop in a tick."""

PARTS: Final[tuple[Part, ...]] = ("read", "update", "write")


class Defects:
    """Which part of a tick has a defect."""

    def __init__(self) -> None:
        self._part: Part | None = None

    def show_in(self, part: Part) -> None:
        """Let a defect show once, as soon as the loop is to do its next such part."""
        self._part = part

    def look(self, part: Part) -> None:
        """Show the defect, if it is of this part.

        Raises
        ------
        RuntimeError
            In that case, once.
        """
        if part == self._part:
            self._part = None
            raise RuntimeError(f"a defect, injected where the loop is to {part}")


class DefectiveService(ServoService):
    """A service whose ticks have a defect as soon as they are told to.

    Parameters
    ----------
    defects
        Tells which part of a tick has one.
    parts
        What :class:`~twostage_servo.service.servo_service.ServoService` takes.
    """

    def __init__(self, defects: Defects, *parts: Any) -> None:
        super().__init__(*parts)
        self._defects = defects

    def read(self, tick: Tick) -> None:
        """Do as a sound service does, but for the defect."""
        self._defects.look("read")
        super().read(tick)

    def update(self, tick: Tick) -> None:
        """Do as a sound service does, but for the defect."""
        self._defects.look("update")
        super().update(tick)

    def write(self, tick: Tick) -> None:
        """Do as a sound service does, but for the defect."""
        self._defects.look("write")
        super().write(tick)
