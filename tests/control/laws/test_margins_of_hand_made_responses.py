"""Margins at the edges: responses whose crossings are known by hand, loops that are nearly or really unstable."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.margins import Margins, _gain_margins, _phase_margins
from twostage_servo.control.laws.paper_margins import closed_loop_poles, controller, loop_margins
from twostage_servo.control.observer import NoiseModel, kalman_gain
from twostage_servo.control.optimal import servo_gains
from twostage_servo.control.plant import DiscretePlant, Plant

PLANT = Plant(180.0, 14.0).discretise(0.01)
NOISE = NoiseModel()
KALMAN = kalman_gain(PLANT, NOISE)
GAINS = servo_gains(PLANT, 5e-3)


def times(factor: float) -> DiscretePlant:
    return DiscretePlant(PLANT.period_s, PLANT.a12, PLANT.a22, factor * PLANT.b1, factor * PLANT.b2)


def degrees(*values: float) -> NDArray[np.float64]:
    return np.array([math.radians(value) for value in values])


@pytest.mark.parametrize("turns", [0.0, -1.0])
def test_a_phase_that_rises_through_180_degrees_counts_as_well(turns: float) -> None:
    """From -190 to -170 degrees between the last two points, 0.5 in the middle: half the gain is missing."""
    phase = degrees(-200.0, -190.0, -170.0) + turns * 2.0 * np.pi
    assert _gain_margins(np.array([0.3, 0.4, 0.625]), phase) == pytest.approx((2.0, 0.0))


def test_between_two_points_the_magnitude_is_interpolated_by_its_logarithm() -> None:
    """At a quarter of the way from 0.2 to 0.6 it is ``0.2 * 3**0.25``."""
    upper, lower = _gain_margins(np.array([0.1, 0.2, 0.6]), degrees(-100.0, -179.0, -183.0))
    assert upper == pytest.approx(5.0 / 3.0**0.25)
    assert lower == 0.0


def test_of_several_crossings_the_nearest_to_1_on_either_side_counts() -> None:
    """Crossings at magnitudes 4, 2, 0.5, 0.25: factors 0.25, 0.5, 2 and 4."""
    phase = degrees(-170.0, -190.0, -170.0, -190.0, -170.0)
    magnitude = np.array([8.0, 2.0, 2.0, 0.125, 0.5])
    assert _gain_margins(magnitude, phase) == pytest.approx((2.0, 0.5))


def test_a_response_that_never_meets_180_degrees_has_no_gain_margin() -> None:
    assert _gain_margins(np.array([2.0, 1.0, 0.5]), degrees(-90.0, -100.0, -110.0)) == (math.inf, 0.0)


def test_the_least_phase_counts_in_both_directions_and_the_least_delay_in_one() -> None:
    """Gain 1 is passed at 0.2 with -190 degrees, 10 short from above, and at 0.4 with -120, 60 before -180.

    A delay only takes phase away: 350 degrees at 0.2, or 60 degrees at 0.4, which is sooner.
    """
    margin, delay = _phase_margins(np.array([2.0, 0.5, 2.0]), degrees(-190.0, -190.0, -50.0), np.array([0.1, 0.3, 0.5]))
    assert math.degrees(margin) == pytest.approx(10.0)
    assert delay == pytest.approx(math.radians(60.0) / 0.4)


def test_a_gain_that_never_passes_1_can_wait_for_ever() -> None:
    both = _phase_margins(np.array([0.5, 0.4, 0.3]), degrees(-10.0, -100.0, -190.0), np.array([0.1, 0.2, 0.3]))
    assert both == (math.inf, math.inf)


def test_with_two_thirds_of_its_gain_margin_used_up_a_loop_has_a_factor_of_one_and_a_half_left() -> None:
    nominal = loop_margins(PLANT, GAINS, KALMAN, NOISE, Stage.POSITION)
    margins = loop_margins(PLANT, GAINS, KALMAN, NOISE, Stage.POSITION, times(nominal.gain_margin / 1.5))
    assert margins.gain_margin == pytest.approx(1.5, rel=1e-4)
    assert margins.gain_reduction_margin == 0.0


def test_a_loop_beyond_its_gain_margin_does_not_become_stable_by_more() -> None:
    nominal = loop_margins(PLANT, GAINS, KALMAN, NOISE, Stage.POSITION)
    margins = loop_margins(PLANT, GAINS, KALMAN, NOISE, Stage.POSITION, times(2.0 * nominal.gain_margin))
    assert margins.gain_margin == math.inf
    assert margins.gain_reduction_margin == pytest.approx(0.5, rel=1e-4)


@pytest.mark.parametrize("stage", [Stage.SPEED, Stage.BRAKE])
def test_only_the_pole_of_the_position_is_left_out_even_of_an_unstable_loop(stage: Stage) -> None:
    """A drive mounted the other way round feeds back positively: a real pole runs off beyond 1."""
    reversed_plant = times(-1.0)
    a_c, b_c, c_c = controller(PLANT, GAINS, KALMAN, NOISE, stage)
    a_p = np.array([[1.0, PLANT.a12], [0.0, PLANT.a22]])
    b_p = -np.array([[PLANT.b1], [PLANT.b2]])
    whole = np.linalg.eigvals(np.block([[a_p, b_p @ c_c], [b_c @ np.array([[1.0, 0.0]]), a_c]]))
    poles = closed_loop_poles(PLANT, GAINS, KALMAN, NOISE, stage, reversed_plant)
    assert max(map(abs, poles)) == pytest.approx(np.max(np.abs(whole)), rel=1e-9)
    assert max(map(abs, poles)) > 1.001
    assert len(poles) == len(whole) - 1


def test_the_poles_of_a_stop_are_what_is_left_of_the_speed_and_the_observers() -> None:
    """A stop takes three tenths of the velocity error away in a period: one pole at ``a22 - 0.3``."""
    estimator = np.array([[1.0, PLANT.a12, PLANT.b1], [0.0, PLANT.a22, PLANT.b2], [0.0, 0.0, 1.0]])
    estimator -= np.array(KALMAN.predictor).reshape(3, 1) @ np.array([[1.0, 0.0, 0.0]])
    expected = max(PLANT.a22 - 0.3, float(np.max(np.abs(np.linalg.eigvals(estimator)))))
    margins = loop_margins(PLANT, GAINS, KALMAN, NOISE, Stage.BRAKE)
    assert margins.spectral_radius == pytest.approx(expected, rel=1e-6)


def test_a_pole_on_the_unit_circle_is_not_inside_it() -> None:
    assert not Margins(2.0, 0.0, 60.0, 0.1, 0.5, spectral_radius=1.0).stable
