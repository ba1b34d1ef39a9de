"""The suite: axes that are off their model, moves, and what a move comes to."""

import random
from dataclasses import dataclass
from math import copysign, exp, inf, log
from typing import Final, Protocol

from tools.bench.control_quality.true_plant import TrueAxis, TruePlant
from twostage_servo.control.time_optimal import Capability, QuickestMove

PERIOD_S: Final = 0.01
GAIN: Final = 180.0
POLE: Final = 14.0
"""The model, in mm/s² per V and 1/s: that of the demo."""
BAND: Final = 0.1
"""Of settling, in mm."""
LONGEST_EXCESS_S: Final = 1.7
"""A move that is not settled so long after its bound counts as that."""
REST_S: Final = 1.0
"""Between two moves."""
HELD_S: Final = 2.0
"""For so long an axis has been holding before its first move."""
NOISES: Final = (0.0, 0.0316)
"""Standard deviations of the encoder, in mm."""
SPREAD: Final = 0.3
"""By which share gain and pole are off the model at most."""
DISTANCES: Final = (5.0, 2000.0)
VELOCITIES: Final = (20.0, 200.0)
"""From and to, in mm and mm/s; even on a logarithmic scale."""
FRICTIONS: Final = (0.0, 0.5)
LOADS: Final = (-1.0, 1.0)
EFFORT_LIMITS: Final = (10.0, 24.0)
"""In V."""


class SuiteLaw(Protocol):
    """What the suite needs of a law."""

    def set_target(self, target: float, velocity: float) -> None:
        """Go to a set-point in mm with a cruise velocity in mm/s."""

    def step(self, sample: float) -> float:
        """Process the sample of the period before, in mm; return the effort in V."""


@dataclass(frozen=True, slots=True)
class Model:
    """What a law believes of its axis: gain in mm/s² per V, pole in 1/s and tick in s."""

    gain: float = GAIN
    pole: float = POLE
    period_s: float = PERIOD_S


@dataclass(frozen=True, slots=True)
class LoadStep:
    """A load that changes in the first move.

    Attributes
    ----------
    size
        By how much, in V.
    at_s
        When, from the move's first effort on.
    """

    size: float
    at_s: float


@dataclass(frozen=True, slots=True)
class Case:
    """An axis and its moves: there and back, and there again.

    Attributes
    ----------
    axis
        What it is really like.
    distance, velocity
        Of each move, in mm and mm/s.
    seed
        Of its noise.
    step
        Of the load; None for none.
    model
        What the law is designed with.
    band
        Of settling, in mm.
    """

    axis: TrueAxis
    distance: float
    velocity: float
    seed: int
    step: LoadStep | None = None
    model: Model = Model()
    band: float = BAND


def cases(count: int, noise: float, first_seed: int, *, spread: float = SPREAD) -> list[Case]:
    """Return random axes: every other one at a corner of gain and pole."""
    return [_case(first_seed + index, noise, spread, corner=index % 2 == 0) for index in range(count)]


def _case(seed: int, noise: float, spread: float, *, corner: bool) -> Case:
    rng = random.Random(seed)  # noqa: S311 - no secret
    if corner:
        gain, pole = (1.0 + spread * rng.choice((-1.0, 1.0)) for _ in range(2))
    else:
        gain, pole = (1.0 + rng.uniform(-spread, spread) for _ in range(2))
    axis = TrueAxis(
        GAIN * gain, POLE * pole, rng.uniform(*FRICTIONS), rng.uniform(*LOADS), rng.choice((0, 1)),
        rng.choice(EFFORT_LIMITS), noise=noise,
    )  # fmt: skip
    distance = _between(rng, DISTANCES) * rng.choice((-1.0, 1.0))
    return Case(axis, distance, _between(rng, VELOCITIES), seed)


def _between(rng: random.Random, ends: tuple[float, float]) -> float:
    return exp(rng.uniform(log(ends[0]), log(ends[1])))


