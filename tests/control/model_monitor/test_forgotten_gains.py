"""Each move is compared with other gains by itself: what the last braking showed says nothing of it."""

import pytest

from twostage_servo.control.model_monitor.hypotheses import OTHER_GAINS
from twostage_servo.control.model_monitor.monitor import ModelMonitor
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

PLANT, PERIOD_S = Plant(180.0, 14.0), 0.01
SAMPLED, NOISE = PLANT.discretise(PERIOD_S), NoiseModel()


class Axis:
    """The model's plant and its test, with an encoder that counts `scale` for one since it last changed."""

    def __init__(self) -> None:
        self.test = ModelMonitor(PLANT, PERIOD_S, NOISE)
        self.observer = DisturbanceObserver(SAMPLED, kalman_gain(SAMPLED, NOISE).predictor)
        self.position = self.velocity = self.shown = 0.0
        self.scale = 1.0
        self.test.start(self.observer)

    def go(self, effort: float, ticks: int) -> list[float | None]:
        told = []
        for _ in range(ticks):
            sample, before = self.shown, self.position
            self.position += SAMPLED.a12 * self.velocity + SAMPLED.b1 * effort
            self.velocity = SAMPLED.a22 * self.velocity + SAMPLED.b2 * effort
            self.shown += self.scale * (self.position - before)
            self.observer.update(sample, effort)
            self.test.update(sample, effort, self.observer, 100.0)
            told.append(self.test.better_factor)
        return told


def moved_and_braked() -> Axis:
    """Return an axis that has come to rest from 100 mm/s within five ticks, and has stood for 100 ms."""
    axis = Axis()
    assert set(axis.go(9.0, 60)) == {None}
    while axis.velocity > 0.0:
        axis.go(-min(12.0, 80.0 * axis.velocity), 1)
    axis.velocity = 0.0
    axis.go(0.0, 10)
    return axis


@pytest.mark.parametrize("scale", [0.3, 0.5, 2.0, 2.2])
def test_a_scale_that_changes_at_rest_is_told_sooner_where_the_braking_before_is_forgotten(scale: float) -> None:
    def ticks_until_told(*, forgotten: bool) -> int:
        axis = moved_and_braked()
        axis.scale = scale
        if forgotten:
            axis.test.forget_gains(axis.observer)
        told = axis.go(15.0, 100)
        return next((index for index, factor in enumerate(told) if factor is not None), len(told))

    assert ticks_until_told(forgotten=True) <= 12
    assert ticks_until_told(forgotten=True) <= ticks_until_told(forgotten=False)


def test_only_the_other_gains_are_forgotten() -> None:
    axis = moved_and_braked()
    test = axis.test
    surprise, accepted = test.surprise, [(one.position, one.velocity, one.disturbance) for one, _ in test._accepted]
    changes = [(change.own_sum, change.accepted_sum, change.ticks) for change in test._changes]
    test.forget_gains(axis.observer)
    assert test.surprise == surprise
    assert [(one.position, one.velocity, one.disturbance) for one, _ in test._accepted] == accepted
    assert [(change.own_sum, change.accepted_sum, change.ticks) for change in test._changes] == changes
    assert test._sums == [test._window.total] * len(OTHER_GAINS)
    for observer in test._gains:
        assert (observer.position, observer.velocity) == (axis.observer.position, axis.observer.velocity)
        assert observer.disturbance == axis.observer.disturbance


def test_on_a_healthy_axis_nothing_is_told_after_it() -> None:
    axis = moved_and_braked()
    for effort in (12.0, -12.0, 5.0):
        axis.test.forget_gains(axis.observer)
        assert set(axis.go(effort, 80)) == {None}
