"""Speeds that are next to none: an axis comes to rest from any, and is asked for none that is no motion."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.axis.rig import DEMO, PERIOD_S, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.exact import exact

DESIGN = design_axis(axis_settings(), PERIOD_S)


def rests(law_velocity: float, rate: float) -> None:
    design = design_axis(axis_settings(effort_rate=rate), PERIOD_S)
    law = design.build_nominal_law()
    law.observer.velocity = law_velocity
    law.stop(DEMO["limits"]["quick_stop_deceleration"])
    for _ in range(1000):
        law.step(None)
        if law.speed_reference == 0.0:
            return
    pytest.fail(f"a stop from {law_velocity} has not brought the reference to rest")


@given(exponent=st.floats(-323.0, 1.0), rate=st.sampled_from([10.0, 1000.0, 1e9]), sign=st.sampled_from([1.0, -1.0]))
def test_a_stop_from_any_speed_comes_to_rest(exponent: float, rate: float, sign: float) -> None:
    rests(sign * 10.0**exponent, rate)


@pytest.mark.parametrize("velocity", [1.2e-301, 5e-324, 1e-9])
def test_a_stop_of_an_axis_at_exact_rest_is_no_failed_braking(velocity: float) -> None:
    rig = AxisRig().armed()
    rig.axis.law.observer.velocity = velocity
    rig.axis._operation.set_target(5.0, 1e-300)
    rig.axis.machine.state = State.SPEED_STAGE
    rig.axis.stop()
    rig.seconds(3.0)
    assert (rig.state(), rig.axis.trip) == (State.HOLDING, None)


def test_what_is_no_motion_is_refused_with_the_smallest_speed_that_is_one() -> None:
    rig = AxisRig().armed()
    slowest = 0.001 / 3600.0
    assert rig.axis.slowest_velocity == pytest.approx(slowest)
    for ask in (lambda: rig.axis.move_to(5.0, 1e-300), lambda: rig.axis.jog(-1e-300)):
        with pytest.raises(
            Refused, match=r"at less than 2\.78e-07 mm/s the axis would not move one encoder step"
        ) as refused:
            ask()
        assert refused.value.code == "velocity_limit"
    rig.axis.move_to(5.0, 1.001 * slowest)
    rig.seconds(1.0)
    rig.axis.stop()
    rig.seconds(3.0)
    assert (rig.state(), rig.axis.trip) == (State.HOLDING, None)
    without_steps = Axis(DESIGN, DriveTraits(counter_modulus=16))
    assert 0.0 < without_steps.slowest_velocity < 1e-9


@pytest.mark.parametrize(
    ("target", "velocity", "shown"),
    [(2500.0000001, 100.0, "set-point 2500.0000001 mm"), (0.0, 250.00000001, "velocity 250.00000001 mm/s")],
)
def test_a_number_just_beyond_its_bound_is_shown_as_such(target: float, velocity: float, shown: str) -> None:
    rig = AxisRig().armed()
    with pytest.raises(Refused, match=shown.replace(".", r"\.")):
        rig.axis.move_to(target, velocity)


@given(value=st.floats(allow_nan=False))
def test_exact_numbers_are_the_numbers(value: float) -> None:
    assert float(exact(value)) == value
    assert exact(math.nan) == "nan"
