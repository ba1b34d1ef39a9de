"""Mode switching with initial value compensation (IVC): two stages, and the second begins with the best initial state.

T. Yamaguchi, H. Numasato and H. Hirai, A mode-switching control for motion control and its application to disk drives:
design of optimal mode-switching conditions, IEEE/ASME Trans. Mechatronics 3(3), 1998; T. Yamaguchi, K. Shishida, S.
Tohyama and H. Hirai, Mode switching control design with initial value compensation and its application to head
positioning control on magnetic disk drives, IEEE Trans. Industrial Electronics 43(1), 1996.

The position stage is ``u = I - f1 (x1 - r) - f2 x2``, and I adds up ``f3 (r - y)``. At the change-over, at the distance
``τ x2``, the sum is set so that ``J = sum (e² + λ u²)`` of the response to come is least: with J as a quadratic form of
error, velocity and sum, from a Lyapunov equation, ``I = -(P31 e + P32 x2)/P33``, beside what balances the load. The
effort may step there.
"""

from math import copysign, exp
from typing import Final

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from twostage_servo.control.baselines.speed_stage import SPEED_PARAMETERS, SpeedStage
from twostage_servo.control.baselines.state_feedback import (
    FEEDBACK_PARAMETERS,
    OBSERVER_PARAMETERS,
    Pair,
    rows,
    tuned_observer,
    tuned_observer_gain,
)
from twostage_servo.control.baselines.tunable import Parameter, TunableLawType, Values
from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import Controller, ControlTask
from twostage_servo.control.observer import extended_model
from twostage_servo.control.plant import DiscretePlant, Triple

_PARAMETERS: Final = {
    "sum_frequency": Parameter(2.0, 15.0, 150.0, "third pole of the position stage, that of its sum, rad/s"),
    "changeover_s": Parameter(0.01, 0.1, 0.5, "τ: distance of the change-over for each axis unit/s, s"),
    "effort_weight": Parameter(1e-6, 1e-2, 1e2, "λ: of the effort in the cost, (axis unit/effort unit)²"),
}


def sum_gains(plant: DiscretePlant, pair: Pair, single: float) -> Triple:
    """Return f1, f2 and f3 of ``u = I - f1 x1 - f2 x2``, ``I(k+1) = I - f3 x1``, for three poles in z.

    The closed loop's polynomial is ``(z-1) [(z-1+b1 f1)(z-a22+b2 f2) + (a12-b1 f2) b2 f1] + f3 (b1 (z-a22) + a12 b2)``.
    At z = 1 only f3 is left, and the coefficients of z² and z give two linear equations for f1 and f2.
    """
    a12, a22, b1, b2 = plant.a12, plant.a22, plant.b1, plant.b2
    f3 = (1.0 - single) * pair.at(1.0) / (b2 * plant.period_s)
    # Wanted: z³ + c2 z² + c1 z + c0.
    c2, c1 = -(single + pair.total), single * pair.total + pair.product
    # The bracket is z² + (b1 f1 + b2 f2 - 1 - a22) z + q with q = a22 - a22 b1 f1 - b2 f2 + a12 b2 f1.
    left = np.array([[b1, b2], [-a22 * b1 + a12 * b2 - b1, -2.0 * b2]])
    right = np.array([c2 + 2.0 + a22, c1 - a22 - 1.0 - a22 - f3 * b1])
    f1, f2 = np.linalg.solve(left, right)
    return float(f1), float(f2), f3


class InitialValueServo:
    """The law of the module, for a task, with a value for each parameter.

    Attributes
    ----------
    initial_value
        Factors of error ``x1 - r`` and velocity in the sum that the position stage begins with.
    """

    def __init__(self, task: ControlTask, values: Values) -> None:
        self._task = task
        self._gain = tuned_observer_gain(task, values)
        self._observer = tuned_observer(task, values)
        self._speed_stage = SpeedStage(task, values)
        pair = Pair.of(values["feedback_frequency"], values["feedback_damping"], task.period_s)
        self._gains = sum_gains(task.sampled, pair, exp(-values["sum_frequency"] * task.period_s))
        self.initial_value = self._best_initial_value(values["effort_weight"])
        self._changeover_s = values["changeover_s"]
        self._largest_step = task.effort_rate_limit * task.period_s
        self._effort = self._target = self._velocity = self._sum = 0.0
        self._in_position = True

    def _best_initial_value(self, effort_weight: float) -> tuple[float, float]:
        """Return the factors of error ``x1 - r`` and velocity in the best initial sum."""
        plant, (f1, f2, f3) = self._task.sampled, self._gains
        row = np.array([[-f1, -f2, 1.0]])
        effort = np.array([[plant.b1], [plant.b2], [0.0]])
        state = np.array([[1.0, plant.a12, 0.0], [0.0, plant.a22, 0.0], [-f3, 0.0, 1.0]]) + effort @ row
        # What differs from rest costs; the effort that holds a speed is not needed at the set-point, and so costs too.
        cost = solve_discrete_lyapunov(state.T, np.diag([1.0, 0.0, 0.0]) + effort_weight * row.T @ row)
        return float(-cost[2, 0] / cost[2, 2]), float(-cost[2, 1] / cost[2, 2])

    def set_target(self, target: float, velocity: float) -> None:
        """Go to another set-point, from rest."""
        self._target = target
        self._velocity = copysign(velocity, target - self._observer.position)
        self._in_position = False

    def step(self, sample: float) -> float:
        """Process ``y(k-1)``; return ``u(k)``."""
        observer, (f1, f2, f3) = self._observer, self._gains
        observer.update(sample, self._effort)
        direction = copysign(1.0, self._velocity)
        error = observer.position - self._target
        if self._in_position:
            self._sum += f3 * (self._target - sample)
        elif -direction * error <= self._changeover_s * max(0.0, direction * observer.velocity):
            self._in_position = True
            of_error, of_velocity = self.initial_value
            self._sum = of_error * error + of_velocity * observer.velocity - observer.disturbance
        if not self._in_position:
            wanted = self._speed_stage.effort(self._velocity, observer)
        else:
            wanted = self._sum - f1 * error - f2 * observer.velocity
        effort = limited_effort(wanted, self._effort, self._task.effort_limit, self._largest_step).effort
        if self._in_position:
            self._sum += effort - wanted  # back-calculation: nothing winds up
        self._effort = effort
        return effort

    def controller(self) -> Controller:
        """Return the position stage: observer, feedback and sum."""
        state, effort, output = extended_model(self._task.sampled, 1.0)
        f1, f2, f3 = self._gains
        correction, row = np.array(self._gain).reshape(3, 1), np.array([[f1, f2, 0.0]])
        a = np.block([[state - correction @ output - effort @ row, effort], [np.zeros((1, 3)), np.eye(1)]])
        return Controller(rows(a), rows(np.vstack([correction, [[-f3]]])), rows(np.hstack([-row, [[1.0]]])))


INITIAL_VALUE: Final = TunableLawType(
    {**_PARAMETERS, **FEEDBACK_PARAMETERS, **SPEED_PARAMETERS, **OBSERVER_PARAMETERS}, InitialValueServo
)
