"""Find the values that the baselines run with: one optimiser, one budget, one target and one training set for all.

``python -m tools.bench.control_quality.tuning`` writes ``tuned.json`` anew; ``--law NAME`` changes that law's values
alone. The same seed and budget give the same values.
"""

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.optimize import differential_evolution, minimize

from tools.bench.control_quality import contestants
from tools.bench.control_quality.contestants import level, task_for
from tools.bench.control_quality.jobs import run_jobs
from tools.bench.control_quality.margins import quick_margins
from tools.bench.control_quality.measure import quantile
from tools.bench.control_quality.suite import NOISES, Case, Outcome, cases, nominal, run
from twostage_servo.control.baselines.tunable import TunableLawType, Values

BUDGET: Final = 1300
"""Evaluations of the target for each law and noise level."""
SEED: Final = 1
TRAINING_SEED: Final = 500_000
"""Of the first training case: the suite has none of them."""
_TRAINING_CASES: Final = 48
_TRAINING_MOVES: Final = 2
_LONGEST_CRUISE_S: Final = 3.0
"""Longer training moves are cut to that; it is long enough to tell what a velocity out of reach does."""
_TRAINING_REST_S: Final = 0.3
_POPULATION: Final = 26
_GLOBAL_SHARE: Final = 2.0 / 3.0
"""Of the budget for differential evolution; a simplex search has the rest."""
MOST_PEAK_SENSITIVITY: Final = 2.05
LEAST_DELAY_MARGIN_TICKS: Final = 2.0
"""What the project's own law is held to."""
MOST_PEAK_VELOCITY: Final = 1.6
"""As a multiple of the cruise velocity; a plant that is off its model exceeds it before a law can know."""
_FAILED: Final = 100.0
_NEIGHBOURHOOD: Final = 0.1
"""Of the start, as a share of a parameter's whole range."""
Vector = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TuningJob:
    """One law at one noise level.

    Attributes
    ----------
    law
        Its name.
    noise
        In mm.
    budget, seed
        Of the optimiser.
    """

    law: str
    noise: float
    budget: int
    seed: int


def training_cases(noise: float, count: int = _TRAINING_CASES) -> list[Case]:
    """Return the suite's kind of cases with other seeds and shorter cruises."""
    return [_shortened(case) for case in cases(count, noise, TRAINING_SEED)]


def _shortened(case: Case) -> Case:
    longest = max(5.0, case.velocity * _LONGEST_CRUISE_S)
    return replace(case, distance=math.copysign(min(abs(case.distance), longest), case.distance))


def target_of(law_type: TunableLawType, values: Values, training: Sequence[Case]) -> float:
    """Return what the optimiser makes small, in s.

    Median, 95th percentile, half the largest excess, and 1 s for each mm of the overshoot's 95th percentile. Beside
    these 10 s for each unit by which a margin of the nominal loop is missed, or by which the 95th percentile of the
    peak speed is above :data:`MOST_PEAK_VELOCITY`: a law must not be quick by not keeping to its cruise velocity.
    """
    margins = _margins_missed(law_type, values)
    if math.isinf(margins):
        return _FAILED
    outcomes: list[Outcome] = []
    try:
        for case in training:
            law = law_type.build(task_for(case), values)
            outcomes += run(law, case, _TRAINING_MOVES, rest_s=_TRAINING_REST_S)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError):  # values for which there is no such law
        return _FAILED
    excess = [outcome.excess_s for outcome in outcomes]
    overshoot = quantile([outcome.overshoot for outcome in outcomes], 0.95)
    too_fast = quantile([outcome.peak_velocity for outcome in outcomes], 0.95) - MOST_PEAK_VELOCITY
    missed = margins + max(0.0, too_fast)
    return quantile(excess, 0.5) + quantile(excess, 0.95) + 0.5 * max(excess) + overshoot + 10.0 * missed


def _margins_missed(law_type: TunableLawType, values: Values) -> float:
    """Return by how much the margins are missed in all; infinity for an unstable loop."""
    task = task_for(nominal())
    try:
        peak, delay = quick_margins(task.sampled, law_type.build(task, values).controller())
    except (ArithmeticError, ValueError, np.linalg.LinAlgError):
        return math.inf
    return max(0.0, peak - MOST_PEAK_SENSITIVITY) + max(0.0, LEAST_DELAY_MARGIN_TICKS - delay)


