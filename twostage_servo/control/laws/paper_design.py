"""The design of the paper's law: optimal gains, the loops of its three stages, and its response to a move."""

import math
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, field

from twostage_servo.control.laws.law import ControlTask, DesignError, Loop, Stage
from twostage_servo.control.laws.margins import LEAST_MODULUS_MARGIN, loop_of, settling_time_s
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.laws.paper_margins import closed_loop_poles, loop_margins, stage_control, stage_controller
from twostage_servo.control.laws.stop_design import StopsByRamp
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver
from twostage_servo.control.optimal import ServoGains, servo_gains
from twostage_servo.control.plant import DiscretePlant

_RATIO = ("performance_index_ratio",)

_CRUISE_TIMES = 20.0
"""Change-over times of cruise after which the speed has settled for good."""
_LONGEST_TIMES = 1000.0
"""Change-over times after which a stable design has come to rest in any case."""
_SMALLEST_SHARE = 1e-6
"""Share of the change-over distance below which nobody asks when the position stage gets there."""


@dataclass(frozen=True, slots=True)
class PaperDesign(StopsByRamp):
    """What follows from Q/R for a task; see :class:`~twostage_servo.control.laws.law.LawDesign`.

    Attributes
    ----------
    task
        What it is designed for.
    ratio
        Q/R.
    servo_gains
        f11, f12, f22.
    settling_time_s
        How long the slowest pole of a stop takes to die down to a hundredth, in s.
    response
        How the model answers a move.
    """

    task: ControlTask
    ratio: float
    servo_gains: ServoGains
    settling_time_s: float
    response: "UnitResponse" = field(compare=False)  # which follows from the others

    @property
    def changeover_time_s(self) -> float:
        """The change-over distance of equation (19) for each axis unit/s, in s."""
        return self.servo_gains.changeover_time_s(self.task.period_s)

    def changeover_distance(self, velocity: float) -> float:
        """Return how far before the set-point the position stage begins, in axis unit; it goes with the velocity."""
        return velocity * self.changeover_time_s

    def build(self, observer: DisturbanceObserver) -> TwoStageLaw:
        """Return a law within the task's limits."""
        task = self.task
        return TwoStageLaw(
            observer,
            self.servo_gains,
            task.period_s,
            acceleration_limit=task.acceleration_limit,
            effort_limit=task.effort_limit,
            effort_rate_limit=task.effort_rate_limit,
            rest_velocity=task.rest_velocity,
        )

    def move_duration_s(self, distance: float, velocity: float, window: float) -> float:
        """Return how long a move takes, in s, from the response of the model."""
        response, changeover_s = self.response, self.changeover_time_s
        cruise = distance - velocity * changeover_s
        if cruise <= 0.0:
            return response.enters(response.alone, window / distance)
        ramp_s = velocity / (2.0 * self.task.acceleration_limit)
        return cruise / velocity + response.lag_s + ramp_s + response.enters(response.after_cruise, window / velocity)

    def gains(self) -> Mapping[str, float]:
        """Return f11, f12 and f22."""
        return {"f11": self.servo_gains.f11, "f12": self.servo_gains.f12, "f22": self.servo_gains.f22}

    def origin(self) -> str:
        """Return Q/R."""
        return f"Q/R {self.ratio:g}"

    def loops(self) -> Mapping[str, Loop]:
        """Return how stable each of the three stages is."""
        loops = {}
        for stage in Stage:
            loop = (self.task.sampled, self.servo_gains, self.task.kalman, self.task.noise, stage)
            loops[stage.name.lower()] = loop_of(stage_control(*loop), self.task.sampled, stage_controller(*loop))
        return loops


