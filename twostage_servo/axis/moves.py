"""A motion that was asked for, and what becomes of it."""

import enum
from typing import Final

LARGEST_OVERRIDE: Final = 200.0
"""Largest speed override, in percent; the speed stays within the velocity limit in any case."""

USUAL_OVERRIDE: Final = 100.0
"""Speed override of an axis that has just been armed, in percent."""


class MoveKind(enum.StrEnum):
    """What was asked for."""

    MOVE = "move"
    """To a set-point."""
    JOG = "jog"
    """At a velocity, for as long as it is asked for."""
    HOME = "home"
    """To find the place from which positions are counted; or to declare that it is here, which moves nothing."""


class MoveOutcome(enum.StrEnum):
    """What has become of it."""

    MOVING = "moving"
    """It is under way."""
    REACHED = "reached"
    """The axis has come to rest at its set-point, or has found its reference."""
    REPLACED = "replaced"
    """Another one was asked for."""
    STOPPED = "stopped"
    """The axis was brought to rest before."""
    TRIPPED = "tripped"
    """The axis has tripped before."""


class Move:
    """One motion that was asked for, and what became of it.

    Attributes
    ----------
    number
        Counts the moves of an axis.
    kind
        What was asked for.
    target, velocity, start
        Set-point (axis unit), speed (axis unit/s), and where the axis was when it was asked for.
    outcome
        What has become of it.
    reason
        Why it was stopped, if not by the operator's `stop`.
    """

    __slots__ = ("kind", "number", "outcome", "reason", "start", "target", "velocity")

    def __init__(self, number: int, kind: MoveKind, target: float, velocity: float, start: float) -> None:
        self.number = number
        self.kind = kind
        self.target = target
        self.velocity = velocity
        self.start = start
        self.outcome = MoveOutcome.MOVING
        self.reason: str | None = None

    def end(self, outcome: MoveOutcome, reason: str | None) -> None:
        """Tell what has become of it."""
        self.outcome, self.reason = outcome, reason

    def shift_start(self, distance: float) -> None:
        """Count where it began from an origin that lies `distance` (axis unit) lower, as its set-point does already."""
        self.start += distance

    def _values(self) -> tuple[object, ...]:
        return (self.number, self.kind, self.target, self.velocity, self.start, self.outcome, self.reason)

    def __eq__(self, other: object) -> bool:
        return self._values() == other._values() if isinstance(other, Move) else NotImplemented

    __hash__ = None  # type: ignore[assignment]  # it changes

    def __repr__(self) -> str:
        return f"Move{self._values()!r}"
