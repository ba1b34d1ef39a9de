"""Axes of other kinds, to which a law's design has to carry over by its rules alone.

The suite's axis in other units and on other ticks: what it is in ticks and in what the full effort does in a tick is
drawn from the same ranges. Baselines are not run: their values were found for one axis.
"""

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, log
from typing import Final

from tools.bench.control_quality import contestants
from tools.bench.control_quality.jobs import run_jobs
from tools.bench.control_quality.measure import quantile
from tools.bench.control_quality.suite import Case, Model, cases, run
from twostage_servo.axis.design import DesignError

AXES: Final = 30
PLANTS: Final = 20
"""On each axis."""
FIRST_SEED: Final = 2_000_000
_EFFORT: Final = 10.0
_GAINS: Final = (0.5, 5000.0)
_POLES: Final = (0.5, 60.0)
_PERIODS_S: Final = (0.001, 0.02)
_ACCELERATION_TICKS: Final = (1.1, 11.0)
"""How long the full effort takes to the cruise velocity."""
_CRUISE_TICKS: Final = (25.0, 1000.0)
_QUANTUM, _BAND = 1.0 / 18.0, 10.0 / 18.0
"""In what the full effort does in a tick, b U T²: as in the suite with 10 V."""


@dataclass(frozen=True, slots=True)
class AxisJob:
    """One law on one axis; `index` says which."""

    law: str
    index: int


def axis_cases(index: int, count: int = PLANTS) -> list[Case]:
    """Return cases of one axis: its model, and plants that are off it as in the suite."""
    rng = random.Random(FIRST_SEED + index)  # noqa: S311 - no secret
    model = Model(*(_between(rng, ends) for ends in (_GAINS, _POLES, _PERIODS_S)))
    return [_case(model, case) for case in cases(count, 0.0, FIRST_SEED + 1000 * (index + 1))]


def _case(model: Model, case: Case) -> Case:
    """Return a case of the suite on another axis."""
    rng = random.Random(case.seed)  # noqa: S311 - no secret
    suite, period_s = case.model, model.period_s
    unit = model.gain * _EFFORT * period_s**2
    axis = replace(
        case.axis,
        gain=case.axis.gain / suite.gain * model.gain,
        pole=case.axis.pole / suite.pole * model.pole,
        effort_limit=_EFFORT,
        effort_rate=_EFFORT / period_s,
        quantum=_QUANTUM * unit,
    )
    fastest = 0.45 * model.gain * _EFFORT / model.pole  # within reach of every plant with its load
    velocity = min(_between(rng, _ACCELERATION_TICKS) * unit / period_s, fastest)
    way = velocity * period_s * _between(rng, _CRUISE_TICKS)
    return Case(axis, way if case.distance > 0.0 else -way, velocity, case.seed, None, model, _BAND * unit)


def _between(rng: random.Random, ends: tuple[float, float]) -> float:
    return exp(rng.uniform(log(ends[0]), log(ends[1])))


def worst_of(job: AxisJob) -> tuple[float, float] | None:
    """Return the largest excess of first moves on an axis, in ticks, and the largest overshoot in bands.

    None if the law refuses the axis.
    """
    found = axis_cases(job.index)
    try:
        outcomes = [run(contestants.law_for(job.law, case), case, 1)[0] for case in found]
    except DesignError:
        return None
    return (
        max(outcome.excess_s for outcome in outcomes) / found[0].model.period_s,
        max(outcome.overshoot / case.band for outcome, case in zip(outcomes, found, strict=True)),
    )


@dataclass(frozen=True, slots=True)
class AxesFigures:
    """What a law came to on other axes.

    Attributes
    ----------
    refused
        Axes for which it has no design.
    excess_ticks, overshoot_bands
        Of each other axis, the largest; see :func:`worst_of`.
    """

    refused: int
    excess_ticks: tuple[float, ...]
    overshoot_bands: tuple[float, ...]


def measure_axes(
    laws: Sequence[str], axes: int = AXES, *, workers: int | None = None, show: bool = True
) -> dict[str, AxesFigures]:
    """Run laws on other axes; return what each came to."""
    jobs = [AxisJob(law, index) for law in laws for index in range(axes)]
    worst: dict[str, list[tuple[float, float] | None]] = {law: [] for law in laws}
    for job, found in zip(jobs, run_jobs(worst_of, jobs, workers=workers, show=show), strict=True):
        worst[job.law].append(found)
    return {law: _figures(found) for law, found in worst.items()}


def _figures(worst: Sequence[tuple[float, float] | None]) -> AxesFigures:
    run_ones = [found for found in worst if found is not None]
    return AxesFigures(
        len(worst) - len(run_ones), tuple(found[0] for found in run_ones), tuple(found[1] for found in run_ones)
    )


def rows_of(figures: Mapping[str, AxesFigures]) -> list[tuple[str, ...]]:
    """Return a row for each law."""
    return [
        (law, str(found.refused), *_pair(found.excess_ticks, 1), *_pair(found.overshoot_bands, 3))
        for law, found in figures.items()
    ]


def _pair(values: Sequence[float], digits: int) -> tuple[str, str]:
    """Return median and maximum."""
    if not values:
        return "-", "-"
    return f"{quantile(values, 0.5):.{digits}f}", f"{max(values):.{digits}f}"


HEADINGS: Final = (
    "law", "axes refused", "worst excess, ticks: median", "max", "worst overshoot, bands: median", "max",
)  # fmt: skip
