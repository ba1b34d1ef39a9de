"""The engineer's margins are python-control's, and the service's own are equal to them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from twostage_servo.app.assembly import design
from twostage_servo.axis.design import AxisDesign
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.loader import load
from twostage_servo.control.laws.law import Controller
from twostage_servo.control.loop_analysis import LoopAnalysis
from twostage_servo.control.plant import DiscretePlant, Plant

SHIPPED = sorted(path.name for path in shipped_configuration("").glob("*.toml") if path.name != "two_axes.toml")
MARGINS = ("gain_margin", "gain_reduction_margin", "phase_margin_deg", "delay_margin_s", "modulus_margin")


def axis_design(name: str, *overrides: str) -> AxisDesign:
    return design(load(shipped_configuration(name), overrides))


@pytest.mark.parametrize("law", ["paper", "adaptive"])
@pytest.mark.parametrize("name", SHIPPED)
def test_our_margins_are_those_of_python_control(name: str, law: str) -> None:
    made = axis_design(name, f"axis.law.type={law}")
    loops = made.law.loops()
    assert set(loops) >= {"speed", "position", "brake"}
    for loop in loops.values():
        assert loop.controller is not None
        theirs = LoopAnalysis(made.plant, loop.controller).margins()
        for margin in MARGINS:
            assert getattr(loop, margin) == pytest.approx(getattr(theirs, margin), rel=2e-4), margin
        magnitudes = [abs(pole) for pole in loop.poles]
        assert magnitudes == sorted(magnitudes, reverse=True)


@pytest.mark.parametrize("stage", ["speed", "position"])
def test_a_step_is_followed_to_its_end_without_an_error_that_stays(stage: str) -> None:
    made = axis_design("demo.toml", "axis.law.type=paper")
    controller = made.law.loops()[stage].controller
    assert controller is not None
    times_s, answer = LoopAnalysis(made.plant, controller).step_response(10.0)
    assert times_s[1] == pytest.approx(made.period_s)
    assert (times_s[0], times_s[-1]) == (0.0, pytest.approx(10.0))
    assert answer[0] == 0.0
    assert answer[-1] == pytest.approx(1.0, abs=1e-6)
    assert 1.0 < np.max(answer) < 1.3


def test_a_stop_has_no_step() -> None:
    made = axis_design("demo.toml")
    controller = made.law.loops()["brake"].controller
    assert controller is not None
    with pytest.raises(ValueError, match="no set-point"):
        LoopAnalysis(made.plant, controller).step_response(1.0)


def test_there_are_shipped_files_to_compare() -> None:
    assert len(SHIPPED) >= 8
    assert all(Path(name).suffix == ".toml" for name in SHIPPED)


def answer_by_hand(plant: DiscretePlant, law: Controller, ticks: int) -> list[float]:
    """Return the positions after a load step of 1, tick by tick: the plant takes ``u - 1``, the law the position."""
    position = velocity = 0.0
    state, answer = np.zeros(len(law.a)), []
    for _ in range(ticks):
        answer.append(position)
        total = float((np.array(law.c) @ state)[0]) - 1.0
        state = np.array(law.a) @ state + np.array(law.b)[:, 0] * position
        position, velocity = (
            position + plant.a12 * velocity + plant.b1 * total,
            plant.a22 * velocity + plant.b2 * total,
        )
    return answer


@pytest.mark.parametrize("name", ["demo.toml", "fast_tick.toml"])
def test_a_load_moves_the_axis_as_far_as_by_hand(name: str) -> None:
    made = axis_design(name)
    controller = made.law.loops()["position"].controller
    assert controller is not None
    by_hand = answer_by_hand(made.plant, controller, round(2.0 / made.period_s) + 1)
    assert abs(by_hand[-1]) < 0.05 * max(map(abs, by_hand))
    assert LoopAnalysis(made.plant, controller).load_step_peak() == pytest.approx(max(map(abs, by_hand)))


@pytest.mark.parametrize("period_s", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("gain", [0.1, 0.01])
def test_a_load_is_looked_at_until_a_slow_loop_has_answered(gain: float, period_s: float) -> None:
    """``u = -k y`` gives way to a load of 1 by 1/k; with 0.01 V/mm the demo's axis takes a minute for it."""
    law = Controller(((0.0,),), ((1.0,),), ((-gain,),))
    peak = LoopAnalysis(Plant(180.0, 14.0).discretise(period_s), law).load_step_peak()
    assert peak == pytest.approx(1.0 / gain, rel=1e-3)


def test_a_load_moves_an_unstable_loop_for_ever() -> None:
    made = axis_design("demo.toml")
    controller = made.law.loops()["position"].controller
    assert controller is not None
    turned = replace(controller, c=tuple(tuple(-gain for gain in row) for row in controller.c))
    assert LoopAnalysis(made.plant, turned).load_step_peak() == float("inf")


def test_a_loop_whose_gain_never_passes_one_has_no_limit_of_phase_or_delay() -> None:
    """An axis that is read, and not driven: the feedback is a millionth, and its plant has a constant place."""
    plant = DiscretePlant(0.01, 0.0, 0.5, 0.0, 1e-6)
    still = Controller(((0.5,),), ((1.0,),), ((-1e-6,),))
    margins = LoopAnalysis(plant, still).margins()
    assert margins.delay_margin_s == margins.phase_margin_deg == float("inf")
    assert margins.modulus_margin == pytest.approx(1.0, abs=1e-3)
