"""The speed stage of the baselines with two stages: velocity feedback with a disturbance observer."""

from math import exp
from typing import Final

from twostage_servo.control.baselines.tunable import Parameter, Values
from twostage_servo.control.laws.law import ControlTask
from twostage_servo.control.observer import DisturbanceObserver

SPEED_PARAMETERS: Final = {"speed_frequency": Parameter(5.0, 60.0, 400.0, "pole of the speed stage, rad/s")}


class SpeedStage:
    """``u = (1 - a22)/b2 v + k (v - x2) - x3``, with k for one pole."""

    def __init__(self, task: ControlTask, values: Values) -> None:
        plant = task.sampled
        self._cruise = (1.0 - plant.a22) / plant.b2
        self._gain = (plant.a22 - exp(-values["speed_frequency"] * task.period_s)) / plant.b2

    def effort(self, velocity: float, observer: DisturbanceObserver) -> float:
        """Return the effort, without limits, that brings the axis to a velocity in axis unit/s."""
        return self._cruise * velocity + self._gain * (velocity - observer.velocity) - observer.disturbance
