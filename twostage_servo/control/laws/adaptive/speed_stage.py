"""The speed stage: it brings the axis to its cruise velocity and keeps it there, by velocity feedback alone.

``u = (v+ - a22 v)/b2 + f2 (v - x2) - x3``, with v the speed reference and v+ its next value. Where a limit cuts the
effort, v+ becomes what will be reached, so nothing winds up.
"""

from math import copysign, floor, isfinite, sqrt

from twostage_servo.control.laws.adaptive.changeover import Changeover
from twostage_servo.control.laws.adaptive.course import Course
from twostage_servo.control.laws.adaptive.departure import Departure
from twostage_servo.control.laws.adaptive.estimate import ControlEstimate
from twostage_servo.control.laws.adaptive.rules import Rules, loop_period_s
from twostage_servo.control.laws.adaptive.smoothing import Smoothing, next_slope
from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import ControlTask


class SpeedStage:
    """See the module.

    Parameters
    ----------
    estimate
        What the law controls by.
    departure
        From where moves set out.
    task
        Plant, tick and limits.
    rules
        How the law shapes a move.

    Attributes
    ----------
    rise
        By how much the speed reference has risen over coasting in the last tick, ``v+ - a22 v``, in axis unit/s.
    """

    __slots__ = (
        "_changeover",
        "_departure",
        "_estimate",
        "_largest_step",
        "_loop_period_s",
        "_period_s",
        "_ramp",
        "_rules",
        "_smoothing",
        "rise",
    )

    def __init__(self, estimate: ControlEstimate, departure: Departure, task: ControlTask, rules: Rules) -> None:
        self._estimate = estimate
        self._departure = departure
        self._rules = rules
        self._smoothing = Smoothing(task) if isfinite(task.jerk) else None
        self._changeover = Changeover(estimate, task, rules, self._smoothing)
        self._period_s = task.period_s
        self._loop_period_s = loop_period_s(task)
        self._ramp = task.acceleration_limit * task.period_s
        self._largest_step = task.effort_rate_limit * task.period_s
        self.clear()

    def clear(self) -> None:
        """Forget how the last move went."""
        self.rise = 0.0

    def step(self, course: Course, before: float, limit: float) -> float:
        """Move the course on by a tick, and see whether it is time to brake; return the effort, without its limits.

        Parameters
        ----------
        course
            Of the move.
        before, limit
            The last effort, and the largest magnitude of one, in effort unit.
        """
        estimate, model, speed = self._estimate, self._estimate.model, course.speed
        plant, direction = model.sampled, course.direction
        velocity, disturbance = direction * estimate.velocity, direction * estimate.disturbance
        goal = 0.0 if course.turns else course.cruise_velocity
        ahead = self._next_reference(course, goal)
        back = model.feedback[1] * (speed - velocity) - disturbance
        wanted = (ahead - plant.a22 * speed) / plant.b2 + back
        effort, _ = limited_effort(wanted, direction * before, limit, self._largest_step)
        if effort != wanted:
            reached = plant.a22 * velocity + plant.b2 * (effort + disturbance)
            ahead = self._withheld(course, min(max(reached, min(0.0, speed)), max(goal, speed)))
        if not course.turns:
            top = self._changeover.decide(course, ahead, limit)
            if top is not None:
                ahead = top
                wanted = (ahead - plant.a22 * speed) / plant.b2 + back
        self.rise = ahead - plant.a22 * speed
        course.slope = ahead - speed
        if course.turns and ahead <= 0.0:
            self._turn_round(course, ahead)
        else:
            course.speed = ahead
        if estimate.is_identifying and ahead == goal:
            self._cruise(course)
        return direction * wanted

    def _next_reference(self, course: Course, goal: float) -> float:
        """Return the speed reference a tick ahead on the way to a goal, if nothing withholds it (axis unit/s)."""
        speed = course.speed
        if self._smoothing is not None:
            most = self._largest_rise(course) if speed < goal else self._ramp
            step = self._smoothing.step(self._estimate.model.plant.gain)
            slope = next_slope(course.slope, goal - speed, most, step)
            return goal if slope == goal - speed else speed + slope
        if speed < goal:
            return min(goal, speed + self._largest_rise(course), speed + self._last_rise(goal - speed))
        return max(goal, speed - self._ramp)

    def _withheld(self, course: Course, ahead: float) -> float:
        """Return what a reference becomes whose effort a limit cuts (axis unit/s); a smooth one changes smoothly."""
        if self._smoothing is None:
            return ahead
        step = self._smoothing.step(self._estimate.model.plant.gain)
        even = course.speed + course.slope
        return min(max(ahead, even - step), even + step)

    def _largest_rise(self, course: Course) -> float:
        """Return by how much the speed reference may rise in a tick, in axis unit/s."""
        rules, is_new = self._rules, self._estimate.learning.is_new
        # A smooth one rises by less at its end in any case.
        if not rules.is_cautious or (self._smoothing is not None and not is_new):
            return self._ramp
        rising_s = max(rules.acceleration_ticks * self._loop_period_s, rules.acceleration_s)
        quickest = (rules.overreach * course.cruise_velocity - course.speed) / rising_s
        if is_new:
            quickest = min(quickest, abs(course.target - self._departure.position) / rising_s**2)
        return min(self._ramp, quickest * self._period_s)

    def _last_rise(self, left: float) -> float:
        """Return by how much the speed may rise in a tick for the effort's rate still to let it end at its goal.

        Rises that become smaller by a step each add up to what is left of the speed in whole ticks, and a part.

        Parameters
        ----------
        left
            Speed that is left to the goal, in axis unit/s.
        """
        step = abs(self._estimate.model.sampled.b2) * self._largest_step
        ticks = floor(0.5 * (sqrt(1.0 + 8.0 * left / step) - 1.0))
        return left / (ticks + 1.0) + 0.5 * step * ticks

    def _turn_round(self, course: Course, ahead: float) -> None:
        """Set out for the set-point from rest, or nearly so."""
        position = self._estimate.position
        direction = copysign(1.0, course.target - position)
        if direction != course.direction:
            ahead, course.slope = -ahead, -course.slope
        course.speed = ahead
        course.direction = direction
        course.turns = False
        self._departure.set_out(position)

    def _cruise(self, course: Course) -> None:
        """Count a tick of cruise; end identification where the cruise shows nothing more."""
        course.ticks_cruised += 1
        rules = self._rules
        is_enough = course.ticks_cruised >= rules.identification_ticks and self._estimate.learning.is_sure
        if is_enough or course.ticks_cruised >= rules.longest_identification_ticks:
            self._estimate.finish()
