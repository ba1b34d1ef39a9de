"""One run: a law on a sampled plant, sample by sample, without a bus."""

import math
from dataclasses import dataclass, field
from random import Random
from typing import Final

from twostage_servo.control.plant import DiscretePlant
from twostage_servo.paper.examples import PERIOD_S, SET_POINT, VELOCITY, Example
from twostage_servo.paper.methods import Builder

SEED: Final = 1
DURATION_S: Final = 10.0
DIVERGED: Final = 1e5
"""Distance from the set-point, in mm, beyond which a run is given up."""


@dataclass(slots=True)
class DrivenPlant:
    """The true plant: exact between sampling instants, because effort and load are constant there."""

    model: DiscretePlant
    load: float = 0.0
    position: float = 0.0
    velocity: float = 0.0

    def advance(self, effort: float) -> None:
        """Move on by one period under an effort (V); the load opposes it."""
        model, total = self.model, effort - self.load
        self.position += model.a12 * self.velocity + model.b1 * total
        self.velocity = model.a22 * self.velocity + model.b2 * total


@dataclass(slots=True)
class Run:
    """What happened, one entry per sampling instant k, at time ``k T_s``.

    Attributes
    ----------
    position, velocity
        The true ones, in mm and mm/s, before ``effort`` acts.
    law_velocity
        The velocity that the law used for ``effort``, in mm/s.
    effort
        In V.
    changeover
        The k of the change-over: the first with no more than p to go; None if there was none. The position stage makes
        the effort from the next tick on, and in the proposed law from this one on, where both stages give the same.
    diverged
        Whether the run was given up because the plant had run away.
    """

    set_point: float
    reference: float
    position: list[float] = field(default_factory=list)
    velocity: list[float] = field(default_factory=list)
    law_velocity: list[float] = field(default_factory=list)
    effort: list[float] = field(default_factory=list)
    changeover: int | None = None
    diverged: bool = False

    @property
    def time_s(self) -> list[float]:
        """Times of the entries."""
        return [PERIOD_S * k for k in range(len(self.position))]


def simulate(
    build: Builder,
    example: Example,
    *,
    set_point: float = SET_POINT,
    velocity: float = VELOCITY,
    load: float = 0.0,
    noise_variance: float | None = None,
    seed: int = SEED,
    duration_s: float = DURATION_S,
    position_quantum: float = 0.0,
    effort_quantum: float = 0.0,
) -> Run:
    """Drive the example's plant from rest at 0 to a set-point.

    Parameters
    ----------
    build
        Builds the law.
    example
        Plant, model and noise.
    set_point, velocity
        r in mm and v in mm/s.
    load
        Constant disturbance, in V, from the beginning.
    noise_variance
        In mm²; the example's if None.
    seed
        Of the noise; the same seed gives every law the same noise.
    duration_s
        Length of the run.
    position_quantum, effort_quantum
        What the sample (mm) and the effort (V) are rounded to on their way, as a frame does; 0 for not at all.
    """
    plant = DrivenPlant(example.true_plant.discretise(PERIOD_S), load)
    law = build(example, lambda: plant.velocity)
    random = Random(seed)  # noqa: S311 - measurement noise, not a secret
    deviation = math.sqrt(example.noise_variance if noise_variance is None else noise_variance)
    run = Run(set_point, velocity)
    law.set_target(set_point, velocity)
    sample_before = 0.0
    for k in range(round(duration_s / PERIOD_S)):
        sample = plant.position + (random.gauss(0.0, deviation) if deviation else 0.0)
        sample = _rounded(sample, position_quantum)
        changeovers = law.changeovers
        effort = law.step(sample_before if law.sample_age else sample)
        sample_before = sample
        if law.changeovers > changeovers:
            run.changeover = k
        run.position.append(plant.position)
        run.velocity.append(plant.velocity)
        run.law_velocity.append(law.velocity)
        run.effort.append(effort)
        plant.advance(_rounded(effort, effort_quantum))
        if not abs(plant.position - set_point) < DIVERGED:
            run.diverged = True
            break
    return run


def _rounded(value: float, quantum: float) -> float:
    return round(value / quantum) * quantum if quantum else value
