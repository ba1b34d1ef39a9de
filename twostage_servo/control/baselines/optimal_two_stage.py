"""The paper's law itself, with its performance index ratio and its noise intensities left to the optimiser.

It shows what is in the law of :mod:`twostage_servo.control.laws.paper`, apart from the values that an axis has by
default: equations (11), (26)-(30).
"""

import functools
from typing import Final

from twostage_servo.control.baselines.tunable import Parameter, TunableLawType, Values
from twostage_servo.control.laws.law import Controller, ControlTask, Stage
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.laws.paper_margins import stage_controller
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.optimal import servo_gains

_PARAMETERS: Final = {
    "performance_index_ratio": Parameter(1e-6, 5e-3, 1e3, "Q/R of the optimal design"),
    "position_variance": Parameter(1e-6, 0.1, 1e3, "process variance of the position, mm²; a sample's is 0.01"),
    "velocity_variance": Parameter(1e-4, 0.1, 1e6, "process variance of the velocity, (mm/s)²"),
    "disturbance_variance": Parameter(1e-6, 0.1, 1e4, "process variance of the disturbance, (effort unit)²"),
}
_gains = functools.lru_cache(maxsize=64)(servo_gains)


class OptimalTwoStage:
    """The law of the module, for a task, with a value for each parameter.

    Raises
    ------
    ValueError
        If a Riccati equation has no solution.
    """

    def __init__(self, task: ControlTask, values: Values) -> None:
        plant = task.sampled
        self._noise = NoiseModel(
            (values["position_variance"], values["velocity_variance"], values["disturbance_variance"])
        )
        self._kalman = kalman_gain(plant, self._noise)
        self._gains = _gains(plant, values["performance_index_ratio"])
        self._plant = plant
        self._law = TwoStageLaw(
            DisturbanceObserver(plant, self._kalman.predictor),
            self._gains,
            task.period_s,
            acceleration_limit=task.acceleration_limit,
            effort_limit=task.effort_limit,
            effort_rate_limit=task.effort_rate_limit,
        )

    def set_target(self, target: float, velocity: float) -> None:
        """Go to another set-point."""
        self._law.set_target(target, velocity)

    def step(self, sample: float) -> float:
        """Process ``y(k-1)``; return ``u(k)``."""
        return self._law.step(sample)

    def controller(self) -> Controller:
        """Return the position stage."""
        return stage_controller(self._plant, self._gains, self._kalman, self._noise, Stage.POSITION)


OPTIMAL_TWO_STAGE: Final = TunableLawType(_PARAMETERS, OptimalTwoStage)
