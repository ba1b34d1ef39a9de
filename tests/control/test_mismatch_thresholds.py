"""When the test of models decides, at its documented thresholds on either side, and what it starts from."""

import pytest

from twostage_servo.control.mismatch import ModelTest
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01
PLANT = Plant(180.0, 14.0)
LIMIT = 2.0
"""A quarter of it, 0.5, is what a sign takes, and twice that, 1.0, what a scale takes."""


def surprised(innovation: float) -> DisturbanceObserver:
    """Return an observer at rest whose last sample was so far from its prediction."""
    model = DisturbanceObserver(PLANT.discretise(PERIOD_S), (0.0, 0.0, 0.0))
    model.innovation = innovation
    return model


def verdict(surprise: float, *sums: float) -> float | None:
    test = ModelTest(PLANT, PERIOD_S, NoiseModel())
    test.surprise, test._sum, test._sums, test._limit = surprise, surprise**2, list(sums), LIMIT
    return test.better_gain_factor


@pytest.mark.parametrize(
    ("surprise", "sums", "expected"),
    [
        (0.49, (0.0, 9.0, 9.0), None),
        (0.51, (0.0, 9.0, 9.0), -1.0),
        (0.51, (9.0, 0.0, 9.0), None),
        (0.99, (9.0, 0.0, 9.0), None),
        (1.01, (9.0, 0.0, 9.0), 0.45),
        (0.99, (9.0, 9.0, 0.0), None),
        (1.01, (9.0, 9.0, 0.0), 2.2),
    ],
)
def test_a_sign_is_told_at_a_quarter_of_the_limit_and_a_scale_at_half_of_it(
    surprise: float, sums: tuple[float, ...], expected: float | None
) -> None:
    assert verdict(surprise, *sums) == expected


@pytest.mark.parametrize(("best", "told"), [(0.49, True), (0.51, False)])
def test_another_model_has_to_be_eight_times_better(best: float, told: bool) -> None:
    assert verdict(2.0, best, 9.0, 9.0) == (-1.0 if told else None)
    assert verdict(2.0, 9.0, 9.0, best) == (2.2 if told else None)


def test_it_begins_without_evidence_for_anything() -> None:
    test = ModelTest(PLANT, PERIOD_S, NoiseModel())
    assert test.surprise == 0.0
    assert test.better_gain_factor is None
    # At rest and without effort no hypothesis is surprised; the model itself is, by 1.
    test.update(0.0, 0.0, surprised(1.0), LIMIT)
    assert test.surprise == 1.0
    assert test.better_gain_factor == -1.0


def test_another_origin_changes_no_evidence() -> None:
    """The same samples from another origin, in mid-motion: the sums go on as if nothing had happened."""
    here, there = ModelTest(PLANT, PERIOD_S, NoiseModel()), ModelTest(PLANT, PERIOD_S, NoiseModel())
    for n in range(60):
        if n == 30:
            there.shift(-500.0)
        sample = 0.02 * n * n
        here.update(sample, 5.0, surprised(1e3), LIMIT)  # so much that the mirrored motion is never begun anew
        there.update(sample - (500.0 if n >= 30 else 0.0), 5.0, surprised(1e3), LIMIT)
    assert min(*here._sums, here._mirrored_sum) > 1e-3
    assert there._sums == pytest.approx(here._sums, rel=1e-6)
    assert there._mirrored_sum == pytest.approx(here._mirrored_sum, rel=1e-6)


@pytest.mark.parametrize(("times_better", "told"), [(50.5, True), (49.5, False)])
def test_a_mirrored_motion_has_to_be_fifty_times_better(times_better: float, told: bool) -> None:
    test = ModelTest(PLANT, PERIOD_S, NoiseModel())
    test.surprise, test._sum, test._sums, test._limit = 2.0, 4.0, [9.0, 9.0, 9.0], LIMIT
    test._mirrored_ticks, test._sum_since, test._mirrored_sum = 3, times_better, 1.0
    assert test.better_gain_factor == (-1.0 if told else None)


def test_the_mirrored_motion_is_expected_anew_where_it_explains_no_more_than_the_model() -> None:
    test = ModelTest(PLANT, PERIOD_S, NoiseModel())
    for _ in range(5):
        test.update(0.0, 0.0, surprised(0.0), LIMIT)  # at rest neither is surprised
    assert test._mirrored_ticks == 0


def test_the_hypotheses_forget_a_disturbance_as_the_noise_model_says() -> None:
    noise = NoiseModel(disturbance_memory=0.5)
    test = ModelTest(PLANT, PERIOD_S, noise)
    reversed_plant = Plant(-180.0, 14.0).discretise(PERIOD_S)
    other = DisturbanceObserver(reversed_plant, kalman_gain(reversed_plant, noise).predictor, 0.5)
    expected = 0.0
    for n in range(20):
        test.update(0.1 * n, 1.0, surprised(1e3), LIMIT)
        other.update(0.1 * n, 1.0)
        expected = 0.93 * expected + other.innovation**2
    assert test._sums[0] == pytest.approx(expected, rel=1e-12)
    # Not begun anew, the mirrored motion is that of a plant with its gain reversed.
    assert test._mirrored_sum == pytest.approx(expected, rel=1e-12)
    assert test._sum_since == pytest.approx(1e6 * (1.0 - 0.93**20) / 0.07, rel=1e-12)
    assert test._mirrored_ticks == 20
