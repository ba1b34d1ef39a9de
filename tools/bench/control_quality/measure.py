"""From laws to figures: the jobs of a run, and what their outcomes come to."""

import csv
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tools.bench.control_quality import contestants
from tools.bench.control_quality.jobs import run_jobs
from tools.bench.control_quality.margins import loop_figures
from tools.bench.control_quality.scenarios import SCENARIOS, SUITE, scenario_cases
from tools.bench.control_quality.suite import (
    BAND,
    DISTANCES,
    LONGEST_EXCESS_S,
    NOISES,
    PERIOD_S,
    SPREAD,
    VELOCITIES,
    Outcome,
    nominal,
    run,
)

FIRST_SEED: Final = 1_000_000
"""Of the suite; the optimiser has other ones."""
MOVES: Final = 3
_AT_ONCE: Final = 25
"""Cases a job: some seconds at most."""
_NOMINAL_WATCHED_S: Final = 10.0
ORDINALS: Final = {"first": 0, "third": 2}
"""Names of the moves that are reported, and their places."""


@dataclass(frozen=True, slots=True)
class Job:
    """Some cases for one law.

    Attributes
    ----------
    law
        Its name.
    noise
        Of the encoder, in mm.
    first_seed, count
        Which cases.
    moves
        On each.
    scenario
        The suite's cases, or one of :data:`~tools.bench.control_quality.scenarios.SCENARIOS`.
    """

    law: str
    noise: float
    first_seed: int
    count: int
    moves: int = MOVES
    scenario: str = SUITE


def outcomes_of(job: Job) -> list[list[Outcome]]:
    """Run a job; return the outcomes of its cases, each with one of every move."""
    return [
        run(contestants.law_for(job.law, case), case, job.moves)
        for case in scenario_cases(job.scenario, job.count, job.noise, job.first_seed)
    ]


def jobs_for(laws: Sequence[str], plants: int, first_seed: int) -> list[Job]:
    """Return the jobs of a run of so many plants a noise level."""
    return [
        Job(law, noise, first_seed + begin, min(_AT_ONCE, plants - begin))
        for law in laws
        for noise in NOISES
        for begin in range(0, plants, _AT_ONCE)
    ]


@dataclass(frozen=True, slots=True)
class Measured:
    """All outcomes of a run.

    Attributes
    ----------
    plants, first_seed
        Of each noise level.
    outcomes
        By law and noise, of each case.
    """

    plants: int
    first_seed: int
    outcomes: dict[tuple[str, float], list[list[Outcome]]]


def measure(
    laws: Sequence[str], plants: int, first_seed: int = FIRST_SEED, *, workers: int | None = None, show: bool = True
) -> Measured:
    """Run the suite with laws."""
    jobs = jobs_for(laws, plants, first_seed)
    outcomes: dict[tuple[str, float], list[list[Outcome]]] = {}
    for job, found in zip(jobs, run_jobs(outcomes_of, jobs, workers=workers, show=show), strict=True):
        outcomes.setdefault((job.law, job.noise), []).extend(found)
    return Measured(plants, first_seed, outcomes)


