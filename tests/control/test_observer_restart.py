"""What an observer knows when it starts afresh, against a plant that moves freely."""

import pytest

from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

PLANT = Plant(180.0, 14.0).discretise(0.01)


def one_that_has_seen_something() -> DisturbanceObserver:
    observer = DisturbanceObserver(PLANT, kalman_gain(PLANT, NoiseModel()).predictor)
    for sample in (0.0, 1.0, 3.0):
        observer.update(sample, 1.0)
    assert 0.0 not in {observer.position, observer.velocity, observer.disturbance, observer.innovation}
    return observer


def test_a_reset_leaves_an_axis_at_rest_that_nothing_has_surprised() -> None:
    observer = one_that_has_seen_something()
    observer.reset(7.0)
    assert (observer.position, observer.velocity, observer.disturbance, observer.innovation) == (7.0, 0.0, 0.0, 0.0)


def test_what_is_continued_from_another_has_not_been_surprised_itself() -> None:
    observer = one_that_has_seen_something()
    observer.continue_from(DisturbanceObserver(PLANT, NO_CORRECTION))
    assert (observer.position, observer.velocity, observer.disturbance, observer.innovation) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("periods", [1, 2, 9])
@pytest.mark.parametrize("speed", [100.0, -3.0])
def test_two_samples_of_a_free_motion_predict_the_third(speed: float, periods: int) -> None:
    """Without effort the plant goes on by ``a12 v`` and keeps ``a22`` of its speed in each period."""
    places = [50.0]
    for period in range(periods + 1):
        places.append(places[-1] + PLANT.a12 * PLANT.a22**period * speed)
    observer = one_that_has_seen_something()
    observer.start_moving(places[0], places[periods], periods)
    assert observer.position == pytest.approx(places[periods + 1], rel=1e-12)
    assert observer.velocity == pytest.approx(PLANT.a22 ** (periods + 1) * speed, rel=1e-9)
    assert (observer.disturbance, observer.innovation) == (0.0, 0.0)
