"""The decision of the change-over: when braking begins, and how.

It begins in the first tick after which the reference could no longer brake to the set-point as gently as it is planned
to. A short move has no cruise: its top is the highest speed from which it still can.
"""

from math import copysign, inf
from typing import Final

from twostage_servo.control.laws.adaptive.course import Course
from twostage_servo.control.laws.adaptive.estimate import ControlEstimate
from twostage_servo.control.laws.adaptive.reference import Braking, Shape, next_speed
from twostage_servo.control.laws.adaptive.rules import Rules, loop_period_s
from twostage_servo.control.laws.law import ControlTask

_HALVINGS: Final = 24
"""Steps in which the top speed of a short move is found: to a part in sixteen million."""

_LEAST_SHARE: Final = 0.2
"""Share of the effort limit, and of the cruise velocity, that braking is planned with at least."""

_HARDEST: Final = 0.9
"""Share of what the effort limit could brake with up to which a set-point that comes late is still met."""

_NOTHING: Final = 1e-9
"""Share of the cruise velocity that is none."""


class Changeover:
    """See the module.

    Parameters
    ----------
    estimate
        What the law controls by.
    task
        Plant, tick and limits.
    rules
        How the law shapes a move.
    """

    __slots__ = ("_acceleration_limit", "_estimate", "_largest_step", "_loop_period_s", "_period_s", "_rules")

    def __init__(self, estimate: ControlEstimate, task: ControlTask, rules: Rules) -> None:
        self._estimate = estimate
        self._rules = rules
        self._period_s = task.period_s
        self._loop_period_s = loop_period_s(task)
        self._acceleration_limit = task.acceleration_limit
        self._largest_step = task.effort_rate_limit * task.period_s

    def decide(self, course: Course, ahead: float, limit: float) -> float | None:
        """Begin to brake if it is time to.

        Parameters
        ----------
        course
            Of the move.
        ahead
            Its speed a tick ahead, in axis unit/s.
        limit
            Largest magnitude of the effort, in effort unit.

        Returns
        -------
        float or None
            The top of a short move, in axis unit/s, if that is what the speed ahead has to be; None if it may be
            `ahead`.
        """
        estimate, speed = self._estimate, course.speed
        ways = estimate.model.ways
        top: float | None = None
        deceleration = self._planned_deceleration(course, ahead, limit)
        way = course.direction * (course.target - estimate.position) - ways.beta * speed
        shape, is_there = self._shape(course, ahead, deceleration), False
        if ahead > speed and self._is_late(ahead, shape, way, deceleration):
            top = ahead = self._highest_speed(course, ahead, way, deceleration)
            is_there = ahead <= _NOTHING * course.cruise_velocity
            shape = self._shape(course, ahead, deceleration)
        left = way - ways.alpha * ahead - shape.way
        if next_speed(left, shape.speed, deceleration, ways) < shape.speed or is_there:
            self._begin_braking(course, ahead, shape, left, deceleration)
        return top

    def _planned_deceleration(self, course: Course, ahead: float, limit: float) -> float:
        """Return the deceleration that braking is planned with, in axis unit/s²."""
        estimate, rules = self._estimate, self._rules
        gain = estimate.model.plant.gain
        pushes = copysign(1.0, gain) * course.direction * estimate.disturbance  # the axis on
        left = max(limit - pushes, _LEAST_SHARE * limit)
        deceleration = min(rules.braking_share * abs(gain) * left, self._acceleration_limit)
        if estimate.learning.is_new:
            least = max(ahead, _LEAST_SHARE * course.cruise_velocity)
            deceleration = min(deceleration, least / (rules.first_braking * self._loop_period_s))
        return deceleration

    def _shape(self, course: Course, ahead: float, deceleration: float) -> Shape:
        model, step = self._estimate.model, self._largest_step
        gain = abs(model.plant.gain)
        return Shape.at(ahead, course.speed, course.cruise_velocity, deceleration, gain, step, model.ways)

    def _is_late(self, ahead: float, shape: Shape, way: float, deceleration: float) -> bool:
        """Whether the axis would no longer come to rest within the way (axis unit) from a speed a tick ahead."""
        ways = self._estimate.model.ways
        left = way - ways.alpha * ahead - shape.way
        return next_speed(left, shape.speed, deceleration, ways) < shape.speed - deceleration * self._period_s

    def _highest_speed(self, course: Course, ahead: float, way: float, deceleration: float) -> float:
        """Return the highest speed a tick ahead from which it would, at most `ahead`."""
        low, high = 0.0, ahead
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if self._is_late(middle, self._shape(course, middle, deceleration), way, deceleration):
                high = middle
            else:
                low = middle
        return low

    def _begin_braking(self, course: Course, ahead: float, shape: Shape, left: float, deceleration: float) -> None:
        """Change over to the position stage; or come to rest and turn, if no braking meets the set-point any more."""
        speed, ways = course.speed, self._estimate.model.ways
        hardest = min(_HARDEST / self._rules.braking_share * deceleration, self._acceleration_limit)
        needed = shape.speed * shape.speed / (2.0 * left) if left > 0.0 else copysign(inf, shape.speed)
        if ahead > 0.0 and speed > 0.0 and needed > max(hardest, 2.0 * deceleration):
            course.turns = True
            return
        course.has_changed_over = True
        course.position = self._estimate.position + course.direction * (ways.beta * speed + ways.alpha * ahead)
        course.braking = Braking(shape, left, max(deceleration, needed)) if ahead > 0.0 else None
        course.top = ahead
