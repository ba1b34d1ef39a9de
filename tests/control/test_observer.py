"""The Kalman disturbance observer against python-control, its matrices in numpy, and a plant to follow."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.control.observer import (
    NO_CORRECTION,
    DisturbanceObserver,
    NoiseModel,
    extended_model,
    kalman_gain,
)
from twostage_servo.control.plant import Plant

PLANT = Plant(180.0, 14.0).discretise(0.01)
NOISE = NoiseModel()


@pytest.mark.parametrize("memory", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("measurement", [1e-3, 1e-2, 1.0])
def test_kalman_gain_is_that_of_python_control(memory: float, measurement: float) -> None:
    noise = NoiseModel((0.1, 0.1, 0.1), measurement, memory)
    state, _, output = extended_model(PLANT, memory)
    theirs, _, _ = control.dlqe(state, np.eye(3), output, 0.1 * np.eye(3), np.array([[measurement]]))
    ours = kalman_gain(PLANT, noise)
    # python-control returns the predictor's gain A_o K.
    assert list(ours.predictor) == pytest.approx(list(np.asarray(theirs)[:, 0]), rel=1e-9, abs=1e-12)
    assert list(state @ np.array(ours.current)) == pytest.approx(list(ours.predictor), rel=1e-12)


def test_update_is_equation_26_in_matrices() -> None:
    state, effort, output = extended_model(PLANT, 1.0)
    gain = np.array(kalman_gain(PLANT, NOISE).predictor).reshape(3, 1)
    observer = DisturbanceObserver(PLANT, kalman_gain(PLANT, NOISE).predictor)
    estimate = np.zeros((3, 1))
    random = np.random.default_rng(3)
    for sample, command in random.normal(size=(200, 2)):
        estimate = state @ estimate + effort * command + gain * (sample - output @ estimate)
        observer.update(sample, command)
        assert [observer.position, observer.velocity, observer.disturbance] == pytest.approx(
            list(estimate[:, 0]), rel=1e-9, abs=1e-12
        )


@given(load=st.floats(-5.0, 5.0), start=st.floats(-1e3, 1e3), command=st.floats(-20.0, 20.0))
def test_a_constant_load_is_estimated_without_error(load: float, start: float, command: float) -> None:
    observer = DisturbanceObserver(PLANT, kalman_gain(PLANT, NOISE).predictor)
    observer.reset(start)
    position, velocity = start, 0.0
    for _ in range(600):
        observer.update(position, command)
        total = command + load
        position, velocity = (
            position + PLANT.a12 * velocity + PLANT.b1 * total,
            PLANT.a22 * velocity + PLANT.b2 * total,
        )
    assert observer.disturbance == pytest.approx(load, abs=1e-6)
    assert observer.velocity == pytest.approx(velocity, abs=1e-5)
    assert observer.position == pytest.approx(position, abs=1e-5)


def test_without_a_sample_the_estimate_follows_the_model() -> None:
    observer = DisturbanceObserver(PLANT, kalman_gain(PLANT, NOISE).predictor)
    model = DisturbanceObserver(PLANT, NO_CORRECTION)
    for _ in range(50):
        observer.predict(2.0)
        model.update(-1e6, 2.0)  # a model takes no notice of samples
    assert observer.position == model.position
    assert observer.velocity == model.velocity
    assert observer.position > 0.0


def test_continue_from_takes_the_whole_estimate() -> None:
    observer = DisturbanceObserver(PLANT, kalman_gain(PLANT, NOISE).predictor)
    for sample in (0.0, 1.0, 3.0):
        observer.update(sample, 1.0)
    model = DisturbanceObserver(PLANT, NO_CORRECTION)
    model.continue_from(observer)
    assert (model.position, model.velocity, model.disturbance) == (
        observer.position,
        observer.velocity,
        observer.disturbance,
    )


def test_variances_without_a_solution_are_refused_in_words() -> None:
    with pytest.raises(ValueError, match="never converges"):
        kalman_gain(PLANT, NoiseModel((0.0, 0.0, 0.0), 1.0, 1.0))
