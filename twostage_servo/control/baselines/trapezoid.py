"""A trapezoid of velocity, followed with feed-forward, state feedback and a disturbance observer.

The profile of nearly every motion controller; see for example L. Biagiotti and C. Melchiorri, Trajectory Planning for
Automatic Machines and Robots, Springer 2008, section 3.2. Its three parts take whole ticks, which costs less than a
tick: so the reference can be followed exactly at each of them.
"""

from math import ceil, copysign, sqrt
from typing import Final

from twostage_servo.control.baselines.profile_following import ProfileServo
from twostage_servo.control.baselines.state_feedback import FEEDBACK_PARAMETERS, OBSERVER_PARAMETERS
from twostage_servo.control.baselines.tunable import Parameter, TunableLawType, Values
from twostage_servo.control.laws.law import ControlTask

ACCELERATION_PARAMETERS: Final = {
    "acceleration_share": Parameter(0.02, 0.9, 2.0, "acceleration, as a share of what the effort limit gives at rest"),
    "deceleration_share": Parameter(0.02, 0.15, 2.0, "deceleration, as a share of the same"),
}


class Trapezoid:
    """Constant acceleration, cruise and constant deceleration, each in whole ticks.

    Parameters
    ----------
    start, target
        In axis unit.
    velocity
        Largest, in axis unit/s.
    acceleration, deceleration
        Largest, in axis unit/s².
    period_s
        The tick, in s.
    """

    def __init__(
        self, start: float, target: float, velocity: float, acceleration: float, deceleration: float, period_s: float
    ) -> None:
        way = abs(target - start)
        self._start, self._target, self._period_s = start, target, period_s
        self._direction = copysign(1.0, target - start)
        # The peak of a triangle, where the way is too short for a cruise.
        top = min(velocity, sqrt(2.0 * way * acceleration * deceleration / (acceleration + deceleration)))
        self._up = max(1, ceil(top / (acceleration * period_s) - 1e-9))
        self._down = max(1, ceil(top / (deceleration * period_s) - 1e-9))
        ramps = 0.5 * (self._up + self._down)
        self._flat = max(0, ceil(way / (top * period_s) - ramps - 1e-9)) if way > 0.0 else 0
        self._top = way / ((ramps + self._flat) * period_s)

    def at(self, tick: int) -> tuple[float, float]:
        """Return position and velocity, so many ticks after the beginning."""
        up, flat, down, top, period_s = self._up, self._flat, self._down, self._top, self._period_s
        left = up + flat + down - tick
        if left <= 0:
            return self._target, 0.0
        if tick < up:
            velocity = top * tick / up
            return self._start + self._direction * 0.5 * velocity * tick * period_s, self._direction * velocity
        if left > down:
            way = top * (0.5 * up + tick - up) * period_s
            return self._start + self._direction * way, self._direction * top
        velocity = top * left / down
        return self._target - self._direction * 0.5 * velocity * left * period_s, self._direction * velocity


def accelerations(task: ControlTask, values: Values) -> tuple[float, float]:
    """Return acceleration and deceleration in axis unit/s² for the values of :data:`ACCELERATION_PARAMETERS`."""
    most = abs(task.plant.gain) * task.effort_limit
    return tuple(  # type: ignore[return-value]  # two shares give two
        min(values[name] * most, task.acceleration_limit) for name in ACCELERATION_PARAMETERS
    )


def _build(task: ControlTask, values: Values) -> ProfileServo:
    up, down = accelerations(task, values)

    def plan(start: float, target: float, velocity: float) -> Trapezoid:
        return Trapezoid(start, target, velocity, up, down, task.period_s)

    return ProfileServo(task, values, plan)


TRAPEZOID: Final = TunableLawType({**ACCELERATION_PARAMETERS, **FEEDBACK_PARAMETERS, **OBSERVER_PARAMETERS}, _build)
