"""What the suite does not ask for: load steps in each part of a move, more delay, more spread than a law is for."""

import random
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from tools.bench.control_quality.suite import LOADS, Case, LoadStep, cases, quickest_move
from twostage_servo.control.time_optimal import QuickestMove

SUITE: Final = "suite"
TWICE_THE_SPREAD: Final = 0.5
_PARTS: Final[dict[str, Callable[[QuickestMove], float]]] = {
    "load step while accelerating": lambda move: 0.5 * move.accelerating_s,
    "load step in the cruise": lambda move: move.accelerating_s + 0.5 * move.cruising_s,
    "load step while braking": lambda move: move.accelerating_s + move.cruising_s + 0.5 * move.braking_s,
}
"""When the load steps, by the quickest move's parts."""
SCENARIOS: Final = (*_PARTS, "two ticks of delay", "gain and pole off by up to 50 %")


def scenario_cases(scenario: str, count: int, noise: float, first_seed: int) -> list[Case]:
    """Return the cases of a scenario: those of the suite with one thing changed.

    Raises
    ------
    ValueError
        If there is no such scenario.
    """
    if scenario == "gain and pole off by up to 50 %":
        return cases(count, noise, first_seed, spread=TWICE_THE_SPREAD)
    found = cases(count, noise, first_seed)
    if scenario == SUITE:
        return found
    if scenario == "two ticks of delay":
        return [replace(case, axis=replace(case.axis, delay_ticks=2)) for case in found]
    if scenario in _PARTS:
        return [_with_step(case, _PARTS[scenario]) for case in found]
    raise ValueError(f"there is no scenario {scenario!r}; there are: {', '.join((SUITE, *SCENARIOS))}")


def _with_step(case: Case, when: Callable[[QuickestMove], float]) -> Case:
    """Return a case whose load steps to another value within its bounds."""
    load = random.Random(case.seed ^ 0x5EED).uniform(*LOADS)  # noqa: S311 - no secret
    quickest = quickest_move(case.axis, case.axis.load, case.distance, case.velocity)
    return replace(case, step=LoadStep(load - case.axis.load, when(quickest)))
