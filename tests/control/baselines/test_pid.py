"""The PID controller against python-control's closed loop, and what it is here for: overshoot by set-point."""

from typing import Any

import control
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.control.baselines.rig import MODEL, PERIOD_S, QUICK, SLOW, Axis
from twostage_servo.control.baselines.pid import Pid
from twostage_servo.control.optimal import ServoGains, servo_gains
from twostage_servo.control.plant import Plant


def closed_loop(plant: Plant, gains: ServoGains) -> Any:
    """From set-point to position, in transfer functions: the derivative in an inner loop, P and I round it."""
    z = control.tf([1.0, 0.0], [1.0], PERIOD_S)
    axis = control.c2d(control.tf([plant.gain], [1.0, plant.pole, 0.0]), PERIOD_S, "zoh")
    derivative = gains.f12 / PERIOD_S * (z - 1) / z
    return control.feedback((gains.f11 + gains.f22 / (z - 1)) * control.feedback(axis, derivative))


def step_response(loop: Any, ticks: int) -> NDArray[np.float64]:
    return np.asarray(control.forced_response(loop, PERIOD_S * np.arange(ticks), np.ones(ticks)).outputs)


def positions(gains: ServoGains, set_point: float, ticks: int, plant: Plant = MODEL, load: float = 0.0) -> Any:
    law = Pid(gains, PERIOD_S)
    law.set_target(set_point, 100.0)
    return Axis(plant, load).drive(law, ticks)[0]


@pytest.mark.parametrize("gains", [SLOW, QUICK], ids=["example 1", "example 2"])
def test_the_closed_loop_is_that_of_python_control(gains: ServoGains) -> None:
    theirs = 400.0 * step_response(closed_loop(MODEL, gains), 600)
    np.testing.assert_allclose(positions(gains, 400.0, 600), theirs, rtol=0.0, atol=400.0 * 1e-6)


@settings(max_examples=25)
@given(gain=st.floats(20.0, 500.0), pole=st.floats(2.0, 40.0), exponent=st.floats(-6.0, -2.5))
def test_the_closed_loop_is_that_of_python_control_for_any_plant_and_gains(
    gain: float, pole: float, exponent: float
) -> None:
    plant = Plant(gain, pole)
    gains = servo_gains(plant.discretise(PERIOD_S), 10.0**exponent)
    loop = closed_loop(plant, gains)
    assume(np.max(np.abs(loop.poles())) < 1.0)  # differentiated, a velocity is half a tick late
    theirs = step_response(loop, 200)
    np.testing.assert_allclose(positions(gains, 1.0, 200, plant), theirs, rtol=0.0, atol=1e-6 * np.max(np.abs(theirs)))


@pytest.mark.parametrize("gains", [SLOW, QUICK], ids=["example 1", "example 2"])
@pytest.mark.parametrize("set_point", [50.0, 400.0, -400.0, 1000.0, 2000.0])
def test_the_overshoot_is_the_same_share_of_every_set_point(gains: ServoGains, set_point: float) -> None:
    share = np.max(step_response(closed_loop(MODEL, gains), 400)) - 1.0
    assert share > 0.2  # or there would be nothing to complain of
    overshoot = np.max(np.sign(set_point) * positions(gains, set_point, 400)) - abs(set_point)
    assert overshoot == pytest.approx(share * abs(set_point), rel=1e-6)


@settings(max_examples=20)
@given(load=st.floats(-8.0, 8.0), gains=st.sampled_from([SLOW, QUICK]))
def test_a_constant_load_leaves_no_error(load: float, gains: ServoGains) -> None:
    assert positions(gains, 400.0, 1500, load=load)[-1] == pytest.approx(400.0, abs=1e-6)