class UnitResponse:
    """The response of the law without limits, on the model, at rest in the end.

    The law is linear within its limits, so one run with unit speed tells all: in the speed stage the axis runs behind
    its reference by a constant time, and in the position stage the distance left is the speed times a function of time.

    Parameters
    ----------
    gains
        f11, f12, f22.
    plant
        The sampled model.
    period_s
        T_s in s.

    Attributes
    ----------
    lag_s
        How far the axis is behind its reference in a cruise, in s.
    after_cruise, alone
        How far the axis is from its set-point at most from each tick on, the last one first: from a change-over at
        unit speed on; and in a move of unit length without a cruise.

    Raises
    ------
    DesignError
        If the response never comes to rest.
    """

    def __init__(self, gains: ServoGains, plant: DiscretePlant, period_s: float) -> None:
        self._gains, self._plant, self._period_s = gains, plant, period_s
        self._changeover_s = gains.changeover_time_s(period_s)
        self._most_ticks = math.ceil(_LONGEST_TIMES * self._changeover_s / self._period_s)
        law = self._law()
        law.set_target(_CRUISE_TIMES * self._changeover_s, 1.0)
        ticks = 0
        while law.stage is Stage.SPEED and ticks < self._most_ticks:
            law.step(None)
            ticks += 1
        self.lag_s = ticks * self._period_s - law.observer.position
        self.after_cruise = self._settling(law)
        short = self._law()
        short.set_target(1.0, 2.0 / self._changeover_s)  # within the change-over distance: no speed stage
        self.alone = self._settling(short)

    def enters(self, rising: list[float], share: float) -> float:
        """Return after how many seconds a response stays within a share for good."""
        return self._period_s * (len(rising) - bisect_left(rising, share))

    def _law(self) -> TwoStageLaw:
        """Return the law without any limit, on the model: what is linear in it."""
        return TwoStageLaw(DisturbanceObserver(self._plant, NO_CORRECTION), self._gains, self._period_s)

    def _settling(self, law: TwoStageLaw) -> list[float]:
        """Return how far the axis is from its set-point at most from each tick on, the last one first."""
        largest = abs(law.target - law.observer.position)
        seen = [math.inf]
        while max(seen[-1], abs(law.observer.velocity) * self._changeover_s) > _SMALLEST_SHARE * largest:
            if len(seen) > self._most_ticks:
                raise DesignError(_RATIO, "the designed response never comes to rest")
            seen.append(abs(law.target - law.observer.position))
            law.step(None)
        worst = 0.0
        later = []
        for value in reversed(seen[1:]):
            worst = max(worst, value)
            later.append(worst)
        return later


def design_paper(ratio: float, task: ControlTask) -> PaperDesign:
    """Compute the gains for Q/R, and see that each stage is stable with them.

    Raises
    ------
    DesignError
        If there are no optimal gains, or none that drive this plant, or a loop would be unstable or fragile.
    """
    try:
        gains = servo_gains(task.sampled, ratio)
    except ValueError as error:
        raise DesignError(_RATIO, str(error)) from error
    if not all(math.isfinite(gain) and gain * task.plant.gain > 0.0 for gain in (gains.f11, gains.f22)):
        raise DesignError(
            _RATIO,
            f"the optimal design gives f11 = {gains.f11:g}, f22 = {gains.f22:g}, which cannot drive this plant; "
            "choose a larger Q/R",
        )
    radii = {stage: _check_stage(gains, task, stage) for stage in Stage}
    response = UnitResponse(gains, task.sampled, task.period_s)
    return PaperDesign(task, ratio, gains, settling_time_s(radii[Stage.BRAKE], task.period_s), response)


def _check_stage(gains: ServoGains, task: ControlTask, stage: Stage) -> float:
    """Return the magnitude of a stage's slowest pole."""
    name = stage.name.lower()
    radius = max(abs(pole) for pole in closed_loop_poles(task.sampled, gains, task.kalman, task.noise, stage))
    if radius >= 1.0:
        raise DesignError(
            _RATIO,
            f"the {name} stage would be unstable: its closed loop has a pole of magnitude "
            f"{radius:.4f}; choose a smaller Q/R (see `design`)",
        )
    margin = loop_margins(task.sampled, gains, task.kalman, task.noise, stage, frequencies=2_000).modulus_margin
    if margin < LEAST_MODULUS_MARGIN:
        raise DesignError(
            _RATIO,
            f"the {name} stage would be fragile: its modulus margin is {margin:.3f}, and at least "
            f"{LEAST_MODULUS_MARGIN:g} is needed; choose a smaller Q/R, or other observer variances (see `design`)",
        )
    return radius
