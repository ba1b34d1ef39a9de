"""The design of the adaptive law: gains from poles, the loops of its stages, and how far and how long it goes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite

from twostage_servo.control.laws.adaptive.estimate import ControlEstimate
from twostage_servo.control.laws.adaptive.law import AdaptiveLaw
from twostage_servo.control.laws.adaptive.model import Model
from twostage_servo.control.laws.adaptive.placement import FixedGains, Gains
from twostage_servo.control.laws.adaptive.reference import Shape
from twostage_servo.control.laws.adaptive.rules import (
    NOISY_FROM,
    LearningRules,
    Rules,
    encoder_gains,
    is_noisy,
    loop_period_s,
    noise_unit,
)
from twostage_servo.control.laws.adaptive.smoothing import Smoothing
from twostage_servo.control.laws.law import ControlTask, DesignError, Loop, Stage
from twostage_servo.control.laws.margins import (
    LEAST_MODULUS_MARGIN,
    Control,
    loop_of,
    margins_of,
    poles_of,
    settling_time_s,
)
from twostage_servo.control.laws.stop import braking_gain
from twostage_servo.control.laws.stop_design import StopsByRamp
from twostage_servo.control.observer import DisturbanceObserver, extended_model
from twostage_servo.control.optimal import servo_gains

_SETTLING_TICKS = 3.0
"""Ticks from the end of the braking reference until the axis is in a window: a delay of one, and the poles."""


@dataclass(frozen=True, slots=True)
class AdaptiveDesign(StopsByRamp):
    """What follows for a task; see :class:`~twostage_servo.control.laws.law.LawDesign`.

    Attributes
    ----------
    task
        What it is designed for.
    noise
        Standard deviation of a measured position, as far as it is known, in axis unit.
    learns
        Whether plants are identified.
    settling_time_s
        How long the slowest pole of a stop takes to die down to a hundredth, in s.
    rules, learning_rules
        How its laws shape a move, and when they believe what they identify.
    """

    task: ControlTask
    noise: float
    learns: bool
    settling_time_s: float = field(compare=False)  # which follows from the others
    rules: Rules = field(default_factory=Rules)
    learning_rules: LearningRules = field(default_factory=LearningRules)

    def build(self, observer: DisturbanceObserver) -> AdaptiveLaw:
        """Return a law within the task's limits."""
        estimate = ControlEstimate(self.task, self.rules, self.learning_rules, self.noise, learns=self.learns)
        return AdaptiveLaw(observer, estimate, self.task, self.rules)

    @property
    def deceleration(self) -> float:
        """The deceleration that braking is planned with where there is no load, in axis unit/s²."""
        task = self.task
        return min(self.rules.braking_share * abs(task.plant.gain) * task.effort_limit, task.acceleration_limit)

    @property
    def changeover_time_s(self) -> float:
        """Distance of the change-over from the set-point for each axis unit/s, at the velocity limit, in s.

        It is the largest: at lower speeds braking takes less way for each.
        """
        velocity = self.task.velocity_limit
        return self._braking_way(velocity) / velocity

    def changeover_distance(self, velocity: float) -> float:
        """Return how far before the set-point the tick begins that ends a cruise (axis unit/s), in axis unit.

        On a plant that is known; a first move brakes more gently.
        """
        return self._braking_way(velocity) + velocity * self.task.period_s if velocity > 0.0 else 0.0

    def _braking_way(self, velocity: float) -> float:
        """Return what the reference goes from there on, at a velocity greater than 0, without that tick."""
        task, deceleration = self.task, self.deceleration
        if isfinite(task.jerk):
            return 0.5 * velocity * Smoothing(task).change_s(velocity, deceleration, braking=True)
        ways = self._model(self._gains).ways
        gain, step = abs(task.plant.gain), task.effort_rate_limit * task.period_s
        shape = Shape.at(velocity, velocity, velocity, deceleration, gain, step, ways)
        return velocity * velocity / (2.0 * deceleration) + 0.5 * velocity * task.period_s + shape.way

    def move_duration_s(self, distance: float, velocity: float, window: float) -> float:
        """Return how long a move takes, in s: ramp, cruise and braking of the reference, and its settling."""
        task, braking = self.task, self.deceleration
        rising = min(task.acceleration_limit, abs(task.plant.gain) * task.effort_limit)
        least = max(distance - window, 0.0)
        if isfinite(task.jerk):
            moving_s = Smoothing(task).move_s(least, velocity, rising, braking)
            return moving_s + task.period_s + _SETTLING_TICKS * loop_period_s(task)
        top = min(velocity, math.sqrt(2.0 * least * rising * braking / (rising + braking)))
        cruise = 0.0 if top <= 0.0 else least / top - 0.5 * top / rising - 0.5 * top / braking
        averaged = self._braking_way(top) - top * top / (2.0 * braking)
        rest_s = 0.0 if top <= 0.0 else averaged / top
        return top / rising + cruise + top / braking + rest_s + _SETTLING_TICKS * loop_period_s(task)

    def gains(self) -> Mapping[str, float]:
        """Return those of the position stage on a plant that is known, and of its observer."""
        model = self._model(self._gains)
        f1, f2 = model.feedback
        l1, l2, l3 = model.observer_gain
        return {"f1": f1, "f2": f2, "l1": l1, "l2": l2, "l3": l3}

    def origin(self) -> str:
        """Return what the gains follow from."""
        if self.rules.fixed_gains is not None:
            return "the paper's design"
        return "poles for a noisy encoder" if is_noisy(self.task, self.noise) else "poles for a quiet encoder"

    def loops(self) -> Mapping[str, Loop]:
        """Return how stable the stages are: on a known plant, before one is known, and in a stop."""
        gains = self._gains
        loops = {}
        for name, model in (("", self._model(gains)), ("unknown_", self._model(gains.slower(self.rules.unknown)))):
            for stage in (Stage.SPEED, Stage.POSITION):
                control = stage_control(self.task, model, stage)
                # They follow a reference, and no step: that has no place in a linear system of this form.
                loops[name + stage.name.lower()] = loop_of(control, self.task.sampled, control.in_numbers())
        brake = stage_control(self.task, self._model(gains), Stage.BRAKE)
        loops["brake"] = loop_of(brake, self.task.sampled, brake.in_numbers())
        return loops

    @property
    def _gains(self) -> Gains:
        return encoder_gains(self.task, self.noise, self.rules)

    def _model(self, gains: Gains) -> Model:
        return configured_model(self.task, gains)


