"""What the baselines share that feed back an estimated state: their poles, the gains for these, and the linear loop.

Poles are given as in continuous time, by a natural frequency and a damping ratio, and mapped by ``z = exp(s T)``.
"""

from dataclasses import dataclass
from math import cos, exp, sqrt
from typing import Final

import numpy as np

from twostage_servo.control.baselines.tunable import Parameter, Values
from twostage_servo.control.laws.law import Controller, ControlTask
from twostage_servo.control.observer import DisturbanceObserver, extended_model
from twostage_servo.control.plant import DiscretePlant, Triple

OBSERVER_PARAMETERS: Final = {
    "observer_single": Parameter(3.0, 30.0, 400.0, "real pole of the disturbance observer, rad/s"),
    "observer_frequency": Parameter(3.0, 220.0, 310.0, "natural frequency of its other two poles, rad/s"),
    "observer_damping": Parameter(0.15, 0.5, 1.0, "damping ratio of these"),
}
FEEDBACK_PARAMETERS: Final = {
    "feedback_frequency": Parameter(3.0, 22.0, 310.0, "natural frequency of the position loop, rad/s"),
    "feedback_damping": Parameter(0.3, 0.95, 1.0, "damping ratio of the position loop"),
}


@dataclass(frozen=True, slots=True)
class Pair:
    """Two poles in z by their polynomial ``z² - total z + product``."""

    total: float
    product: float

    @staticmethod
    def of(frequency: float, damping: float, period_s: float) -> "Pair":
        """Return the pair of a natural frequency in rad/s and a damping ratio of 1 at most."""
        decay = exp(-damping * frequency * period_s)
        return Pair(2.0 * decay * cos(frequency * period_s * sqrt(max(0.0, 1.0 - damping * damping))), decay * decay)

    def at(self, z: float) -> float:
        """Return the value of the polynomial."""
        return (z - self.total) * z + self.product


def observer_gain(plant: DiscretePlant, single: float, pair: Pair) -> Triple:
    """Return the gain with which a disturbance observer has a real pole and a pair of poles, in z.

    ``det(z I - A_o + L C) = (z-1)(z-a22)(z-1+L1) + a12 L2 (z-1) + (b1 (z-a22) + a12 b2) L3``. At z = 1 only the last
    term is left, at z = a22 the last two, and the coefficient of z² holds L1.
    """
    a12, a22, b2 = plant.a12, plant.a22, plant.b2
    third = (1.0 - single) * pair.at(1.0) / (b2 * plant.period_s)
    second = (a12 * b2 * third - (a22 - single) * pair.at(a22)) / (a12 * (1.0 - a22))
    return 2.0 + a22 - single - pair.total, second, third


def feedback_gains(plant: DiscretePlant, pair: Pair) -> tuple[float, float]:
    """Return f1 and f2 of ``u = -f1 x1 - f2 x2``, effort unit per axis unit and per axis unit/s, for two poles in z."""
    f1 = pair.at(1.0) / (plant.b2 * plant.period_s)
    return f1, (1.0 + plant.a22 - plant.b1 * f1 - pair.total) / plant.b2


def tuned_feedback(task: ControlTask, values: Values) -> tuple[float, float]:
    """Return f1 and f2 for the values of :data:`FEEDBACK_PARAMETERS`."""
    pair = Pair.of(values["feedback_frequency"], values["feedback_damping"], task.period_s)
    return feedback_gains(task.sampled, pair)


def tuned_observer_gain(task: ControlTask, values: Values) -> Triple:
    """Return the observer's gain for the values of :data:`OBSERVER_PARAMETERS`."""
    pair = Pair.of(values["observer_frequency"], values["observer_damping"], task.period_s)
    return observer_gain(task.sampled, exp(-values["observer_single"] * task.period_s), pair)


def tuned_observer(task: ControlTask, values: Values) -> DisturbanceObserver:
    """Return a disturbance observer for the values of :data:`OBSERVER_PARAMETERS`."""
    return DisturbanceObserver(task.sampled, tuned_observer_gain(task, values))


def linear_controller(plant: DiscretePlant, gain: Triple, feedback: Triple) -> Controller:
    """Return the controller of a predicting observer and the feedback of its estimate, ``u = -F x_o``.

    Parameters
    ----------
    plant
        The sampled model.
    gain
        The observer's, in predictor form.
    feedback
        Of position, velocity and disturbance; the last is 1 where the disturbance is cancelled.
    """
    state, effort, output = extended_model(plant, 1.0)
    correction, row = np.array(gain).reshape(3, 1), np.array([feedback])
    return Controller(rows(state - correction @ output - effort @ row), rows(correction), rows(-row))


def rows(matrix: "np.typing.NDArray[np.float64]") -> tuple[tuple[float, ...], ...]:
    """Return a matrix row by row."""
    return tuple(tuple(float(value) for value in row) for row in matrix)
