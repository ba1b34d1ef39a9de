"""The position stage: it follows the braking reference to the set-point, and holds it.

A model of the axis runs along the reference, and ``u = u_ff + f2 g(x_r - x1) + f2 (v_r - x2) - x3`` feeds back what the
axis is off it. ``g(e)`` is ``(f1/f2) e`` for a small error, and grows with its root beyond, so that quick poles do not
ask for more than the effort's rate gives.
"""

from math import copysign, sqrt
from typing import Final

from twostage_servo.control.laws.adaptive.course import Course
from twostage_servo.control.laws.adaptive.estimate import ControlEstimate
from twostage_servo.control.laws.adaptive.rules import Rules
from twostage_servo.control.laws.law import ControlTask

_END_OF_IDENTIFICATION: Final = 0.15
"""Share of the top speed below which a braking shows nothing more of the plant."""


class PositionStage:
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

    __slots__ = ("_estimate", "_largest_step", "_pull_share")

    def __init__(self, estimate: ControlEstimate, task: ControlTask, rules: Rules) -> None:
        self._estimate = estimate
        self._largest_step = task.effort_rate_limit * task.period_s
        self._pull_share = rules.pull_share

    def step(self, course: Course) -> float:
        """Move the course on by a tick; return the effort that follows it, in effort unit, without its limits."""
        estimate, speed = self._estimate, course.speed
        if estimate.is_identifying and speed < _END_OF_IDENTIFICATION * course.top:
            estimate.finish()
        model, direction = estimate.model, course.direction
        plant = model.sampled
        ahead = forward = 0.0
        if course.braking is not None:
            ahead = course.braking.advance(model.ways)
            forward = (ahead - plant.a22 * speed) / plant.b2
        velocity_error = direction * speed - estimate.velocity
        back = self._pull(course.position - estimate.position) + model.feedback[1] * velocity_error
        course.position += direction * (plant.a12 * speed + plant.b1 * forward)
        if course.braking is None or course.braking.done:
            course.position = course.target
            if course.braking is not None:
                estimate.come_to_rest(direction)
            course.braking = None
        course.speed, course.slope = ahead, ahead - speed
        return direction * forward + back - estimate.disturbance

    def _pull(self, error: float) -> float:
        """Return the effort for an error of the position (axis unit), in effort unit."""
        model = self._estimate.model
        f1, f2 = model.feedback
        quickness = f1 / f2
        most = self._pull_share * abs(model.plant.gain) * self._largest_step  # in axis unit/s²
        linear = most / (quickness * quickness)
        if abs(error) <= linear:
            return f1 * error
        return copysign(f2 * sqrt(2.0 * most * (abs(error) - 0.5 * linear)), error)
