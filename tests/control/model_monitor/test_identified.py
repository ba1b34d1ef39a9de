"""A plant that a law has identified is accepted beside those that the model allows, and no other."""

from dataclasses import replace

import numpy as np
import pytest

from tests.control.model_monitor.test_thresholds import NOISE, PERIOD_S, PLANT, at_rest
from twostage_servo.control.model_monitor.hypotheses import slow_observer
from twostage_servo.control.model_monitor.identified_plant import slow_observer_like
from twostage_servo.control.model_monitor.monitor import ModelMonitor
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver
from twostage_servo.control.plant import DiscretePlant, Plant, Triple

WEAK = Plant(0.7 * PLANT.gain, 1.3 * PLANT.pole)


def error_poles(plant: DiscretePlant, gain: Triple, memory: float) -> list[complex]:
    state = np.array([[1.0, plant.a12, plant.b1], [0.0, plant.a22, plant.b2], [0.0, 0.0, memory]])
    poles = np.linalg.eigvals(state - np.outer(gain, [1.0, 0.0, 0.0]))
    return sorted((complex(pole) for pole in poles), key=lambda pole: (pole.real, pole.imag))


@pytest.mark.parametrize("memory", [1.0, 0.97])
@pytest.mark.parametrize("plant", [WEAK, Plant(1.6 * PLANT.gain, 0.5 * PLANT.pole), PLANT])
def test_its_observers_error_dies_down_as_the_models_does(plant: Plant, memory: float) -> None:
    noise = replace(NOISE, disturbance_memory=memory)
    model = slow_observer(PLANT, PERIOD_S, noise)
    found = slow_observer_like(model, plant.discretise(PERIOD_S), memory)
    assert error_poles(found.plant, found.gain, memory) == pytest.approx(
        error_poles(model.plant, model.gain, memory), abs=1e-6
    )


def watched(*, accepted: bool, is_late: bool = False, forgotten: bool = False) -> float:
    """Return the largest surprise, beside what decides, of a weak plant that cruises, brakes hard and rests."""
    axis = DisturbanceObserver(WEAK.discretise(PERIOD_S), NO_CORRECTION)
    monitor, model = ModelMonitor(PLANT, PERIOD_S, NOISE), at_rest()
    monitor.start(model)
    cruise = WEAK.cruise_effort(100.0)
    efforts = [20.0] * 8 + [cruise] * 200 + [-14.0] * 6 + [0.0] * 60
    largest, last = 0.0, 0.0
    for tick, effort in enumerate(efforts):
        sample = axis.position
        axis.predict(last if is_late else effort)
        model.update(sample, effort)
        monitor.update(sample, effort, model, abs(model.velocity))
        last = effort
        if tick == 20 and accepted:
            monitor.accept(WEAK, axis, is_late=is_late)
            if forgotten:
                monitor.forget_identified()
        if tick > 200:
            largest = max(largest, monitor.surprise / monitor.least)
    return largest


@pytest.mark.parametrize("is_late", [False, True])
def test_what_is_identified_is_no_surprise(*, is_late: bool) -> None:
    assert watched(accepted=True, is_late=is_late) < 0.05
    assert watched(accepted=False, is_late=is_late) > 0.5


def test_what_is_forgotten_is_accepted_no_more() -> None:
    assert watched(accepted=True, forgotten=True) == watched(accepted=False)


def test_a_reversal_is_told_of_an_identified_plant_as_well() -> None:
    axis = DisturbanceObserver(WEAK.discretise(PERIOD_S), NO_CORRECTION)
    axis.go_on_from(0.0, 100.0, 0.0)
    monitor, model = ModelMonitor(PLANT, PERIOD_S, NOISE), at_rest(100.0)
    effort = WEAK.cruise_effort(100.0)
    model.correct(100.0, PLANT.cruise_effort(100.0) - effort)
    monitor.start(model, effort)
    monitor.accept(WEAK, axis, is_late=False)
    place = 0.0
    for tick in range(60):
        sample = axis.position if tick < 50 else 2.0 * place - axis.position
        if tick < 50:
            place = axis.position
        axis.predict(effort)
        model.update(sample, effort)
        monitor.update(sample, effort, model, 100.0)
        if tick == 49:
            assert monitor.better_factor is None
    assert monitor.better_factor == -1.0


def test_an_identified_plant_moves_with_the_origin_and_begins_afresh_with_the_others() -> None:
    monitor, model = ModelMonitor(PLANT, PERIOD_S, NOISE), at_rest()
    monitor.start(model)
    monitor.accept(WEAK, model, is_late=False)
    monitor.shift(7.0)
    model.shift(7.0)
    for _ in range(5):
        monitor.predict(0.0)
        model.predict(0.0)
    monitor.update(7.0, 0.0, model, 0.0)
    assert monitor.surprise == 0.0
    moved = at_rest(50.0)
    moved.shift(7.0)
    monitor.start(moved)
    monitor.update(7.0, 0.0, moved, 50.0)
    assert monitor.surprise == pytest.approx(0.0, abs=1e-9)


def test_a_late_plant_begins_afresh_with_the_effort_that_has_acted() -> None:
    monitor, model = ModelMonitor(PLANT, PERIOD_S, NOISE), at_rest(90.0)
    effort = PLANT.cruise_effort(90.0)
    monitor.accept(PLANT, model, is_late=True)
    monitor.start(model, effort)
    hypothesis = monitor._identified
    sample = model.position
    model.predict(effort)
    assert hypothesis.update(sample, effort, 0.0) == pytest.approx(0.0, abs=1e-18)
    assert hypothesis.update(model.position, effort, 0.0) == pytest.approx(0.0, abs=1e-18)
