"""What may be believed of what was learned before: no more than identification could have found by itself.

It comes back from a file, which may be of another plant, half written, or edited by hand.
"""

from typing import Final

from twostage_servo.control.laws.adaptive.acceptance import GAIN_BOUNDS, POLE_BOUNDS
from twostage_servo.control.laws.adaptive.identification import widened
from twostage_servo.control.laws.adaptive.learning import MOST_DELAY_EVIDENCE
from twostage_servo.control.laws.adaptive.rules import LearningRules
from twostage_servo.control.laws.law import ControlTask, Learned

_ROUNDING: Final = 1e-9
"""By what share a value at its bound may be beyond it: it was multiplied by what it is divided by here."""

_MOST_MOVES: Final = 1_000_000_000


def check_learned(learned: Learned, task: ControlTask, rules: LearningRules) -> None:
    """Check what was learned before.

    Raises
    ------
    ValueError
        If identification could not have found it on this task.
    """
    plant = task.plant
    _check_multiple("gain", learned.gain / plant.gain, GAIN_BOUNDS)
    _check_multiple("pole", learned.pole / plant.pole, POLE_BOUNDS)
    shares = widened(0.0, rules.prior_share), rules.prior_share
    _check("gain_share", learned.gain_share, shares)
    _check("pole_share", learned.pole_share, shares)
    for load in learned.load:
        if load is not None:
            _check("load", load, (-task.effort_limit, task.effort_limit))
    _check("delay_ticks", learned.delay_ticks, (0, 1))
    _check("delay_evidence", learned.delay_evidence, (-MOST_DELAY_EVIDENCE, MOST_DELAY_EVIDENCE))
    agrees = (-MOST_DELAY_EVIDENCE, 0.0) if learned.delay_ticks else (-rules.delay_evidence, MOST_DELAY_EVIDENCE)
    _check(f"delay_evidence for {learned.delay_ticks} ticks", learned.delay_evidence, agrees)
    _check("moves", learned.moves, (1, _MOST_MOVES))


def _check_multiple(name: str, multiple: float, bounds: tuple[float, float]) -> None:
    low, high = bounds
    if not low * (1.0 - _ROUNDING) <= multiple <= high * (1.0 + _ROUNDING):
        raise ValueError(f"{name} is {multiple:g} times the configured one, and must be {low:g} to {high:g} times that")


def _check(name: str, value: float, bounds: tuple[float, float]) -> None:
    low, high = bounds
    if not low <= value <= high:  # nor is NaN within any bounds
        raise ValueError(f"{name} is {value:g}, and must be from {low:g} to {high:g}")
