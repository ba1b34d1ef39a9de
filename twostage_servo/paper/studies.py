"""The runs behind the report: all methods, a constant disturbance, many set-points, every slip as printed."""

import cmath
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from twostage_servo.control.baselines.transcription import Reading, UnsolvableError
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper_margins import closed_loop_poles
from twostage_servo.paper.errata import ERRATA, Erratum
from twostage_servo.paper.examples import EXAMPLE_2, EXAMPLES, MODEL, NOISE, PERIOD_S, VELOCITY, Example
from twostage_servo.paper.experiment import Run, simulate
from twostage_servo.paper.methods import METHODS, Builder, model_difference_without_sensor, transcribed
from twostage_servo.paper.scores import Scores, score

LOAD: Final = 1.0
"""Constant disturbance of that study, in V."""
SET_POINTS: Final = (50.0, 100.0, 200.0, 400.0, 600.0, 800.0, 1000.0, 1250.0, 1500.0, 1750.0, 2000.0)
PHASES: Final = 20
"""Parts of a tick that the change-over is put at."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """All methods on one example: run and figures by the method's name."""

    example: Example
    runs: dict[str, Run]
    scores: dict[str, Scores]


@dataclass(frozen=True, slots=True)
class Curve:
    """Overshoot in mm by set-point in mm, for one method."""

    name: str
    set_points: tuple[float, ...]
    overshoots: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class SlipEffect:
    """What one slip does on one example: the figures as printed and those corrected, or why there are none."""

    erratum: Erratum
    example: Example
    corrected: Scores
    printed: Scores | None
    unsolvable: str | None


def compare(example: Example, *, load: float = 0.0) -> Comparison:
    """Run every method on an example, under a constant load in V."""
    runs = {name: simulate(method.build, example, load=load) for name, method in METHODS.items()}
    return Comparison(example, runs, {name: score(run) for name, run in runs.items()})


def overshoot_by_set_point(example: Example, method: str) -> Curve:
    """Run one method without noise over :data:`SET_POINTS`."""
    return _curve(example, METHODS[method].build, method, SET_POINTS)


def overshoot_by_phase(example: Example) -> tuple[Curve, Curve]:
    """Shift the set-point through the way of one tick, with the hand-over corrected and printed (erratum 12)."""
    distance = VELOCITY * example.model.period_s
    set_points = tuple(400.0 + distance * part / PHASES for part in range(PHASES + 1))
    readings = {"corrected": Reading(), "printed": Reading(offset="set-point")}
    exact, printed = (_curve(example, transcribed(reading), name, set_points) for name, reading in readings.items())
    return exact, printed


def steady_error(example: Example, load: float) -> float:
    """Return the error that the conventional law keeps under a constant load (V), position minus set-point in mm.

    The effort that balances the load drives the model, which has none, at ``v_m = load gain / pole``. Its position
    grows by ``v_m T_s`` a tick for ever, and the effort stays constant only if ``f22 e = f11 v_m T_s``.
    """
    return -load * MODEL.gain / MODEL.pole * example.gains.changeover_time_s(PERIOD_S)


def slip_effects() -> Iterator[SlipEffect]:
    """Run every slip that changes a number, as printed, on both examples."""
    corrected = {
        (example.name, name): score(simulate(METHODS[name].build, example))
        for example in EXAMPLES
        for name in {erratum.baseline for erratum in ERRATA}
    }
    for erratum in ERRATA:
        if erratum.as_printed is None:
            continue
        for example in EXAMPLES:
            baseline = corrected[example.name, erratum.baseline]
            noise = erratum.noise_variance if example.noise_variance else None
            try:
                printed = score(simulate(erratum.as_printed, example, noise_variance=noise))
            except UnsolvableError as reason:
                yield SlipEffect(erratum, example, baseline, None, str(reason))
            else:
                yield SlipEffect(erratum, example, baseline, printed, None)


@dataclass(frozen=True, slots=True)
class Studies:
    """Everything that was run; each tuple has one entry per example, and the two numbers are Example 2's.

    They say why its speed stage swings: overshoot in mm/s of the proposed law on the plant as modelled, and frequency
    in Hz of the least damped poles on the true plant.
    """

    comparisons: tuple[Comparison, ...]
    difference_without_sensor: tuple[Scores, ...]
    nominal_speed_overshoot: float
    speed_stage_swing_hz: float
    under_load: tuple[Comparison, ...]
    by_set_point: tuple[tuple[Curve, ...], ...]
    by_phase: tuple[tuple[Curve, Curve], ...]
    slips: tuple[SlipEffect, ...]


def run_all(progress: Callable[[str], None]) -> Studies:
    """Run everything; `progress` is told what comes next."""
    progress("both examples, every method")
    comparisons = tuple(compare(example) for example in EXAMPLES)
    without_sensor = tuple(score(simulate(model_difference_without_sensor, example)) for example in EXAMPLES)
    progress("the same under a constant load")
    under_load = tuple(compare(example, load=LOAD) for example in EXAMPLES)
    progress("overshoot against set-point")
    by_set_point = tuple(tuple(overshoot_by_set_point(example, name) for name in METHODS) for example in EXAMPLES)
    progress("overshoot against where within a tick the change-over falls")
    by_phase = tuple(overshoot_by_phase(example) for example in EXAMPLES)
    progress("every slip as printed")
    return Studies(
        comparisons,
        without_sensor,
        _nominal_speed_overshoot(),
        _speed_stage_swing_hz(),
        under_load,
        by_set_point,
        by_phase,
        tuple(slip_effects()),
    )


def _nominal_speed_overshoot() -> float:
    nominal = replace(EXAMPLE_2, true_plant=MODEL)
    return score(simulate(METHODS["proposed"].build, nominal)).speed_overshoot


def _speed_stage_swing_hz() -> float:
    true_plant = EXAMPLE_2.true_plant.discretise(PERIOD_S)
    poles = closed_loop_poles(EXAMPLE_2.model, EXAMPLE_2.gains, EXAMPLE_2.kalman, NOISE, Stage.SPEED, true_plant)
    return abs(cmath.phase(max(poles, key=abs))) / (2.0 * math.pi * PERIOD_S)


def _curve(example: Example, build: Builder, name: str, set_points: Sequence[float]) -> Curve:
    overshoots = (
        score(simulate(build, example, set_point=r, noise_variance=0.0, duration_s=r / VELOCITY + 6.0)).overshoot
        for r in set_points
    )
    return Curve(name, tuple(set_points), tuple(overshoots))
