"""The hypotheses of the test of the model: which plants and encoders they are, and what their observers assume."""

import pytest

from twostage_servo.control.model_monitor.hypotheses import (
    ACCEPTED,
    CHANGE_FACTORS,
    OTHER_GAINS,
    LateEffort,
    deviating,
    slow_observer,
)
from twostage_servo.control.observer import NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

PLANT = Plant(180.0, 14.0)


def test_the_model_comes_first_and_each_accepted_plant_comes_with_a_later_effort_as_well() -> None:
    plants = [(1.0, 1.0), (0.7, 1.0), (1.3, 1.0), (1.0, 0.7), (1.0, 1.3), (1.3, 0.7)]
    assert list(ACCEPTED) == [(*plant, is_delayed) for is_delayed in (False, True) for plant in plants]


def test_other_gains_are_another_sign_and_a_factor_of_two_or_more_on_plants_whose_effort_is_in_time() -> None:
    assert [(other.factor, *other.plant, other.evidence) for other in OTHER_GAINS] == [
        (-1.0, 1.0, 1.0, False, 8.0), (-1.0, 1.3, 0.7, False, 8.0), (-1.0, 0.7, 1.0, False, 8.0),
        (0.3, 1.0, 1.0, False, 5.0), (0.45, 1.0, 1.0, False, 5.0), (0.5, 1.0, 1.0, False, 30.0),
        (2.0, 1.0, 1.0, False, 8.0), (2.2, 1.0, 1.0, False, 5.0),
    ]  # fmt: skip
    assert CHANGE_FACTORS == (-1.0, 0.0, 0.5, 2.0)


def test_gain_and_pole_are_multiples_of_the_models_and_the_encoder_scales_the_gain_alone() -> None:
    assert deviating(PLANT, ACCEPTED[5]) == Plant(1.3 * 180.0, 0.7 * 14.0)
    assert deviating(PLANT, ACCEPTED[5], -2.0) == Plant(-2.0 * 1.3 * 180.0, 0.7 * 14.0)


@pytest.mark.parametrize(("period_s", "share"), [(0.001, 0.01), (0.002, 0.02), (0.01, 0.1), (0.02, 0.1)])
def test_an_observer_assumes_a_tenth_of_the_process_variances_and_less_on_a_shorter_tick(
    period_s: float, share: float
) -> None:
    """A sample of 1 where 0 was expected leaves the gain itself as the estimate."""
    noise = NoiseModel((0.1, 0.2, 0.4), 0.03, disturbance_memory=0.5)
    slower = NoiseModel((share * 0.1, share * 0.2, share * 0.4), 0.03, disturbance_memory=0.5)
    observer = slow_observer(PLANT, period_s, noise)
    observer.update(1.0, 0.0)
    gain = kalman_gain(PLANT.discretise(period_s), slower).predictor
    assert (observer.position, observer.velocity, observer.disturbance) == pytest.approx(gain)
    observer.predict(0.0)
    assert observer.disturbance == pytest.approx(0.5 * gain[2])


@pytest.mark.parametrize(("period_s", "acting"), [(0.003, [7.0, 7.0, 1.0, 2.0]), (0.004, [7.0, 1.0, 2.0, 3.0])])
def test_a_late_effort_is_as_many_whole_ticks_late_as_come_nearest_to_5_ms(
    period_s: float, acting: list[float]
) -> None:
    late = LateEffort(period_s)
    late.start(7.0)
    assert [late.delay(effort) for effort in (1.0, 2.0, 3.0, 4.0)] == acting


def test_of_a_longer_tick_the_late_effort_takes_the_last_10_ms() -> None:
    late = LateEffort(0.04)
    late.start(8.0)
    assert [late.delay(effort) for effort in (0.0, 0.0, 4.0)] == [2.0, 0.0, 3.0]