def quickest_move(axis: TrueAxis, load: float, distance: float, velocity: float, band: float = BAND) -> QuickestMove:
    """Return the quickest move of a distance in mm with a load in V, a velocity in mm/s and a band in mm."""
    sign = 1.0 if distance > 0 else -1.0
    up = axis.gain * (axis.effort_limit - sign * load - axis.friction)
    down = axis.gain * (axis.effort_limit + sign * load + axis.friction)
    return Capability(up, down, axis.pole).quickest_move(abs(distance), velocity, band)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a move came to.

    Attributes
    ----------
    excess_s
        Settling time beyond the bound.
    settling_s
        Until it stays within the band, between ticks as well; infinity if it never does.
    overshoot
        Beyond the set-point, in mm.
    peak_velocity
        As a multiple of the cruise velocity.
    """

    excess_s: float
    settling_s: float
    overshoot: float
    peak_velocity: float


class Rig:
    """A law and the plant that it drives.

    Parameters
    ----------
    law
        Has not been run yet.
    case
        What it drives.

    Attributes
    ----------
    plant
        The axis.
    effort
        The last one, in V.
    """

    def __init__(self, law: SuiteLaw, case: Case) -> None:
        self.plant = TruePlant(case.axis, case.model.period_s, case.seed)
        self._case = case
        self.effort = 0.0
        self._law = law
        self._sample = self.plant.sample()

    def tick(self) -> None:
        """Let the law answer the last sample, take another, and let the effort act for a tick."""
        self.effort = effort = self._law.step(self._sample)
        self._sample = self.plant.sample()
        self.plant.advance(effort)

    def hold(self, duration_s: float) -> None:
        """Let some time pass."""
        for _ in range(round(duration_s / self._case.model.period_s)):
            self.tick()

    def move(self, target: float, velocity: float, watched_s: float, step: LoadStep | None = None) -> Outcome:
        """Move from rest; time counts from the first effort on.

        Parameters
        ----------
        target, velocity
            In mm and mm/s.
        watched_s
            How long after its bound it is watched; see :data:`LONGEST_EXCESS_S`.
        step
            Of the load, if there is one.
        """
        plant, period_s, band = self.plant, self._case.model.period_s, self._case.band
        sign = copysign(1.0, target - plant.position)
        bound = quickest_move(plant.axis, plant.load, target - plant.position, velocity, band).bound_s
        self._law.set_target(target, velocity)
        settled = overshoot = peak = 0.0
        for tick in range(round((bound + watched_s) / period_s)):
            if step is not None and tick == round(step.at_s / period_s):
                plant.load += step.size
            before = abs(plant.position - target)
            self.tick()
            error = plant.position - target
            if abs(error) > band:
                settled = inf
            elif settled == inf:
                share = (before - band) / (before - abs(error)) if before > band else 0.0
                settled = (tick + share) * period_s
            overshoot = max(overshoot, sign * error)
            peak = max(peak, abs(plant.velocity))
        return Outcome(min(settled - bound, LONGEST_EXCESS_S), settled, overshoot, peak / velocity)


def run(
    law: SuiteLaw, case: Case, moves: int, *, watched_s: float = LONGEST_EXCESS_S, rest_s: float = REST_S
) -> list[Outcome]:
    """Move an axis there and back some times, with a rest after each move, in s; see :meth:`Rig.move`."""
    rig, outcomes = Rig(law, case), []
    rig.hold(HELD_S)
    for move in range(moves):
        target = case.distance if move % 2 == 0 else 0.0
        outcomes.append(rig.move(target, case.velocity, watched_s, case.step if move == 0 else None))
        rig.hold(rest_s)
    return outcomes


def nominal(effort_limit: float = 10.0) -> Case:
    """Return the move that is quoted: 400 mm at 100 mm/s on an axis that is as its model."""
    return Case(TrueAxis(GAIN, POLE, effort_limit=effort_limit), 400.0, 100.0, seed=1)
