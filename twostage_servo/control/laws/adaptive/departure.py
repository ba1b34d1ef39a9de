"""How a move begins: the effort stays within bounds until the axis is seen to move.

An axis that does not move yet may be stuck, or may press against an obstacle. Feedback would add effort with each tick,
and all of it would act at once when the axis comes free.
"""

from math import ceil, copysign
from typing import Final

from twostage_servo.control.laws.adaptive.course import Course
from twostage_servo.control.laws.adaptive.estimate import ControlEstimate

_MOTION: Final = 3.0
"""Standard deviations of a sample from which the axis is seen to move."""

_HELD_SHARE: Final = 0.14
"""Share of the effort limit that feedback may add until then: three times the load that is expected at most."""

_UNSEEN_SAMPLES: Final = 4.0
"""Samples, each a tick of the loops after the other, in which an axis shows that it moves: two until the first effort
can be seen, one for a delay, one for friction. After them an axis that is stuck, or whose encoder is, is pushed by no
more than what tells a stall."""

_LONGEST_HELD_S: Final = 0.15
"""Time after which it may add more in any case: by then a stall is detected, or there is friction that takes more."""

_RELEASE_S: Final = 0.5
"""Time in which the push against an obstacle is released, from the effort limit to none."""


class Departure:
    """What holds back the effort of a move that begins.

    Parameters
    ----------
    estimate
        What the law controls by.
    period_s, loop_period_s
        The tick, and that of the loops, in s.
    holds_back
        Whether it holds back anything.

    Attributes
    ----------
    position
        From where the move has set out, in axis unit.
    leaves_obstacle
        Whether the axis has pressed against an obstacle with all of its effort, and is not seen to leave it yet.
    is_held
        Whether the effort is held back.
    """

    __slots__ = (
        "_estimate", "_held_effort", "_holds_back", "_period_s", "_samples_held", "_ticks_held", "_unseen_samples",
        "is_held", "leaves_obstacle", "position",
    )  # fmt: skip

    def __init__(
        self, estimate: ControlEstimate, period_s: float, loop_period_s: float, *, holds_back: bool = True
    ) -> None:
        self._estimate = estimate
        self._holds_back = holds_back
        self._period_s = period_s
        self._unseen_samples = ceil(_UNSEEN_SAMPLES * loop_period_s / period_s)
        self.position = 0.0
        self.clear()

    def clear(self) -> None:
        """Hold nothing back."""
        self.leaves_obstacle = self.is_held = False
        self._held_effort = 0.0
        self._ticks_held = self._samples_held = 0

    def set_out(self, position: float, *, leaves_obstacle: bool = False) -> None:
        """Set out from a position, in axis unit."""
        self.position = position
        self.leaves_obstacle = leaves_obstacle and self._holds_back

    def hold(self, effort: float) -> None:
        """Hold back the effort around the one that has held the axis at rest so far, in effort unit."""
        self.is_held = self._holds_back
        self._held_effort = effort
        self._ticks_held = self._samples_held = 0

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self.position += distance

    def release(self, course: Course, sample: float | None, before: float, limit: float) -> float:
        """Return an effort that changes evenly until the axis is seen to leave its obstacle.

        What an obstacle holds vanishes with the push. Where that takes a tick, it is a step of load as large as all of
        the effort, and looks like a plant of another gain.

        Parameters
        ----------
        course
            Of the move; it goes on at the speed that the axis has then.
        sample
            The measured position in axis unit, None if there is none.
        before, limit
            The last effort, and the largest magnitude of one, in effort unit.
        """
        step = limit * self._period_s / _RELEASE_S
        position = self._estimate.position if sample is None else sample
        if course.direction * (position - self.position) > _MOTION * self._estimate.spread:
            self.leaves_obstacle = False
            course.speed = max(0.0, course.direction * self._estimate.velocity)
        return before + copysign(step, course.direction * self._estimate.model.plant.gain)

    def held_back(self, wanted: float, rise: float, sample: float | None, limit: float) -> float:
        """Return an effort within what feedback may add before the axis is seen to move, in effort unit.

        Parameters
        ----------
        wanted, limit
            What the stage asks for, and the largest magnitude of an effort, in effort unit.
        rise
            By how much the speed reference rises over coasting, in axis unit/s: its effort is not held back as long as
            it cannot have shown.
        sample
            The measured position in axis unit, None if there is none.
        """
        estimate, plant = self._estimate, self._estimate.model.sampled
        self._ticks_held += 1
        self._samples_held += sample is not None
        moves = sample is not None and abs(sample - self.position) > _MOTION * estimate.spread
        if moves or self._ticks_held * self._period_s > _LONGEST_HELD_S:
            self.is_held = False
            return wanted
        planned = abs(rise / plant.b2) if self._samples_held <= self._unseen_samples else 0.0
        most = planned + _HELD_SHARE * limit
        return min(max(wanted, self._held_effort - most), self._held_effort + most)
