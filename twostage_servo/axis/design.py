"""From the settings of an axis to its gains, its observer and its laws."""

import math
from dataclasses import dataclass

from twostage_servo.axis.settings import AxisSettings
from twostage_servo.control.margins import closed_loop_poles
from twostage_servo.control.observer import (
    NO_CORRECTION,
    DisturbanceObserver,
    KalmanGain,
    NoiseModel,
    kalman_gain,
)
from twostage_servo.control.optimal import ServoGains, servo_gains
from twostage_servo.control.plant import DiscretePlant, Plant, Triple
from twostage_servo.control.two_stage import Stage, TwoStageLaw

REST_SHARE = 0.01
"""Share of the velocity limit at or below which the axis counts as at rest: 2.5 mm/s of the demo's 250."""


class DesignError(ValueError):
    """The settings describe an axis for which no law can be designed; ``key`` is the dotted config key at fault."""

    def __init__(self, key: tuple[str, ...], message: str) -> None:
        super().__init__(message)
        self.key = key


@dataclass(frozen=True, slots=True)
class AxisDesign:
    """Everything that follows from the settings, computed once when they are loaded."""

    settings: AxisSettings
    period_s: float
    plant: DiscretePlant
    gains: ServoGains
    noise: NoiseModel
    kalman: KalmanGain

    @property
    def rest_velocity(self) -> float:
        """Speed in axis unit/s at or below which the axis counts as at rest."""
        return REST_SHARE * self.settings.limits.velocity

    def build_law(self) -> TwoStageLaw:
        """Return the law that drives the axis."""
        return self._law(self.kalman.predictor)

    def build_nominal_law(self) -> TwoStageLaw:
        """Return the same law on a free-running model of the plant: the response that the axis is designed to give."""
        return self._law(NO_CORRECTION)

    def changeover_distance(self, velocity: float) -> float:
        """Return the change-over distance p of equation (19), in axis unit, for a velocity in axis unit/s."""
        return abs(velocity) * self.gains.changeover_time_s(self.period_s)

    def _law(self, gain: Triple) -> TwoStageLaw:
        return TwoStageLaw(
            DisturbanceObserver(self.plant, gain, self.noise.disturbance_memory),
            self.gains,
            self.period_s,
            acceleration_limit=self.settings.limits.acceleration,
            effort_limit=self.settings.limits.effort,
            rest_velocity=self.rest_velocity,
        )


def design_axis(settings: AxisSettings, period_s: float) -> AxisDesign:
    """Compute gains and observer for a tick of `period_s`.

    Raises
    ------
    DesignError
        If a loop would be unstable, no optimal gains or no Kalman gain exist, or the effort limit is too low to cruise.
    """
    plant = Plant(settings.plant.gain, settings.plant.pole)
    sampled = plant.discretise(period_s)
    observer = settings.observer
    noise = NoiseModel(
        (observer.position_variance, observer.velocity_variance, observer.disturbance_variance),
        observer.measurement_variance,
        observer.disturbance_memory,
    )
    try:
        gains = servo_gains(sampled, settings.law.performance_index_ratio)
    except ValueError as error:
        raise DesignError(("axis", "law", "performance_index_ratio"), str(error)) from error
    if not all(math.isfinite(gain) and gain * settings.plant.gain > 0.0 for gain in (gains.f11, gains.f22)):
        raise DesignError(
            ("axis", "law", "performance_index_ratio"),
            f"the optimal design gives f11 = {gains.f11:g}, f22 = {gains.f22:g}, which cannot drive this plant; "
            "choose a larger Q/R",
        )
    try:
        kalman = kalman_gain(sampled, noise)
    except ValueError as error:
        raise DesignError(("axis", "observer"), str(error)) from error
    needed = abs(plant.cruise_effort(settings.limits.velocity))
    if needed >= settings.limits.effort:
        raise DesignError(
            ("axis", "limits", "effort"),
            f"a cruise at limits.velocity = {settings.limits.velocity:g} {settings.unit}/s takes {needed:g} "
            f"{settings.effort_unit}, and limits.effort is {settings.limits.effort:g}; lower the velocity limit below "
            f"{abs(settings.limits.effort * settings.plant.gain / settings.plant.pole):g} or raise the effort limit",
        )
    for stage in Stage:
        radius = max(abs(pole) for pole in closed_loop_poles(sampled, gains, kalman, noise, stage))
        if radius >= 1.0:
            raise DesignError(
                ("axis", "law", "performance_index_ratio"),
                f"the {stage.name.lower()} stage would be unstable: its closed loop has a pole of magnitude "
                f"{radius:.4f}; choose a smaller Q/R (see `design`)",
            )
    return AxisDesign(settings, period_s, sampled, gains, noise, kalman)