def configured_model(task: ControlTask, gains: Gains) -> Model:
    """Return the plant as it is configured, without a delay, with its gains."""
    return Model(task.plant, is_late=False, gains=gains, period_s=task.period_s)


def stage_control(task: ControlTask, model: Model, stage: Stage) -> Control:
    """Return a stage's controller: ``u = -f1 x1 - f2 x2 - x3`` of an observer's estimate.

    A stop has the axis' own observer, and a feedback of its own.
    """
    import numpy as np  # noqa: PLC0415 - see servo_gains

    f1, f2 = model.feedback
    gain, memory = model.observer_gain, model.gains.memory
    if stage is Stage.BRAKE:
        f1, f2 = 0.0, braking_gain(task.sampled)
        gain, memory = task.kalman.predictor, task.noise.disturbance_memory
    elif stage is Stage.SPEED:
        f1 = 0.0
    state, effort, output = extended_model(task.sampled, memory)
    predictor = np.array(gain).reshape(3, 1)
    feedback = np.array([[f1, f2, 1.0]])
    closed = state - predictor @ output - effort @ feedback
    return Control(closed, predictor, -feedback, feeds_position=stage is Stage.POSITION)


def paper_gains(task: ControlTask, ratio: float) -> FixedGains:
    """Return the gains of the paper's design: f11 and f12 of (13) for Q/R, and the axis' own Kalman gain.

    Raises
    ------
    DesignError
        If there are no optimal gains.
    """
    try:
        gains = servo_gains(task.sampled, ratio)
    except ValueError as error:
        raise DesignError(("performance_index_ratio",), str(error)) from error
    return FixedGains(task.kalman.predictor, (gains.f11, gains.f12), task.noise.disturbance_memory)


def design_adaptive(
    task: ControlTask,
    noise: float,
    *,
    learns: bool,
    rules: Rules = Rules(),  # noqa: B008 - frozen
    learning_rules: LearningRules = LearningRules(),  # noqa: B008 - frozen
) -> AdaptiveDesign:
    """See that each stage is stable on the configured plant.

    Parameters
    ----------
    task
        What the law is designed for.
    noise
        Standard deviation of a measured position, as far as it is known, in axis unit.
    learns
        Whether plants are identified.
    rules, learning_rules
        How its laws shape a move, and when they believe what they identify.

    Raises
    ------
    DesignError
        If a loop would be unstable or fragile.
    """
    gains = encoder_gains(task, noise, rules)
    radii = {stage: _check_stage(task, gains, noise, stage) for stage in Stage}
    stopping_s = settling_time_s(radii[Stage.BRAKE], task.period_s)
    return AdaptiveDesign(task, noise, learns, stopping_s, rules, learning_rules)


def _check_stage(task: ControlTask, gains: Gains, noise: float, stage: Stage) -> float:
    """Return the magnitude of a stage's slowest pole."""
    control = stage_control(task, configured_model(task, gains), stage)
    radius = max(abs(pole) for pole in poles_of(control, task.sampled))
    if not radius < 1.0:
        raise _design_error(
            task, gains, noise, stage, f"unstable: its closed loop has a pole of magnitude {radius:.4f}"
        )
    margin = margins_of(control, task.sampled, 2_000).modulus_margin
    if margin < LEAST_MODULUS_MARGIN:
        fragile = f"fragile: its modulus margin is {margin:.3f}, and at least {LEAST_MODULUS_MARGIN:g} is needed"
        raise _design_error(task, gains, noise, stage, fragile)
    return radius


def _design_error(task: ControlTask, gains: Gains, noise: float, stage: Stage, finding: str) -> DesignError:
    """Return the error that says what is wrong with a stage, and what to change."""
    key: tuple[str, ...] = ()
    change = "choose a shorter tick"
    if stage is Stage.BRAKE:
        change += ", or other observer variances (axis.observer)"
    elif isinstance(gains, FixedGains):
        change = "choose another performance_index_ratio, or placed_poles = true"
    else:  # these poles are fixed in z, so only the plant and the tick make a difference
        change += ", or correct axis.plant.pole if the plant is slower"
        if is_noisy(task, noise):
            key = ("encoder_noise",)
            quiet = NOISY_FROM * noise_unit(task)
            change += f"; up to {quiet:.3g}, if the encoder is that quiet, encoder_noise selects other poles"
    return DesignError(
        key,
        f"the {stage.name.lower()} stage would be {finding}, with axis.plant.pole = {task.plant.pole:g} and "
        f"service.tick_ms = {1e3 * task.period_s:g}; {change}",
    )
