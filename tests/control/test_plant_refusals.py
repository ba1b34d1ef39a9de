"""Plants and periods that are refused, each for one reason alone."""

import math

import pytest

from twostage_servo.control.plant import Plant


@pytest.mark.parametrize("period_s", [math.inf, -math.inf, math.nan, 0.0, -1e-9])
def test_a_period_is_finite_and_greater_than_0(period_s: float) -> None:
    with pytest.raises(ValueError, match="sampling period"):
        Plant(180.0, 14.0).discretise(period_s)
    assert Plant(180.0, 14.0).discretise(1e-9).period_s == 1e-9


@pytest.mark.parametrize("gain", [math.inf, -math.inf, math.nan, 0.0, -0.0])
def test_a_gain_is_finite_and_not_0(gain: float) -> None:
    with pytest.raises(ValueError, match="gain"):
        Plant(gain, 14.0)


@pytest.mark.parametrize("pole", [math.inf, math.nan, 0.0, -14.0])
def test_a_pole_is_finite_and_greater_than_0(pole: float) -> None:
    with pytest.raises(ValueError, match="pole"):
        Plant(180.0, pole)


@pytest.mark.parametrize(("gain", "pole"), [(-1e-6, 1e-6), (1.0, 0.5)])
def test_small_numbers_are_numbers_too(gain: float, pole: float) -> None:
    """A cruise at 3 takes the effort ``3 pole / gain``."""
    assert Plant(gain, pole).cruise_effort(3.0) == pytest.approx(3.0 * pole / gain)