def tune(job: TuningJob) -> dict[str, Any]:
    """Return ``cost`` and ``values`` of the best that was found, with ``start_cost`` for comparison."""
    law_type = contestants.baseline(job.law)
    names = list(law_type.parameters)
    bounds = [(math.log(law_type.parameters[name].low), math.log(law_type.parameters[name].high)) for name in names]
    training = training_cases(job.noise)
    best: tuple[float, dict[str, float]] = (math.inf, {})
    start_cost = target_of(law_type, law_type.start(), training)

    def cost(point: Sequence[float]) -> float:
        nonlocal best
        values = {name: float(f"{math.exp(value):.6g}") for name, value in zip(names, point, strict=True)}
        found = target_of(law_type, values, training)
        if found < best[0]:
            best = found, values
        return found

    random = np.random.default_rng(job.seed)
    low, high = np.array(bounds).T
    start = np.array([math.log(law_type.parameters[name].start) for name in names])
    population = _population(start, low, high, random)
    generations = max(1, round(_GLOBAL_SHARE * job.budget / _POPULATION))
    globally = differential_evolution(
        cost, bounds, init=population, maxiter=generations - 1, tol=0.0, atol=0.0, mutation=(0.4, 0.9),
        recombination=0.8, polish=False, rng=random,
    )  # fmt: skip
    # A simplex around the best goes on downhill with what is left of the budget.
    simplex = np.clip(globally.x + np.vstack([np.zeros(len(names)), 0.05 * np.diag(high - low)]), low, high)
    left = job.budget - generations * _POPULATION
    if left > len(names):
        options = {"maxfev": left, "initial_simplex": simplex, "xatol": 0.0, "fatol": 0.0, "adaptive": True}
        minimize(cost, globally.x, method="Nelder-Mead", bounds=bounds, options=options)
    return {
        "cost": round(best[0], 4),
        "start_cost": round(start_cost, 4),
        "values": best[1],
    }


def _population(start: Vector, low: Vector, high: Vector, random: np.random.Generator) -> Vector:
    """Return points to begin with: the start, half of the others around it, and half of them anywhere."""
    anywhere = low + (high - low) * random.random((_POPULATION, len(low)))
    around = start + _NEIGHBOURHOOD * (high - low) * random.standard_normal((_POPULATION, len(low)))
    points = np.where(np.arange(_POPULATION)[:, None] % 2 == 0, around, anywhere)
    points[0] = start
    return np.clip(points, low, high)


def tuned(jobs: Sequence[TuningJob], before: Mapping[str, Any], *, workers: int | None = None) -> dict[str, Any]:
    """Return the content of ``tuned.json`` with the results of jobs in place of what it had for them."""
    laws: dict[str, Any] = {name: dict(levels) for name, levels in before.get("laws", {}).items()}
    for job, found in zip(jobs, run_jobs(tune, jobs, workers=workers), strict=True):
        laws.setdefault(job.law, {})[level(job.noise)] = found
    return {"seed": jobs[0].seed, "budget": jobs[0].budget, "laws": laws}


def main() -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--law", metavar="NAME", action="append", help="this law only; may be repeated")
    parser.add_argument("--budget", type=int, default=BUDGET, help="evaluations (default %(default)s)")
    parser.add_argument("--seed", type=int, default=SEED, help="of the optimiser (default %(default)s)")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one a core)")
    options = parser.parse_args()
    path = contestants.TUNED
    before = json.loads(path.read_text("utf-8")) if options.law and path.exists() else {}
    if before and (before["seed"], before["budget"]) != (options.seed, options.budget):
        parser.error(f"{path.name} was made with --seed {before['seed']} --budget {before['budget']}: give these")
    jobs = [
        TuningJob(law, noise, options.budget, options.seed)
        for law in options.law or contestants.baselines()
        for noise in NOISES
    ]
    path.write_text(json.dumps(tuned(jobs, before, workers=options.workers), indent=1) + "\n", "utf-8")
    print(f"{path} written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
