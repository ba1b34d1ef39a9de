"""The optimal servo of section II against its own closed loop, the incremental state space of equation (10)."""

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.control.baselines.rig import MODEL, PERIOD_S, QUICK, SLOW, Axis
from twostage_servo.control.baselines.optimal_servo import OptimalServo
from twostage_servo.control.baselines.velocity import speed_sensor
from twostage_servo.control.optimal import ServoGains, servo_gains
from twostage_servo.control.plant import Plant

Matrix = NDArray[np.float64]
plants = st.builds(Plant, gain=st.floats(20.0, 500.0), pole=st.floats(2.0, 40.0))
exponents = st.floats(-6.0, -2.0)


def incremental(plant: Plant) -> tuple[Matrix, Matrix]:
    """A_p and B_p of (10), from python-control's sampled plant."""
    continuous = control.ss([[0.0, 1.0], [0.0, -plant.pole]], [[0.0], [plant.gain]], np.eye(2), 0.0)
    sampled = control.c2d(continuous, PERIOD_S, "zoh")
    a_p = np.block([[np.asarray(sampled.A), np.zeros((2, 1))], [np.array([[-1.0, 0.0, 1.0]])]])
    return a_p, np.vstack([np.asarray(sampled.B), [[0.0]]])


def dlqr(plant: Plant, ratio: float) -> tuple[Matrix, NDArray[np.complex128]]:
    """F of (12) with its own sign, and the closed loop's poles."""
    gain, _, poles = control.dlqr(*incremental(plant), ratio * np.diag([1.0, 0.0, 1.0]), np.eye(1))
    return np.asarray(gain), np.asarray(poles)


def run(plant: Plant, gains: ServoGains, set_point: float, ticks: int, load: float = 0.0) -> Matrix:
    axis = Axis(plant, load)
    law = OptimalServo(gains, speed_sensor(lambda: axis.velocity))
    law.set_target(set_point, 100.0)
    return axis.drive(law, ticks)


def ours(plant: Plant, ratio: float) -> ServoGains:
    return servo_gains(plant.discretise(PERIOD_S), ratio)


@settings(max_examples=30)
@given(plant=plants, exponent=exponents)
def test_the_closed_loop_is_the_incremental_state_space(plant: Plant, exponent: float) -> None:
    feedback, _ = dlqr(plant, 10.0**exponent)
    a_p, b_p = incremental(plant)
    loop = control.ss(a_p - b_p @ feedback, np.zeros((3, 1)), np.eye(3), 0.0, PERIOD_S)
    ticks = 300
    # Nothing has moved until the first error is known, at k = 1: x_p(1) = [0, 0, e(0)] = [0, 0, 1].
    states = control.initial_response(loop, PERIOD_S * np.arange(ticks), [0.0, 0.0, 1.0]).outputs
    expected = np.concatenate([[0.0], np.cumsum(np.asarray(states)[0])])
    position, _, _ = run(plant, ours(plant, 10.0**exponent), 1.0, ticks + 1)
    np.testing.assert_allclose(position, expected, rtol=0.0, atol=1e-6)


@settings(max_examples=30)
@given(plant=plants, exponent=exponents, set_point=st.floats(-2000.0, 2000.0).filter(lambda r: abs(r) > 1.0))
def test_the_errors_obey_the_poles_of_dlqr_and_no_others(plant: Plant, exponent: float, set_point: float) -> None:
    """By Cayley and Hamilton: the characteristic polynomial of three poles, applied to the errors, gives nothing."""
    _, poles = dlqr(plant, 10.0**exponent)
    position, _, _ = run(plant, ours(plant, 10.0**exponent), set_point, 100)
    residues = np.convolve(position[1:] - set_point, np.real(np.poly(poles)), mode="valid")
    np.testing.assert_allclose(residues / set_point, 0.0, atol=1e-7)


@settings(max_examples=30)
@given(load=st.floats(-8.0, 8.0), set_point=st.floats(-2000.0, 2000.0), gains=st.sampled_from([SLOW, QUICK]))
def test_a_constant_load_leaves_no_error(load: float, set_point: float, gains: ServoGains) -> None:
    position, velocity, effort = run(MODEL, gains, set_point, 1500, load)
    assert position[-1] == pytest.approx(set_point, abs=1e-6)
    assert velocity[-1] == pytest.approx(0.0, abs=1e-6)
    assert effort[-1] == pytest.approx(load, abs=1e-6)


def test_its_speed_grows_with_the_distance() -> None:
    """What the speed stage is for: one stage alone runs to a far set-point as fast as the distance makes it."""
    near, far = (run(MODEL, SLOW, set_point, 400)[1].max() for set_point in (100.0, 1000.0))
    assert far == pytest.approx(10.0 * near, rel=1e-9)
    assert far > 1000.0  # where the set-point's velocity is 100
