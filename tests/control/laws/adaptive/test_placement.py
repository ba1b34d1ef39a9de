"""Gains in closed form against the eigenvalues that they are to give, and against python-control's own placement."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.linalg import solve_discrete_are

from twostage_servo.control.laws.adaptive.placement import Pair, Poles, feedback_gains, observer_gain
from twostage_servo.control.laws.adaptive.rules import NOISY_POLES, QUIET_POLES
from twostage_servo.control.observer import extended_model
from twostage_servo.control.plant import DiscretePlant, Plant

PLANT = Plant(180.0, 14.0).discretise(0.01)

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


@pytest.mark.parametrize("exponent", [0.4, 0.75, 1.0])
@pytest.mark.parametrize(("larger", "smaller"), [(0.7, 0.3), (0.9, 0.05), (0.5, 0.01), (0.5, -0.2)])
def test_real_poles_to_a_power_are_real(larger: float, smaller: float, exponent: float) -> None:
    """One below 0.02, or below 0, counts as 0.02."""
    pair = Pair(0.5 * (larger + smaller), -0.25 * (larger - smaller) ** 2).slower(exponent)
    half = (-pair.square) ** 0.5
    assert pair.real + half == pytest.approx(larger**exponent)
    assert pair.real - half == pytest.approx(max(smaller, 0.02) ** exponent)


# Kalman filters that have these poles ---------------------------------------------------------------------------------


def process_noise(plant: DiscretePlant, poles: Poles) -> tuple[list[float], float]:
    """Return the independent variances that would give the poles, and the least of N on the unit circle.

    Both over the measurement variance; N is ``s D_o(z) D_o(1/z) - D(z) D(1/z)`` of docs/adaptive-law.md. Its terms in
    z³ cancel, and each state's noise contributes ``|C adj(zI - A_o) e_i|²``: three equations for three variances.
    """
    a12, a22, b1, b2 = plant.a12, plant.a22, plant.b1, plant.b2
    pair = poles.observer
    closed = np.polymul([1.0, -poles.single], [1.0, -2.0 * pair.real, pair.real**2 + pair.square])
    opened = np.polymul([1.0, -2.0, 1.0], [1.0, -a22])
    scale = opened[-1] / closed[-1]

    def spectrum(polynomial: ArrayLike) -> list[float]:
        polynomial = np.asarray(polynomial)
        return [float(np.dot(polynomial[lag:], polynomial[: len(polynomial) - lag])) for lag in range(3)]

    needed = [scale * own - free for own, free in zip(spectrum(closed), spectrum(opened), strict=True)]
    numerators = (
        np.polymul([1.0, -1.0], [1.0, -a22]),
        np.array([0.0, a12, -a12]),
        np.array([0.0, b1, a12 * b2 - b1 * a22]),
    )
    variances = np.linalg.solve(np.array([spectrum(one) for one in numerators]).T, needed)
    circle = np.exp(1j * np.linspace(0.0, np.pi, 20_001))
    least = np.min(scale * abs(np.polyval(closed, circle)) ** 2 - abs(np.polyval(opened, circle)) ** 2)
    return [float(value) for value in variances], float(least)


def test_the_poles_of_a_noisy_encoder_are_those_of_a_kalman_filter_with_independent_noises() -> None:
    variances, _ = process_noise(PLANT, NOISY_POLES)
    assert variances == pytest.approx([8.92e-3, 63.1, 0.621], rel=1e-3)  # as the documentation says
    transition, _, measured = extended_model(PLANT, 1.0)
    covariance = solve_discrete_are(transition.T, measured.T, np.diag(variances), np.eye(1))
    gain = transition @ covariance @ measured.T / (measured @ covariance @ measured.T + 1.0)
    assert gain.ravel() == pytest.approx(observer_gain(PLANT, NOISY_POLES.single, NOISY_POLES.observer), rel=1e-9)


@pytest.mark.parametrize("exponent", [1.0, 0.75, 0.4])
def test_those_of_a_quiet_one_take_correlated_noises(exponent: float) -> None:
    variances, least = process_noise(PLANT, QUIET_POLES.slower(exponent))
    assert min(variances) < 0.0 < least


def test_the_slower_ones_of_a_noisy_encoder_are_no_kalman_filters() -> None:
    _, least = process_noise(PLANT, NOISY_POLES.slower(0.4))
    assert least < 0.0