def write_outcomes(measured: Measured, path: Path) -> None:
    """Write every move of a run as a row of a CSV file."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("law", "noise_mm", "seed", "move", "excess_s", "settling_s", "overshoot_mm", "peak_velocity"))
        for (law, noise), found in measured.outcomes.items():
            for index, moves in enumerate(found):
                for move, one in enumerate(moves, start=1):
                    figures = one.excess_s, one.settling_s, one.overshoot, one.peak_velocity
                    writer.writerow((law, noise, measured.first_seed + index, move, *(f"{x:.6g}" for x in figures)))


def measure_scenarios(
    laws: Sequence[str], plants: int, first_seed: int = FIRST_SEED, *, workers: int | None = None, show: bool = True
) -> dict[tuple[str, str], list[Outcome]]:
    """Run first moves beyond the suite with a quiet encoder; return the outcomes by law and scenario."""
    jobs = [
        Job(law, NOISES[0], first_seed + begin, min(_AT_ONCE, plants - begin), 1, scenario)
        for law in laws
        for scenario in SCENARIOS
        for begin in range(0, plants, _AT_ONCE)
    ]
    outcomes: dict[tuple[str, str], list[Outcome]] = {}
    for job, found in zip(jobs, run_jobs(outcomes_of, jobs, workers=workers, show=show), strict=True):
        outcomes.setdefault((job.law, job.scenario), []).extend(moves[0] for moves in found)
    return outcomes


def result_of(measured: Measured) -> dict[str, Any]:
    """Return the figures of a run as they are printed with ``--json``."""
    laws = dict.fromkeys(law for law, _ in measured.outcomes)
    return {
        "laws": {
            law: {
                **nominal_figures(law),
                "noise": {
                    contestants.level(noise): figures_of_moves(measured.outcomes[law, noise]) for noise in NOISES
                },
            }
            for law in laws
        },
        "suite": {
            "plants": measured.plants, "moves": MOVES, "tick_s": PERIOD_S, "band_mm": BAND, "spread": SPREAD,
            "distance_mm": list(DISTANCES), "velocity_mm_s": list(VELOCITIES),
            "longest_excess_ms": 1e3 * LONGEST_EXCESS_S,
        },
        "seed": measured.first_seed,
        "budget": contestants.tuning_budget(),
    }  # fmt: skip


@functools.cache
def nominal_outcome(law: str, effort_limit: float) -> Outcome:
    """Return what the nominal move comes to."""
    case = nominal(effort_limit)
    return run(contestants.law_for(law, case), case, 1, watched_s=_NOMINAL_WATCHED_S)[0]


@functools.cache
def nominal_figures(law: str) -> Mapping[str, float | None]:
    """Return settling and overshoot of the nominal move, and the figures of the loop; None for what is not finite."""
    outcome, case = nominal_outcome(law, 10.0), nominal()
    figures: dict[str, float | None] = {
        "nominal_s": finite(outcome.settling_s, 4),
        "nominal_overshoot": finite(outcome.overshoot, 4),
    }
    try:
        controller = contestants.controller_of(law, case)
    except LookupError:
        return figures | dict.fromkeys(("peak_sensitivity", "delay_margin_ticks", "load_step_peak"))
    loop = loop_figures(contestants.task_for(case).sampled, controller)
    return figures | {
        "peak_sensitivity": finite(loop.peak_sensitivity, 3),
        "delay_margin_ticks": finite(loop.delay_margin_ticks, 3),
        "load_step_peak": finite(loop.load_step_peak, 4),
    }


def figures_of_moves(outcomes: Sequence[Sequence[Outcome]]) -> dict[str, dict[str, dict[str, float]]]:
    """Return the figures of first and third moves."""
    return {name: figures_of([moves[place] for moves in outcomes]) for name, place in ORDINALS.items()}


def figures_of(outcomes: Sequence[Outcome]) -> dict[str, dict[str, float]]:
    """Return the percentiles of excess, in ms, and of overshoot, in mm."""
    excess = [1e3 * outcome.excess_s for outcome in outcomes]
    overshoot = [outcome.overshoot for outcome in outcomes]
    return {
        "excess_ms": {
            "median": round(quantile(excess, 0.5), 1), "p95": round(quantile(excess, 0.95), 1),
            "p99": round(quantile(excess, 0.99), 1), "max": round(max(excess), 1),
        },
        "overshoot": {"p95": round(quantile(overshoot, 0.95), 4), "max": round(max(overshoot), 4)},
    }  # fmt: skip


def quantile(values: Sequence[float], share: float) -> float:
    """Return the smallest value that at least this share of them does not exceed."""
    return sorted(values)[max(0, math.ceil(share * len(values) - 1e-9) - 1)]


def finite(value: float, digits: int) -> float | None:
    """Return a rounded number, and None for what has no place in JSON."""
    return round(value, digits) if math.isfinite(value) else None
