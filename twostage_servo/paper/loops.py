"""How stable the proposed law's loops are in both examples, by python-control."""

from dataclasses import asdict

from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper_margins import stage_controller
from twostage_servo.control.loop_analysis import LoopAnalysis, StabilityMargins
from twostage_servo.paper.examples import NOISE, PERIOD_S, Example

_SHOWN = {Stage.SPEED: "speed stage", Stage.POSITION: "position stage"}


def loops_of(example: Example) -> dict[str, LoopAnalysis]:
    """Return the loops of both stages by their names, each closed by the plant that the example drives."""
    plant = example.true_plant.discretise(PERIOD_S)
    return {
        name: LoopAnalysis(plant, stage_controller(example.model, example.gains, example.kalman, NOISE, stage))
        for stage, name in _SHOWN.items()
    }


def margins_of(example: Example) -> dict[str, StabilityMargins]:
    """Return the margins of both stages by their names."""
    return {name: loop.margins() for name, loop in loops_of(example).items()}


def margins_json(example: Example) -> dict[str, dict[str, float]]:
    """Return the margins of both stages, ready for JSON: all of them are finite in both examples."""
    return {name.partition(" ")[0]: asdict(margins) for name, margins in margins_of(example).items()}
