"""From the settings of an axis to its observer, its law and what both come to."""

import math
from dataclasses import dataclass

from twostage_servo.axis.settings import AxisSettings
from twostage_servo.control.laws import law
from twostage_servo.control.laws.law import ControlTask, Law, LawDesign
from twostage_servo.control.laws.registry import LAWS, PAPER
from twostage_servo.control.laws.stop_design import smoothing_distance, smoothing_time_s
from twostage_servo.control.model_monitor.monitor import ModelMonitor
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver, KalmanGain, NoiseModel, kalman_gain
from twostage_servo.control.plant import MODEL_ERROR, DiscretePlant, Plant, Triple
from twostage_servo.portable_error import PortableError

REST_SHARE = 0.01
"""Share of the velocity limit at or below which the axis counts as at rest: 2.5 mm/s of the demo's 250."""


MOST_SMOOTHING_TICKS = 2000
"""Longest smoothing of a change by the acceleration limit, in ticks: a tick's work grows with it."""

DISABLING_TICKS = 3
"""Ticks until a command to disable acts, and until the samples show it: one to leave, one to act, one to be seen."""


class DesignError(PortableError, ValueError):
    """The settings describe an axis for which no law can be designed; ``key`` is the dotted config key at fault."""

    def __init__(self, key: tuple[str, ...], message: str) -> None:
        super().__init__(message)
        self.key = key


@dataclass(frozen=True, slots=True)
class AxisDesign:
    """Everything that follows from the settings, computed once when they are loaded.

    Attributes
    ----------
    settings
        Of the axis.
    period_s
        The tick, in s.
    plant
        The sampled model.
    noise, kalman
        What the observer assumes, and its gain.
    law
        What the law comes to.
    """

    settings: AxisSettings
    period_s: float
    plant: DiscretePlant
    noise: NoiseModel
    kalman: KalmanGain
    law: LawDesign

    @property
    def rest_velocity(self) -> float:
        """Speed in axis unit/s at or below which the axis counts as at rest."""
        return REST_SHARE * self.settings.limits.velocity

    def build_law(self) -> Law:
        """Return the law that drives the axis."""
        return self._law(self.kalman.predictor)

    def build_nominal_law(self) -> Law:
        """Return the same law on a free-running model of the plant: the response that the axis is designed to give."""
        return self._law(NO_CORRECTION)

    def build_model_monitor(self) -> ModelMonitor:
        """Return the test that compares the plant's answer with the model's."""
        plant = Plant(self.settings.plant.gain, self.settings.plant.pole)
        return ModelMonitor(plant, self.period_s, self.noise, 1e-3 * self.settings.limits.innovation_time_ms)

    def changeover_distance(self, velocity: float) -> float:
        """Return how far before the set-point the position stage begins, in axis unit, at a velocity in axis unit/s."""
        return self.law.changeover_distance(abs(velocity))

    def ticks(self, duration_ms: float) -> int:
        """Return the ticks that a time in ms takes, rounded up."""
        return math.ceil(duration_ms / (1e3 * self.period_s) - 1e-9)

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
        return self.settings.limits.innovation_gate + 2.0 * resolution

    @property
    def jerk(self) -> float:
        """Largest slope of the reference's acceleration, in axis unit/s³; infinity where nothing smooths it."""
        jerk = self.settings.law.jerk
        return math.inf if jerk is None else jerk

    def stopping_distance(self, velocity: float, deceleration: float, *, smooth: bool = False) -> float:
        """Return how far the axis travels in a stop, in axis unit, not negative.

        Parameters
        ----------
        velocity
            Speed from which it stops, in axis unit/s.
        deceleration
            Slope of the speed reference, in axis unit/s².
        smooth
            Whether it is smoothed, as far as anything is.
        """
        distance = self.law.stopping_distance(velocity, deceleration)
        return distance + smoothing_distance(velocity, deceleration, self.jerk) if smooth else distance

    def certain_stopping_distance(self, velocity: float, deceleration: float) -> float:
        """Return how far the axis travels at most in a stop if its plant is off its model, in axis unit."""
        return self.law.certain_stopping_distance(velocity, deceleration)

    def stopping_time_s(self, velocity: float, deceleration: float, *, smooth: bool = False) -> float:
        """Return how long a stop takes until the axis rests, in s; `smooth` as in :meth:`stopping_distance`.

        A smoothed one may begin while the axis still accelerates.
        """
        if not smooth:
            return self.law.stopping_time_s(velocity, deceleration)
        rising_s = deceleration / self.jerk
        fastest = abs(velocity) + 0.5 * deceleration * rising_s
        return (
            rising_s
            + self.law.stopping_time_s(fastest, deceleration)
            + smoothing_time_s(fastest, deceleration, self.jerk)
        )

    def _law(self, gain: Triple) -> Law:
        return self.law.build(DisturbanceObserver(self.plant, gain, self.noise.disturbance_memory))


