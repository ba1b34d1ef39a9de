"""The decision of the change-over: when braking begins, and how.

It begins in the first tick after which the reference could no longer brake to the set-point as gently as it is planned
to. A short move has no cruise: its top is the highest speed from which it still can.
"""

from math import copysign, inf
from typing import Final, NamedTuple

from twostage_servo.control.laws.adaptive.course import Course
from twostage_servo.control.laws.adaptive.estimate import ControlEstimate
from twostage_servo.control.laws.adaptive.reference import Braking, BrakingShape, Shape, Ways, next_speed
from twostage_servo.control.laws.adaptive.rules import Rules, loop_period_s
from twostage_servo.control.laws.adaptive.smoothing import BRAKING_SHARE, Smoothing, SmoothShape
from twostage_servo.control.laws.law import ControlTask

_HALVINGS: Final = 24
"""Steps in which the top speed of a short move, or a deceleration, is found: to a part in sixteen million."""

_LEAST_SHARE: Final = 0.2
"""Share of the effort limit, and of the cruise velocity, that braking is planned with at least."""

_HARDEST: Final = 0.9
"""Share of what the effort limit could brake with up to which a set-point that comes late is still met."""

_NOTHING: Final = 1e-9
"""Share of the cruise velocity that is none."""


class _Plan(NamedTuple):
    """A braking as it may begin, and its deceleration in axis unit/s²."""

    shape: BrakingShape
    deceleration: float


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
    smoothing
        What limits the jerk of the reference, if anything.
    """

    __slots__ = (
        "_acceleration_limit", "_estimate", "_largest_step", "_loop_period_s", "_period_s", "_rules", "_smoothing",
    )  # fmt: skip

    def __init__(
        self, estimate: ControlEstimate, task: ControlTask, rules: Rules, smoothing: Smoothing | None = None
    ) -> None:
        self._smoothing = smoothing
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
        plan, is_there = self._plan(course, ahead, deceleration), False
        if ahead > self._falls_from(course) and self._is_late(ahead, plan, way):
            top = ahead = self._highest_speed(course, ahead, way, deceleration)
            from_behind = self._smoothing is not None and speed < 0.0
            is_there = ahead <= _NOTHING * course.cruise_velocity and not from_behind
            plan = self._plan(course, ahead, deceleration)
        left = way - ways.alpha * ahead - plan.shape.way
        if next_speed(left, plan.shape.speed, plan.deceleration, ways) < plan.shape.speed or is_there:
            self._begin_braking(course, ahead, plan, left)
        return top

    def _planned_deceleration(self, course: Course, ahead: float, limit: float) -> float:
        """Return the deceleration that braking is planned with, in axis unit/s²."""
        estimate, rules = self._estimate, self._rules
        gain = estimate.model.plant.gain
        pushes = copysign(1.0, gain) * course.direction * estimate.disturbance  # the axis on
        left = max(limit - pushes, _LEAST_SHARE * limit)
        deceleration = min(rules.braking_share * abs(gain) * left, self._acceleration_limit)
        if rules.is_cautious and estimate.learning.is_new:
            least = max(ahead, _LEAST_SHARE * course.cruise_velocity)
            deceleration = min(deceleration, least / (rules.first_braking * self._loop_period_s))
        return deceleration

    def _falls_from(self, course: Course) -> float:
        """Return the speed a tick ahead from which on the reference does not rise, or rises as little as it may."""
        if self._smoothing is None:
            return course.speed
        steepest = min(course.slope, -self._acceleration_limit * self._period_s)
        step = self._smoothing.step(self._estimate.model.plant.gain)
        least = course.speed + max(course.slope - step, steepest)
        return least if course.speed < 0.0 else max(0.0, least)

    def _plan(self, course: Course, ahead: float, deceleration: float) -> _Plan:
        """Return how a braking would begin from a speed a tick ahead (axis unit/s), with at most a deceleration."""
        model, step = self._estimate.model, self._largest_step
        gain = abs(model.plant.gain)
        if self._smoothing is None:
            # What drives the axis may take the reference along, by more than it would ever rise by itself.
            before = max(course.speed, ahead - self._acceleration_limit * self._period_s)
            shape = Shape.at(ahead, before, course.cruise_velocity, deceleration, gain, step, model.ways)
            return _Plan(shape, deceleration)
        slope, jerk_step = ahead - course.speed, self._smoothing.step(gain)
        deceleration = self._smoothing.deceleration(ahead, slope, jerk_step, deceleration, self._period_s)
        return _Plan(SmoothShape.at(ahead, slope, deceleration, jerk_step, model.ways), deceleration)

    def _is_late(self, ahead: float, plan: _Plan, way: float) -> bool:
        """Whether the axis would no longer come to rest within the way (axis unit) from a speed a tick ahead."""
        ways, shape, deceleration = self._estimate.model.ways, plan.shape, plan.deceleration
        left = way - ways.alpha * ahead - shape.way
        if left < ways.beta * shape.speed:  # less than the tick in which it stops
            return True
        return _ends_late(shape, left, deceleration, ways)

    def _highest_speed(self, course: Course, ahead: float, way: float, deceleration: float) -> float:
        """Return the highest speed a tick ahead from which it would, at most `ahead`."""
        low, high = (0.0 if self._smoothing is None else self._falls_from(course)), ahead
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if self._is_late(middle, self._plan(course, middle, deceleration), way):
                high = middle
            else:
                low = middle
        return low

    def _begin_braking(self, course: Course, ahead: float, plan: _Plan, left: float) -> None:
        """Change over to the position stage; or come to rest and turn, if no braking meets the set-point any more."""
        speed, ways, (shape, deceleration) = course.speed, self._estimate.model.ways, plan
        hardest = min(_HARDEST / self._rules.braking_share * deceleration, self._acceleration_limit)
        if self._smoothing is None:
            needed, most = _needed(shape, left), max(hardest, 2.0 * deceleration)
        else:  # what is steeper than planned has more jerk as well
            needed, most = _needed_evenly(shape, left, ways), deceleration / BRAKING_SHARE
            if needed > most:
                harder = self._plan(course, ahead, hardest)
                left += shape.way - harder.shape.way
                shape, deceleration = harder
                needed, most = _needed_evenly(shape, left, ways), deceleration / BRAKING_SHARE
        # A smooth reference may still come from the other direction: what counts is where its slope will have run out.
        brakes = ahead > 0.0 if self._smoothing is None else shape.speed > 0.0
        moves = brakes and (speed > 0.0 or self._smoothing is not None)
        if moves and needed > most:
            course.turns = True
            return
        course.has_changed_over = True
        course.position = self._estimate.position + course.direction * (ways.beta * speed + ways.alpha * ahead)
        course.braking = Braking(shape, left, max(deceleration, needed)) if brakes else None
        course.top = ahead


def _needed(shape: BrakingShape, left: float) -> float:
    """Return the deceleration with which a braking ends within what is left (axis unit), in axis unit/s²."""
    return shape.speed * shape.speed / (2.0 * left) if left > 0.0 else copysign(inf, shape.speed)


def _needed_evenly(shape: BrakingShape, left: float, ways: Ways) -> float:
    """Return that of a smooth braking, whose first tick may be no steeper than the others: that would be more jerk."""
    if left <= 0.0:
        return copysign(inf, shape.speed)
    if shape.speed * ways.period_s <= _NOTHING * left:  # it is there, and a slope would be lost in rounding
        return 0.0
    low, high = 0.0, max(shape.speed, 0.0) / ways.period_s  # all of it in one tick
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _ends_late(shape, left, middle, ways) else (low, middle)
    return high


def _ends_late(shape: BrakingShape, left: float, deceleration: float, ways: Ways) -> bool:
    """Whether whole ticks with a deceleration (axis unit/s²) go farther than what is left (axis unit)."""
    return next_speed(left, shape.speed, deceleration, ways) < shape.speed - deceleration * ways.period_s
