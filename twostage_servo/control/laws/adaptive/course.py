"""The course of a move: where it goes, and where its reference stands. Both stages read it and move it on."""

from copy import copy
from dataclasses import dataclass, replace

from twostage_servo.control.laws.adaptive.reference import Braking


@dataclass(slots=True)
class Course:
    """The course of a move, or of holding its target.

    Speeds count in the direction of the move, so that they are below zero where the axis still moves the other way.

    Attributes
    ----------
    target
        The set-point, in axis unit.
    position
        Of the model that runs along the braking reference, in axis unit; it counts from the change-over on.
    cruise_velocity
        In axis unit/s, greater than 0 in a move.
    direction
        1 or -1.
    speed
        The speed reference, in axis unit/s.
    slope
        By how much it has changed in the last tick, in axis unit/s.
    turns
        Whether the axis first comes to rest, because no braking meets the set-point any more.
    has_changed_over
        Whether the speed stage has handed over to the position stage.
    braking
        The reference after the change-over; None before it, and where the axis holds.
    top
        The speed at the change-over, in axis unit/s.
    ticks_cruised
        Ticks at the cruise velocity while the plant is being identified.
    """

    target: float
    position: float
    cruise_velocity: float = 0.0
    direction: float = 1.0
    speed: float = 0.0
    slope: float = 0.0
    turns: bool = False
    has_changed_over: bool = False
    braking: Braking | None = None
    top: float = 0.0
    ticks_cruised: int = 0

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self.target += distance
        self.position += distance

    def copied_to(self, position: float) -> "Course":
        """Return a copy that goes on by itself, with its model at another position (axis unit)."""
        return replace(self, position=position, braking=copy(self.braking))