def design_axis(settings: AxisSettings, period_s: float, encoder_step: float = 0.0) -> AxisDesign:
    """Compute gains and observer.

    Parameters
    ----------
    settings
        Of the axis.
    period_s
        The tick, in s.
    encoder_step
        Step in which the encoder's position is reported, in axis unit; 0 if it has none.

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
        kalman = kalman_gain(sampled, noise)
    except ValueError as error:
        raise DesignError(("axis", "observer"), str(error)) from error
    _check_cruise(settings, plant)
    limits = settings.limits
    task = ControlTask(
        plant=plant,
        sampled=sampled,
        period_s=period_s,
        noise=noise,
        kalman=kalman,
        velocity_limit=limits.velocity,
        acceleration_limit=limits.acceleration,
        effort_limit=limits.effort,
        effort_rate_limit=limits.effort_rate,
        rest_velocity=REST_SHARE * limits.velocity,
        jerk=math.inf if settings.law.jerk is None else settings.law.jerk,
        encoder_step=encoder_step,
    )
    law_type = LAWS.get(settings.law.type)
    _check_jerk(settings, period_s, smooths=law_type.smooths)
    try:
        designed = law_type.design(settings.law.keys, task)
    except law.DesignError as error:
        raise DesignError(("axis", "law", *_place(settings, error.key)), str(error)) from error
    return AxisDesign(settings, period_s, sampled, noise, kalman, designed)


def _place(settings: AxisSettings, key: tuple[str, ...]) -> tuple[str, ...]:
    """Return where a key of the law stands, below ``axis.law``."""
    if settings.law.type == PAPER and key == ("performance_index_ratio",):
        return settings.law.place_of_ratio
    return settings.law.type, *key


def _check_jerk(settings: AxisSettings, period_s: float, *, smooths: bool) -> None:
    jerk, acceleration, unit = settings.law.jerk, settings.limits.acceleration, settings.unit
    if jerk is None:
        return
    key = ("axis", "law", "jerk")
    if not smooths:
        raise DesignError(
            key,
            f"the law {settings.law.type!r} cannot smooth its reference (that of the paper brakes without one); "
            'remove the key, or choose axis.law.type = "adaptive"',
        )
    ticks = acceleration / (jerk * period_s)
    if ticks > MOST_SMOOTHING_TICKS:
        raise DesignError(
            key,
            f"with {jerk:g} {unit}/s³ it takes {acceleration / jerk:.4g} s, {ticks:.0f} ticks, until the acceleration "
            f"is that of limits.acceleration = {acceleration:g} {unit}/s², and {MOST_SMOOTHING_TICKS} ticks are "
            f"allowed; raise jerk to {acceleration / (MOST_SMOOTHING_TICKS * period_s):.3g}, or lower "
            "limits.acceleration",
        )


def _check_cruise(settings: AxisSettings, plant: Plant) -> None:
    limits = settings.limits
    needed = abs(plant.cruise_effort(limits.velocity))
    if needed >= limits.effort:
        raise DesignError(
            ("axis", "limits", "effort"),
            f"a cruise at limits.velocity = {limits.velocity:g} {settings.unit}/s takes {needed:g} "
            f"{settings.effort_unit}, and limits.effort is {limits.effort:g}; lower the velocity limit below "
            f"{abs(limits.effort * settings.plant.gain / settings.plant.pole):g} or raise the effort limit",
        )
