"""PTOS, the proximate time-optimal servomechanism, with a cap on the speed and a disturbance observer.

M. L. Workman, Adaptive Proximate Time-Optimal Servomechanisms, dissertation, Stanford University 1987; in G. F.
Franklin, J. D. Powell and M. L. Workman, Digital Control of Dynamic Systems, 3rd edition, section 11.4. For
``y'' = b u``, with the error e and the limit U:

``u = sat(k2 (f(e) - v))`` with ``f(e) = k1/k2 e`` up to ``|e| = U/k1``, and ``±(sqrt(2 U alpha b |e|) - U/k2)`` beyond.

``k2 = sqrt(2 k1/(b alpha))`` makes value and slope of f continuous; alpha < 1 leaves effort for what the model does not
know. The plant's own damping is compensated by ``a/b v``, a load by the observer, and f is capped at the cruise
velocity.
"""

from math import copysign, inf, sqrt
from typing import Final

from twostage_servo.control.baselines.state_feedback import (
    OBSERVER_PARAMETERS,
    linear_controller,
    tuned_observer,
    tuned_observer_gain,
)
from twostage_servo.control.baselines.tunable import Parameter, TunableLawType, Values
from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import Controller, ControlTask

_PARAMETERS: Final = {
    "frequency": Parameter(3.0, 20.0, 120.0, "natural frequency of its linear region, sqrt(b k1), rad/s"),
    "effort_share": Parameter(0.1, 0.6, 1.0, "alpha: of the effort, for the planned braking"),
}


class ProximateTimeOptimalServo:
    """The law of the module, for a task, with a value for each parameter.

    Attributes
    ----------
    velocity_gain
        k2, in effort unit s/axis unit.
    """

    def __init__(self, task: ControlTask, values: Values) -> None:
        plant = task.plant
        self._task = task
        self._gain = tuned_observer_gain(task, values)
        self._observer = tuned_observer(task, values)
        self._k1 = values["frequency"] ** 2 / plant.gain
        self.velocity_gain = copysign(sqrt(2.0 * self._k1 / (plant.gain * values["effort_share"])), plant.gain)
        self._damping = plant.pole / plant.gain
        self._braking = task.effort_limit * values["effort_share"] * abs(plant.gain)
        self._largest_step = task.effort_rate_limit * task.period_s
        self._effort = self._target = 0.0
        self._velocity = inf

    def set_target(self, target: float, velocity: float) -> None:
        """Go to another set-point."""
        self._target, self._velocity = target, velocity

    def step(self, sample: float) -> float:
        """Process ``y(k-1)``; return ``u(k)``."""
        observer = self._observer
        observer.update(sample, self._effort)
        velocity = self.asked_velocity(self._target - observer.position)
        speed = observer.velocity
        wanted = self.velocity_gain * (velocity - speed) + self._damping * speed - observer.disturbance
        self._effort = limited_effort(wanted, self._effort, self._task.effort_limit, self._largest_step).effort
        return self._effort

    def asked_velocity(self, error: float) -> float:
        """Return f(e) with its cap, in axis unit/s, for an error in axis unit."""
        limit = self._task.effort_limit
        if abs(error) <= limit / abs(self._k1):
            wanted = self._k1 / self.velocity_gain * error
        else:
            wanted = copysign(sqrt(2.0 * self._braking * abs(error)) - limit / abs(self.velocity_gain), error)
        return min(max(wanted, -self._velocity), self._velocity)

    def controller(self) -> Controller:
        """Return its linear region."""
        return linear_controller(self._task.sampled, self._gain, (self._k1, self.velocity_gain - self._damping, 1.0))


PROXIMATE_TIME_OPTIMAL: Final = TunableLawType({**_PARAMETERS, **OBSERVER_PARAMETERS}, ProximateTimeOptimalServo)
