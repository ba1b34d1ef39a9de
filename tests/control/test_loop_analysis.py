"""The engineer's margins are python-control's, and the service's own are equal to them."""

from pathlib import Path

import numpy as np
import pytest

from twostage_servo.app.assembly import design
from twostage_servo.axis.design import AxisDesign
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.loader import load
from twostage_servo.control.loop_analysis import LoopAnalysis

SHIPPED = sorted(path.name for path in shipped_configuration("").glob("*.toml") if path.name != "two_axes.toml")
MARGINS = ("gain_margin", "gain_reduction_margin", "phase_margin_deg", "delay_margin_s", "modulus_margin")


def axis_design(name: str) -> AxisDesign:
    return design(load(shipped_configuration(name)))


@pytest.mark.parametrize("name", SHIPPED)
def test_our_margins_are_those_of_python_control(name: str) -> None:
    made = axis_design(name)
    loops = made.law.loops()
    assert set(loops) == {"speed", "position", "brake"}
    for loop in loops.values():
        assert loop.controller is not None
        theirs = LoopAnalysis(made.plant, loop.controller).margins()
        for margin in MARGINS:
            assert getattr(loop, margin) == pytest.approx(getattr(theirs, margin), rel=2e-4), margin


@pytest.mark.parametrize("stage", ["speed", "position"])
def test_a_step_is_followed_to_its_end_without_an_error_that_stays(stage: str) -> None:
    made = axis_design("demo.toml")
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
