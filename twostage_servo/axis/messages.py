"""What goes into and out of an axis: commands to the drive, moves, and refusals to the operator."""

from dataclasses import dataclass
from typing import NamedTuple


class Refused(Exception):  # noqa: N818 - not a fault of the program: the axis' answer to a request
    """A request that the axis does not carry out; ``code`` is stable, the text is for the operator."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class Command(NamedTuple):
    """What goes to the drive this tick: effort in effort unit, and whether the drive shall be enabled."""

    effort: float
    enable: bool


NO_EFFORT = Command(0.0, enable=False)


@dataclass(slots=True)
class Move:
    """One set-point and what became of it: ``moving``, ``reached``, ``replaced``, ``stopped`` or ``tripped``."""

    number: int
    target: float
    velocity: float
    start: float
    outcome: str = "moving"
