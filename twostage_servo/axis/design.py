"""From the settings of an axis to its gains, its observer and its laws."""

import math
from dataclasses import dataclass

from twostage_servo.axis.settings import AxisSettings
from twostage_servo.control.laws.paper import Stage, TwoStageLaw, ending_share
from twostage_servo.control.margins import closed_loop_poles, loop_margins
from twostage_servo.control.model_monitor.monitor import ModelMonitor
from twostage_servo.control.observer import (
    NO_CORRECTION,
    DisturbanceObserver,
    KalmanGain,
    NoiseModel,
    kalman_gain,
)
from twostage_servo.control.optimal import ServoGains, servo_gains
from twostage_servo.control.plant import DiscretePlant, Plant, Triple

REST_SHARE = 0.01
"""Share of the velocity limit at or below which the axis counts as at rest: 2.5 mm/s of the demo's 250."""


DISABLING_TICKS = 3
"""Ticks until a command to disable acts, and until the samples show it: one to leave, one to act, one to be seen."""

MODEL_ERROR = 0.3
"""Share by which the true plant may differ from its model: what an axis has to be good for."""

LEAST_MODULUS_MARGIN = 0.4
"""Smallest distance of a loop from -1 that is taken: a sensitivity peak of 2.5. Up to 2 is usual (K. J. Astrom, R. M.
Murray, *Feedback Systems*, section 12.3); the paper's second example has 1.8."""


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
    settling_time_s: float
    """How long the slowest pole of a stop takes to die down to a hundredth."""

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

    def build_unlimited_law(self) -> TwoStageLaw:
        """Return the nominal law without any limit: what is linear in it."""
        observer = DisturbanceObserver(self.plant, NO_CORRECTION)
        return TwoStageLaw(observer, self.gains, self.period_s)

    def build_model_monitor(self) -> ModelMonitor:
        """Return the test that compares the plant's answer with the model's."""
        plant = Plant(self.settings.plant.gain, self.settings.plant.pole)
        return ModelMonitor(plant, self.period_s, self.noise, 1e-3 * self.settings.limits.innovation_time_ms)

    def changeover_distance(self, velocity: float) -> float:
        """Return the change-over distance p of equation (19), in axis unit, for a velocity in axis unit/s."""
        return abs(velocity) * self.gains.changeover_time_s(self.period_s)

    def ticks(self, duration_ms: float) -> int:
        """Return the ticks that a time in ms takes, rounded up."""
        return math.ceil(duration_ms / (1e3 * self.period_s) - 1e-9)

    def braking_effort_time_s(self, velocity: float, deceleration: float) -> float:
        """Return how long the effort rate takes from the effort of a cruise to that of braking, in s."""
        plant, limits = self.settings.plant, self.settings.limits
        cruise = abs(velocity * plant.pole / plant.gain)
        swing = min(abs(deceleration / plant.gain), cruise + limits.effort)
        return swing / limits.effort_rate

    def attainable(self, deceleration: float) -> float:
        """Return the part of a deceleration (axis unit/s²) that limit and rate of the effort allow.

        Friction helps less and less as the axis slows down, and the effort has to take over at its rate.
        """
        plant, limits = self.settings.plant, self.settings.limits
        return min(deceleration, abs(plant.gain) * limits.effort, abs(plant.gain) * limits.effort_rate / plant.pole)

    @property
    def least_pole(self) -> float:
        """Pole of the plant that coasts for the longest, of those that are no more off the model than they may, 1/s."""
        return self.settings.plant.pole * (1.0 - MODEL_ERROR)

    @property
    def coasting_s(self) -> float:
        """How far an axis goes at most when it is told to disable, for each axis unit/s of its speed, in s.

        It has its speed for some ticks, until the drive has taken the command, and then coasts by ``v / pole``.
        """
        return 1.0 / self.least_pole + DISABLING_TICKS * self.period_s

    def sample_tolerance(self, resolution: float) -> float:
        """Return how far a sample may be off that is believed, in axis unit.

        Parameters
        ----------
        resolution
            Step in which the encoder's position is reported, in axis unit; 0 if it has none.
        """
        return self.settings.limits.innovation + 2.0 * resolution

    def stopping_distance(self, velocity: float, deceleration: float) -> float:
        """Return how far the axis travels in a stop, in axis unit, not negative.

        The ramp's own ``v²/2a``, a tick until the first effort of it acts, the time that the effort rate takes, and the
        gradual end: where a share s of the speed is less than a step of the ramp, ``a T``, the speed falls by that
        share in a tick, which takes ``v T (1/s - 1/2)``.

        Parameters
        ----------
        velocity
            Speed from which it stops, in axis unit/s.
        deceleration
            Slope of the speed reference, in axis unit/s².
        """
        speed, attainable = abs(velocity), self.attainable(deceleration)
        share = ending_share(self.period_s)
        ending_speed = min(speed, attainable * self.period_s / share)
        ending_s = self.period_s * (1.0 / share - 0.5) - ending_speed / (2.0 * attainable)
        steepest = min(attainable, share * speed / self.period_s)
        return self._ramp_distance(speed, deceleration, steepest) + ending_speed * ending_s

    def certain_stopping_distance(self, velocity: float, deceleration: float) -> float:
        """Return how far the axis travels at most in a stop if its plant is off its model, in axis unit.

        A plant that answers by a share less keeps that share of its speed when the ramp ends, and coasts.
        """
        coasting = abs(velocity) / self.settings.plant.pole
        ramp = self._ramp_distance(abs(velocity), deceleration, deceleration)
        return max(ramp + MODEL_ERROR * coasting, self.stopping_distance(velocity, deceleration))

    def _ramp_distance(self, speed: float, deceleration: float, steepest: float) -> float:
        """Return the way of a ramp to its sharp end, whose effort is that of a deceleration `steepest`."""
        delay_s = self.period_s + self.braking_effort_time_s(speed, steepest)
        return speed * delay_s + speed**2 / (2.0 * self.attainable(deceleration))

    def stopping_time_s(self, velocity: float, deceleration: float) -> float:
        """Return how long a stop takes, in s: the ramp, the effort rate, and until the rest has died down."""
        ramp_s = abs(velocity) / self.attainable(deceleration) + self.braking_effort_time_s(velocity, deceleration)
        return ramp_s + self.settling_time_s

    def _law(self, gain: Triple) -> TwoStageLaw:
        return TwoStageLaw(
            DisturbanceObserver(self.plant, gain, self.noise.disturbance_memory),
            self.gains,
            self.period_s,
            acceleration_limit=self.settings.limits.acceleration,
            effort_limit=self.settings.limits.effort,
            effort_rate_limit=self.settings.limits.effort_rate,
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
    settling_time_s = 0.0
    for stage in Stage:
        radius = max(abs(pole) for pole in closed_loop_poles(sampled, gains, kalman, noise, stage))
        if radius >= 1.0:
            raise DesignError(
                ("axis", "law", "performance_index_ratio"),
                f"the {stage.name.lower()} stage would be unstable: its closed loop has a pole of magnitude "
                f"{radius:.4f}; choose a smaller Q/R (see `design`)",
            )
        margin = loop_margins(sampled, gains, kalman, noise, stage, frequencies=2_000).modulus_margin
        if margin < LEAST_MODULUS_MARGIN:
            raise DesignError(
                ("axis", "law", "performance_index_ratio"),
                f"the {stage.name.lower()} stage would be fragile: its modulus margin is {margin:.3f}, and at least "
                f"{LEAST_MODULUS_MARGIN:g} is needed; choose a smaller Q/R, or other observer variances (see `design`)",
            )
        if stage is Stage.BRAKE:
            settling_time_s = period_s * math.log(REST_SHARE) / math.log(max(radius, 1e-9))
    return AxisDesign(settings, period_s, sampled, gains, noise, kalman, settling_time_s)
