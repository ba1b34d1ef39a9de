"""The adaptive law as one that an axis may have: its keys, and how it is designed."""

from dataclasses import replace
from math import inf, isfinite, sqrt
from typing import Final

from pydantic import Field

from twostage_servo.control.laws.adaptive.design import design_adaptive, paper_gains
from twostage_servo.control.laws.adaptive.rules import LearningRules, Rules
from twostage_servo.control.laws.law import ControlTask, DesignError, LawDesign
from twostage_servo.control.laws.paper_design import design_paper
from twostage_servo.control.laws.registry import LawType
from twostage_servo.settings.base import Settings, quantity


class AdaptiveSettings(Settings):
    """How noisy the encoder is, and which parts of the adaptive law act."""

    encoder_noise: float = quantity(
        0.0,
        unit="axis unit",
        description="Standard deviation of a measured position, where it is known to be more than what its own step in "
        "the drive's messages makes; more is measured at rest",
        ge=0.0,
        le=1e12,
    )
    planned_braking: bool = Field(
        True,
        description="Whether a reference brakes to the set-point, by most of the effort; without it the law is the "
        "paper's, and the other parts have nothing to act on",
    )
    placed_poles: bool = Field(
        True, description="Whether gains come from poles; without, from performance_index_ratio and [axis.observer]"
    )
    performance_index_ratio: float = quantity(
        5.0e-5, unit="1", description="Q/R of the paper's design, for the two parts above", ge=1e-12, le=1e6
    )
    identification: bool = Field(
        True, description="Whether moves from rest identify gain, pole, load and delay of the plant"
    )
    delay: bool = Field(True, description="Whether identification looks for a delay of the effort by a tick as well")
    caution: bool = Field(
        True,
        description="Whether moves accelerate by less the faster they are, and a first one brakes over some ticks more",
    )
    departure: bool = Field(True, description="Whether the effort is held back until the axis is seen to move")
    friction: bool = Field(
        True, description="Whether friction is given up as a motion ends, behind a noisy encoder: it no longer acts"
    )
    root: bool = Field(
        True, description="Whether a large error is taken away with its root, so that the effort's rate suffices"
    )


def rules_of(settings: AdaptiveSettings, task: ControlTask) -> tuple[Rules, LearningRules]:
    """Return the rules of those parts that act."""
    rules = Rules(is_cautious=settings.caution, holds_back=settings.departure, ends_friction=settings.friction)
    if not settings.root:
        rules = replace(rules, pull_share=inf)  # no error is large
    if not settings.placed_poles:
        rules = replace(rules, fixed_gains=paper_gains(task, settings.performance_index_ratio))
    return rules, LearningRules(finds_delay=settings.delay)


def _design(settings: AdaptiveSettings, task: ControlTask) -> LawDesign:
    if not settings.planned_braking:
        if isfinite(task.jerk):
            raise DesignError(("planned_braking",), "axis.law.jerk smooths a planned braking: keep it, or remove jerk")
        return design_paper(settings.performance_index_ratio, task)
    rules, learning_rules = rules_of(settings, task)
    # What lies anywhere within a step has the deviation of an even distribution.
    noise = max(settings.encoder_noise, task.encoder_step / sqrt(12.0))
    return design_adaptive(task, noise, learns=settings.identification, rules=rules, learning_rules=learning_rules)


ADAPTIVE: Final = LawType(AdaptiveSettings, _design, smooths=True)
