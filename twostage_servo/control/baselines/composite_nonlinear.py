"""A speed stage, then composite nonlinear feedback (CNF), with a disturbance observer.

B. M. Chen, T. H. Lee, K. Peng and V. Venkataramanan, Composite nonlinear feedback control for linear systems with input
saturation: theory and an application, IEEE Trans. Automatic Control 48(3), 2003; in discrete time V. Venkataramanan,
K. Peng, B. M. Chen and T. H. Lee, IEEE Trans. Control Systems Technology 11(1), 2003. With F for lightly damped poles
and ``P = (A - B F)' P (A - B F) + W``:

``u = -F (x - x_e) + rho(e) B' P (A - B F) (x - x_e)`` with ``-2/(B' P B) <= rho <= 0``,

and rho grows as the error dies down: quick at first, well damped at the end. Here
``rho = -beta/(B' P B) exp(-alpha |e|/p)``.

The speed stage holds the cruise velocity. The change-over comes in the first tick in which CNF asks for no more effort
than it, so the effort steps by what CNF changes in a tick at most; p is the distance at that instant.
"""

from math import copysign, exp
from typing import Final

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from twostage_servo.control.baselines.speed_stage import SPEED_PARAMETERS, SpeedStage
from twostage_servo.control.baselines.state_feedback import (
    FEEDBACK_PARAMETERS,
    OBSERVER_PARAMETERS,
    linear_controller,
    tuned_feedback,
    tuned_observer,
    tuned_observer_gain,
)
from twostage_servo.control.baselines.tunable import Parameter, TunableLawType, Values
from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import Controller, ControlTask

_PARAMETERS: Final = {
    "nonlinear_share": Parameter(1e-3, 0.05, 2.0, "beta: of the nonlinear part, at the set-point"),
    "nonlinear_decay": Parameter(0.1, 3.0, 100.0, "alpha: how closely the nonlinear part keeps to the set-point"),
    "velocity_weight_s": Parameter(1e-3, 0.03, 1.0, "weight of the velocity in W, beside 1 for the position, s"),
}


class CompositeNonlinearServo:
    """The law of the module, for a task, with a value for each parameter."""

    def __init__(self, task: ControlTask, values: Values) -> None:
        self._task = task
        self._gain = tuned_observer_gain(task, values)
        self._observer = tuned_observer(task, values)
        self._speed_stage = SpeedStage(task, values)
        self._f1, self._f2 = tuned_feedback(task, values)
        self._n1, self._n2 = self._nonlinear_gains(values)
        self._decay = values["nonlinear_decay"]
        self._largest_step = task.effort_rate_limit * task.period_s
        self._effort = self._target = self._velocity = 0.0
        self._distance = 1.0
        self._in_position = True

    def _nonlinear_gains(self, values: Values) -> tuple[float, float]:
        """Return ``beta B' P (A - B F)/(B' P B)``."""
        plant = self._task.sampled
        state = np.array([[1.0, plant.a12], [0.0, plant.a22]])
        effort = np.array([[plant.b1], [plant.b2]])
        closed = state - effort @ np.array([[self._f1, self._f2]])
        weight = np.diag([1.0, values["velocity_weight_s"] ** 2])
        cost = solve_discrete_lyapunov(closed.T, weight)
        row = values["nonlinear_share"] * (effort.T @ cost @ closed) / float((effort.T @ cost @ effort)[0, 0])
        return float(row[0, 0]), float(row[0, 1])

    def set_target(self, target: float, velocity: float) -> None:
        """Go to another set-point, from rest."""
        self._target = target
        self._velocity = copysign(velocity, target - self._observer.position)
        self._in_position = False

    def step(self, sample: float) -> float:
        """Process ``y(k-1)``; return ``u(k)``."""
        observer = self._observer
        observer.update(sample, self._effort)
        error = self._target - observer.position
        if self._in_position:
            wanted = self._position_stage(error, abs(error) / self._distance)
        else:
            wanted = self._speed_stage.effort(self._velocity, observer)
            in_position = self._position_stage(error, 1.0)
            forward = copysign(1.0, self._velocity) * copysign(1.0, self._task.plant.gain)
            if forward * in_position <= min(forward * wanted, self._task.effort_limit):
                self._in_position, self._distance = True, max(abs(error), 1e-12)
                wanted = in_position
        self._effort = limited_effort(wanted, self._effort, self._task.effort_limit, self._largest_step).effort
        return self._effort

    def _position_stage(self, error: float, share: float) -> float:
        """Return the effort of CNF at an error that is this share of the change-over distance."""
        observer = self._observer
        blend = exp(-self._decay * share)
        return (
            (self._f1 + blend * self._n1) * error
            - (self._f2 + blend * self._n2) * observer.velocity
            - observer.disturbance
        )

    def controller(self) -> Controller:
        """Return the law with the nonlinear part's value at the set-point."""
        return linear_controller(self._task.sampled, self._gain, (self._f1 + self._n1, self._f2 + self._n2, 1.0))


COMPOSITE_NONLINEAR: Final = TunableLawType(
    {**_PARAMETERS, **FEEDBACK_PARAMETERS, **SPEED_PARAMETERS, **OBSERVER_PARAMETERS}, CompositeNonlinearServo
)
