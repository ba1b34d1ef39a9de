"""Gains in closed form against the eigenvalues that they are to give, and against python-control's own placement."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.control.laws.adaptive.placement import Pair, Poles, feedback_gains, observer_gain
from twostage_servo.control.observer import extended_model
from twostage_servo.control.plant import Plant

plants = st.builds(
    lambda gain, sign, pole, period_s: Plant(sign * gain, pole / period_s).discretise(period_s),
    st.floats(0.5, 5000.0), st.sampled_from((-1.0, 1.0)), st.floats(0.02, 1.0), st.sampled_from((0.001, 0.01, 0.02)),
)  # fmt: skip
pairs = st.builds(Pair, st.floats(0.05, 0.9), st.floats(-0.0025, 0.16))


def roots(pair: Pair) -> list[complex]:
    half = np.emath.sqrt(-pair.square)
    return [pair.real + half, pair.real - half]


def characteristic(poles: list[complex]) -> np.ndarray:
    return np.real(np.poly(poles))


@given(plants, st.floats(0.05, 0.9), pairs)
def test_the_observers_error_has_the_poles_that_were_asked_for(plant, single, pair) -> None:  # type: ignore[no-untyped-def]
    state, _, output = extended_model(plant, 1.0)
    gain = np.array(observer_gain(plant, single, pair)).reshape(3, 1)
    found = np.real(np.poly(state - gain @ output))
    assert found == pytest.approx(characteristic([single, *roots(pair)]), abs=1e-6)


@given(plants, pairs)
def test_the_feedback_has_the_poles_that_were_asked_for(plant, pair) -> None:  # type: ignore[no-untyped-def]
    state = np.array([[1.0, plant.a12], [0.0, plant.a22]])
    effort = np.array([[plant.b1], [plant.b2]])
    gains = np.array([feedback_gains(plant, pair)])
    assert np.real(np.poly(state - effort @ gains)) == pytest.approx(characteristic(roots(pair)), abs=1e-6)


def test_python_control_places_them_with_the_same_gains() -> None:
    plant = Plant(180.0, 14.0).discretise(0.01)
    state, _, output = extended_model(plant, 1.0)
    pair = Pair(0.9, 0.03)
    expected = control.place(state.T, output.T, [0.2, *roots(pair)]).T.ravel()
    assert observer_gain(plant, 0.2, pair) == pytest.approx(expected)
    state, effort = np.array([[1.0, plant.a12], [0.0, plant.a22]]), np.array([[plant.b1], [plant.b2]])
    assert feedback_gains(plant, pair) == pytest.approx(control.place(state, effort, roots(pair)).ravel())


@given(pairs, st.floats(0.2, 1.0))
def test_poles_to_a_power_are_the_powers_of_the_poles(pair: Pair, exponent: float) -> None:
    slower = Poles(0.3, pair, pair).slower(exponent)
    assert slower.single == pytest.approx(0.3**exponent)
    # A pole nearer to 0 than 0.02 counts as there.
    wanted = [pole if abs(pole) >= 0.02 or abs(np.imag(pole)) else 0.02 for pole in roots(pair)]
    powers = sorted((np.power(complex(pole), exponent) for pole in wanted), key=lambda pole: (pole.real, pole.imag))
    found = sorted((complex(pole) for pole in roots(slower.feedback)), key=lambda pole: (pole.real, pole.imag))
    assert found == pytest.approx(powers, abs=1e-9)
