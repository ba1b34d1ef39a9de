"""The tuned numbers of the adaptive law: poles in z, times in ticks, shares; found by optimisation.

None of them has the unit of an axis: what a pole, a share or a number of ticks is worth follows from the plant, the
tick and the limits of the effort. So the same axis in millimetres, degrees or counts makes the same move.
"""

from dataclasses import dataclass
from typing import Final

from twostage_servo.control.laws.adaptive.placement import FixedGains, Gains, Pair, Poles
from twostage_servo.control.laws.law import ControlTask

QUIET_POLES: Final = Poles(0.0512, Pair(0.9137, 0.0289), Pair(0.1033, 0.0946))
"""For an encoder whose noise does not matter: peak sensitivity 2.0, delay margin 2 ticks."""

NOISY_POLES: Final = Poles(0.839, Pair(0.802, 0.0269), Pair(0.345, 0.0433))
"""For an encoder whose noise does: the estimate averages over more samples."""

NOISY_FROM: Final = 0.04
"""Noise above which :data:`NOISY_POLES` are taken, in :func:`noise_unit`: 0.007 mm on the axis of the demo."""

FINEST_SPREAD: Final = 0.0185
"""Smallest spread of a sample that is assumed, in :func:`noise_unit`: a third of an encoder step of 0.01 mm there."""

SPREAD_SHARE: Final = 1.874
"""Spread of a sample for identification, as a multiple of the noise: a plant differs from its equation as well."""


LOAD_DEVIATIONS: Final = 3.0
"""Standard deviations of a load by which a learned one may differ from what is held at rest: by friction it does, by
what has changed since, and by what a fit could not tell from a load."""

SWING_TICKS: Final = 5.0
"""Ticks in which the effort has to be able to go from none to its limit for loops as quick as the tick allows."""


def loop_period_s(task: ControlTask) -> float:
    """Return the tick that the loops are made for, in s: the task's, or a longer one where the effort's rate is low.

    A loop that asks for more than the effort's rate gives oscillates with it. By how much it asks for more goes with
    the ratio of that swing to its own time, so both have to keep in step.
    """
    return max(task.period_s, task.effort_limit / (SWING_TICKS * task.effort_rate_limit))


def noise_unit(task: ControlTask) -> float:
    """Return by what noise is measured, in axis unit: how far the effort's largest change moves the axis in a tick.

    So a threshold of the noise means the same whatever unit the axis has. The tick is that of the loops.
    """
    period_s = loop_period_s(task)
    step = min(task.effort_rate_limit * period_s, task.effort_limit)
    return abs(task.plant.gain) * step * period_s * period_s


def is_noisy(task: ControlTask, noise: float) -> bool:
    """Whether the noise of an encoder, a standard deviation in axis unit, matters to the loops."""
    return noise > NOISY_FROM * noise_unit(task)


def encoder_poles(task: ControlTask, noise: float) -> Poles:
    """Return the poles for an encoder whose noise is a standard deviation in axis unit."""
    poles = NOISY_POLES if is_noisy(task, noise) else QUIET_POLES
    ticks = loop_period_s(task) / task.period_s
    return poles.slower(1.0 / ticks) if ticks > 1.0 else poles


def encoder_gains(task: ControlTask, noise: float, rules: "Rules") -> Gains:
    """Return where gains come from: the rules' fixed ones, or the poles for an encoder whose noise is in axis unit."""
    return encoder_poles(task, noise) if rules.fixed_gains is None else rules.fixed_gains


@dataclass(frozen=True, slots=True)
class Rules:
    """How the law shapes a move.

    Attributes
    ----------
    braking_share
        Share of what the effort limit could brake with that the reference asks for; the rest is the feedback's.
    acceleration_ticks, acceleration_s, overreach
        Time constant of an acceleration, in ticks of the loops (:func:`loop_period_s`) and in s, whichever is longer,
        and the multiple of the cruise velocity that it aims at: the reference rises by less the faster it is. There is
        time to identify; and what the drive holds if its host fails, until its own time-out of some 100 ms, drives the
        axis on by less.
    first_braking
        Ticks of the loops that a first move on an unknown plant takes at least to brake: time to correct.
    unknown, late, untimely
        Exponents of the poles while the plant is not known; where an effort acts a tick later; and where efforts or
        samples are late now and then, by up to a tick: quicker ones oscillate then, with a delay margin of 3 ticks.
    pull_share
        Share of the effort's change in a tick that a large error of the position may ask for; what makes no quick loop
        ask for more than the effort's rate gives.
    identification_ticks, longest_identification_ticks
        Ticks of cruise after which identification ends: where the gain is known, and in any case.
    is_cautious
        Whether moves accelerate so, and a first one takes that time.
    holds_back
        Whether the effort of a move is held back until the axis is seen to move.
    ends_friction
        Whether what acted against a motion alone is given up as it ends, where the loops are slow.
    fixed_gains
        Gains in the place of poles; None for poles.
    """

    braking_share: float = 0.66
    acceleration_ticks: float = 5.7
    acceleration_s: float = 0.057
    overreach: float = 1.3
    first_braking: float = 7.188
    unknown: float = 0.4
    late: float = 0.75
    untimely: float = 0.55
    pull_share: float = 0.5
    identification_ticks: int = 29
    longest_identification_ticks: int = 100_000
    is_cautious: bool = True
    holds_back: bool = True
    ends_friction: bool = True
    fixed_gains: FixedGains | None = None


@dataclass(frozen=True, slots=True)
class LearningRules:
    """When a fit is believed.

    Attributes
    ----------
    prior_share
        Standard deviation of gain and pole before anything is known, as a share.
    prior_load
        Standard deviation of what acts against a move, friction included, around what was held at rest, as a share of
        the effort limit.
    delay_evidence
        By how much the late fit has to be likelier on a first move.
    delay_gap
        Difference of the evidence from which it is known which delay is right.
    surprise
        Squared innovation, in its own variances, that neither fit may show twice in a row.
    misfit
        Mean of these up to which a fit is believed.
    residual, first_residual
        Largest sum of squares that a fit may leave, in variances of a sample: for each sample that is more than it
        takes, and once, for what the first ticks of a healthy axis add (friction that breaks away within a tick, a load
        that is not held yet): up to 56 on 600 axes.
    residual_samples
        Samples of either fit from which that counts.
    form_samples
        Samples of a fit from which its form is known to be right, if that holds.
    far
        Multiple of a bound of gain or pole beyond which a fit is that of another plant.
    sure_share
        Spread of the gain up to which the plant is known.
    known_share
        The same of gain and pole from which a cruise has nothing more to show.
    early_share, early_ticks
        The same for a fit that ends before its time, and the ticks that it needs.
    finds_delay
        Whether an effort may act a tick later.
    """

    prior_share: float = 0.17
    prior_load: float = 0.0463
    delay_evidence: float = 2.701
    delay_gap: float = 3.0
    surprise: float = 40.0
    misfit: float = 4.0
    residual: float = 4.0
    first_residual: float = 60.0
    residual_samples: int = 5
    form_samples: int = 20
    far: float = 1.25
    sure_share: float = 0.08
    known_share: float = 0.005
    early_share: float = 0.06
    early_ticks: int = 10
    finds_delay: bool = True
