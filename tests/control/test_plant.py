"""The sampled plant against the matrix exponential, and against hand-computed numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from twostage_servo.control.plant import Plant


@given(
    gain=st.floats(-1e4, 1e4).filter(lambda gain: abs(gain) > 1e-3),
    pole=st.floats(1e-3, 1e3),
    period_s=st.floats(1e-4, 0.1),
)
def test_sampled_plant_is_the_matrix_exponential(gain: float, pole: float, period_s: float) -> None:
    sampled = Plant(gain, pole).discretise(period_s)
    continuous = np.array([[0.0, 1.0, 0.0], [0.0, -pole, gain], [0.0, 0.0, 0.0]])  # input appended as a constant state
    exact = expm(continuous * period_s)
    assert sampled.a12 == pytest.approx(exact[0, 1], rel=1e-9)
    assert sampled.a22 == pytest.approx(exact[1, 1], rel=1e-9, abs=1e-15)
    assert sampled.b1 == pytest.approx(exact[0, 2], rel=1e-6)  # T - a12 cancels when pole * period is small
    assert sampled.b2 == pytest.approx(exact[1, 2], rel=1e-9)


def test_the_papers_plant_by_hand() -> None:
    sampled = Plant(180.0, 14.0).discretise(0.01)
    assert sampled.a22 == pytest.approx(0.8693582354, abs=1e-10)  # exp(-0.14)
    assert sampled.a12 == pytest.approx(0.00933155461, abs=1e-11)  # (1 - exp(-0.14)) / 14
    assert sampled.b2 == pytest.approx(1.67967983, abs=1e-8)  # 180 a12
    assert sampled.b1 == pytest.approx(0.00859429782, abs=1e-10)  # 180/14 (0.01 - a12)


def test_cruise_effort_holds_a_constant_velocity() -> None:
    plant = Plant(180.0, 14.0)
    sampled = plant.discretise(0.01)
    effort = plant.cruise_effort(100.0)
    assert sampled.a22 * 100.0 + sampled.b2 * effort == pytest.approx(100.0, rel=1e-12)
    assert sampled.a12 * 100.0 + sampled.b1 * effort == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize(
    ("gain", "pole", "named"),
    [(0.0, 14.0, "gain"), (float("nan"), 14.0, "gain"), (180.0, 0.0, "pole"), (180.0, float("inf"), "pole")],
)
def test_an_impossible_plant_is_refused_by_name(gain: float, pole: float, named: str) -> None:
    with pytest.raises(ValueError, match=f"the plant's {named} is"):
        Plant(gain, pole)


@pytest.mark.parametrize("period_s", [0.0, -0.01, float("nan")])
def test_an_impossible_period_is_refused(period_s: float) -> None:
    with pytest.raises(ValueError, match="sampling period"):
        Plant(180.0, 14.0).discretise(period_s)
