"""Servo gains against python-control, the paper's printed digits and the closed loop's poles."""

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twostage_servo.control.optimal import ServoGains, incremental_model, servo_gains
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01
PLANT = Plant(180.0, 14.0).discretise(PERIOD_S)


def dlqr(plant: Plant, ratio: float) -> list[float]:
    state, effort = incremental_model(plant.discretise(PERIOD_S))
    gain, _, _ = control.dlqr(state, effort, ratio * np.diag([1.0, 0.0, 1.0]), np.eye(1))
    return [float(value) for value in np.asarray(gain)[0]]


@pytest.mark.parametrize(
    ("ratio", "printed", "distance"),
    [(5.0e-5, ("3.78e-01", "2.32e-02", "6.92e-03"), "54.5"), (5.0e-3, ("1.43e+00", "6.89e-02", "6.63e-02"), "21.6")],
)
def test_the_papers_printed_digits(ratio: float, printed: tuple[str, str, str], distance: str) -> None:
    gains = servo_gains(PLANT, ratio)
    assert tuple(f"{value:.2e}" for value in (gains.f11, gains.f12, gains.f22)) == printed
    assert f"{100.0 * gains.changeover_time_s(PERIOD_S):.1f}" == distance


@settings(max_examples=40)
@given(gain=st.floats(1.0, 1e3), pole=st.floats(0.5, 100.0), exponent=st.floats(-6.0, -1.0))
def test_gains_are_those_of_python_control(gain: float, pole: float, exponent: float) -> None:
    plant = Plant(gain, pole)
    ours = servo_gains(plant.discretise(PERIOD_S), 10.0**exponent)
    theirs = dlqr(plant, 10.0**exponent)
    assert [ours.f11, ours.f12, -ours.f22] == pytest.approx(theirs, rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("ratio", [5.0e-5, 5.0e-3])
def test_gains_of_the_examples_to_nine_digits(ratio: float) -> None:
    ours = servo_gains(PLANT, ratio)
    assert [ours.f11, ours.f12, -ours.f22] == pytest.approx(dlqr(Plant(180.0, 14.0), ratio), rel=1e-9, abs=1e-12)


@settings(max_examples=40)
@given(gain=st.floats(1.0, 1e3), pole=st.floats(0.5, 100.0), exponent=st.floats(-6.0, 0.0))
def test_the_incremental_loop_is_stable(gain: float, pole: float, exponent: float) -> None:
    sampled = Plant(gain, pole).discretise(PERIOD_S)
    gains = servo_gains(sampled, 10.0**exponent)
    state, effort = incremental_model(sampled)
    feedback = np.array([[gains.f11, gains.f12, -gains.f22]])
    assert np.max(np.abs(np.linalg.eigvals(state - effort @ feedback))) < 1.0


def test_a_plant_turned_round_turns_the_gains_round() -> None:
    ours = servo_gains(Plant(180.0, 14.0).discretise(PERIOD_S), 5e-5)
    turned = servo_gains(Plant(-180.0, 14.0).discretise(PERIOD_S), 5e-5)
    assert [turned.f11, turned.f12, turned.f22] == pytest.approx([-ours.f11, -ours.f12, -ours.f22], rel=1e-9)
    assert turned.changeover_time_s(PERIOD_S) == pytest.approx(ours.changeover_time_s(PERIOD_S))


def test_changeover_time_is_equation_19() -> None:
    assert ServoGains(f11=0.4, f12=0.02, f22=0.008).changeover_time_s(0.01) == pytest.approx(0.5)


@pytest.mark.parametrize("ratio", [0.0, -1.0, float("nan")])
def test_an_impossible_ratio_is_refused(ratio: float) -> None:
    with pytest.raises(ValueError, match="performance index ratio"):
        servo_gains(PLANT, ratio)
