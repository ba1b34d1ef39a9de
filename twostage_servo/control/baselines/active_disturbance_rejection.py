"""ADRC, active disturbance rejection control, on a trapezoid.

J. Han, From PID to active disturbance rejection control, IEEE Trans. Industrial Electronics 56(3), 2009; its linear
form with one bandwidth each, Z. Gao, Scaling and bandwidth-parameterization based controller tuning, American Control
Conference 2003; sampled, R. Miklosovic, A. Radke and Z. Gao, American Control Conference 2006.

The plant counts as ``y'' = f + b0 u``: everything else, its damping included, is the total disturbance f, which an
extended state observer estimates and the effort cancels: ``u = (x_r'' + ω_c² (x_r - z1) + 2 ω_c (v_r - z2) - z3)/b0``.
"""

from math import exp
from typing import Final

import numpy as np

from twostage_servo.control.baselines.profile_following import AtRest, Profile
from twostage_servo.control.baselines.state_feedback import rows
from twostage_servo.control.baselines.trapezoid import ACCELERATION_PARAMETERS, Trapezoid, accelerations
from twostage_servo.control.baselines.tunable import Parameter, TunableLawType, Values
from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import Controller, ControlTask

_PARAMETERS: Final = {
    "observer_bandwidth": Parameter(5.0, 60.0, 300.0, "ω_o: triple pole of the extended state observer, rad/s"),
    "feedback_bandwidth": Parameter(3.0, 20.0, 150.0, "ω_c: double pole of the feedback, rad/s"),
    "gain_share": Parameter(0.4, 1.0, 4.0, "b0, as a share of the plant's gain"),
}


class ActiveDisturbanceRejection:
    """The law of the module, for a task, with a value for each parameter."""

    def __init__(self, task: ControlTask, values: Values) -> None:
        self._task = task
        self._accelerations = accelerations(task, values)
        self._b0 = values["gain_share"] * task.plant.gain
        period_s, pole = task.period_s, exp(-values["observer_bandwidth"] * task.period_s)
        gap = 1.0 - pole
        self._gain = 3.0 * gap, gap * gap * (5.0 + pole) / (2.0 * period_s), gap**3 / period_s**2
        self._kp, self._kd = values["feedback_bandwidth"] ** 2, 2.0 * values["feedback_bandwidth"]
        self._largest_step = task.effort_rate_limit * period_s
        self._z = (0.0, 0.0, 0.0)
        self._effort = self._target = 0.0
        self._profile: Profile = AtRest(0.0)
        self._tick = 0

    def set_target(self, target: float, velocity: float) -> None:
        """Plan a move from the last set-point to another."""
        self._profile = Trapezoid(self._target, target, velocity, *self._accelerations, self._task.period_s)
        self._target, self._tick = target, 0

    def step(self, sample: float) -> float:
        """Process ``y(k-1)``; return ``u(k)``."""
        period_s = self._task.period_s
        z1, z2, z3 = self._z
        l1, l2, l3 = self._gain
        innovation, acceleration = sample - z1, z3 + self._b0 * self._effort
        z1 += period_s * (z2 + 0.5 * period_s * acceleration) + l1 * innovation
        z2 += period_s * acceleration + l2 * innovation
        z3 += l3 * innovation
        self._z = z1, z2, z3
        position, velocity = self._profile.at(self._tick)
        self._tick += 1
        ahead = self._profile.at(self._tick)[1]
        asked = (ahead - velocity) / period_s + self._kp * (position - z1) + self._kd * (velocity - z2) - z3
        self._effort = limited_effort(
            asked / self._b0, self._effort, self._task.effort_limit, self._largest_step
        ).effort
        return self._effort

    def controller(self) -> Controller:
        """Return extended state observer and feedback."""
        period_s, b0 = self._task.period_s, self._b0
        state = np.array([[1.0, period_s, 0.5 * period_s**2], [0.0, 1.0, period_s], [0.0, 0.0, 1.0]])
        effort = np.array([[0.5 * b0 * period_s**2], [b0 * period_s], [0.0]])
        correction = np.array(self._gain).reshape(3, 1)
        row = -np.array([[self._kp, self._kd, 1.0]]) / b0
        closed = state - correction @ np.array([[1.0, 0.0, 0.0]]) + effort @ row
        return Controller(rows(closed), rows(correction), rows(row))


ACTIVE_DISTURBANCE_REJECTION: Final = TunableLawType(
    {**_PARAMETERS, **ACCELERATION_PARAMETERS}, ActiveDisturbanceRejection
)
