"""What the Kalman filter promises, measured: its covariance, white innovations, and where it puts the loop's poles."""

import control
import numpy as np
import pytest
from numpy.typing import NDArray

from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper_margins import closed_loop_poles
from twostage_servo.control.observer import NoiseModel, kalman_gain
from twostage_servo.control.optimal import servo_gains
from twostage_servo.control.plant import Plant

Matrix = NDArray[np.float64]
PERIOD_S = 0.01
MODEL = Plant(180.0, 14.0)
SAMPLED = MODEL.discretise(PERIOD_S)
TRUE = Plant(234.0, 9.8)
"""Example 2's: 30 % off in both parameters."""
SLOW, QUICK = 5e-5, 5e-3
OUTPUT = np.array([[1.0, 0.0, 0.0]])
RUNS, SETTLING, STEPS = 10_000, 150, 100


def plant_matrices(plant: Plant) -> tuple[Matrix, Matrix]:
    continuous = control.ss([[0.0, 1.0], [0.0, -plant.pole]], [[0.0], [plant.gain]], np.eye(2), 0.0)
    sampled = control.c2d(continuous, PERIOD_S, "zoh")
    return np.asarray(sampled.A), np.asarray(sampled.B)


def extended(memory: float) -> Matrix:
    """A_o of equation (25)."""
    a, b = plant_matrices(MODEL)
    return np.block([[a, b], [np.zeros((1, 2)), np.array([[memory]])]])


def solved(memory: float, measurement: float) -> tuple[Matrix, Matrix, Matrix]:
    """python-control's predictor gain, covariance of the one-step prediction, and poles."""
    gain, covariance, poles = control.dlqe(
        extended(memory), np.eye(3), OUTPUT, 0.1 * np.eye(3), np.array([[measurement]])
    )
    return np.asarray(gain), np.asarray(covariance), np.asarray(poles)


@pytest.mark.parametrize(("memory", "measurement"), [(1.0, 0.01), (0.0, 0.01), (1.0, 1.0)])
def test_the_filter_errs_as_its_riccati_equation_promises_and_leaves_white_innovations(
    memory: float, measurement: float
) -> None:
    """A million steps of the extended system and its filter, in parallel runs.

    Already one instant of 10,000 independent runs has a sample variance within 1.4 % (one standard deviation), 100
    correlated instants together are well within 1 %: 3 % is wide enough for every entry and seed.
    """
    a_o = extended(memory)
    gain = np.array(kalman_gain(SAMPLED, NoiseModel((0.1, 0.1, 0.1), measurement, memory)).predictor).reshape(3, 1)
    random = np.random.default_rng(7)
    state = np.zeros((3, RUNS))
    estimate = np.zeros((3, RUNS))
    squares, innovations = np.zeros((3, 3)), np.empty((STEPS, RUNS))
    for step in range(SETTLING + STEPS):
        error = state - estimate
        innovation = OUTPUT @ error + np.sqrt(measurement) * random.standard_normal((1, RUNS))
        if step >= SETTLING:
            squares += error @ error.T
            innovations[step - SETTLING] = innovation
        estimate = a_o @ estimate + gain @ innovation
        state = a_o @ state + np.sqrt(0.1) * random.standard_normal((3, RUNS))
    _, covariance, _ = solved(memory, measurement)
    deviations = np.sqrt(np.diag(covariance))
    # As correlations, so that each entry is judged by its own states' scale.
    sample = squares / (RUNS * STEPS) / np.outer(deviations, deviations)
    np.testing.assert_allclose(sample, covariance / np.outer(deviations, deviations), rtol=0.0, atol=0.03)
    variance = (OUTPUT @ covariance @ OUTPUT.T).item() + measurement
    count = innovations.size
    assert np.var(innovations) == pytest.approx(variance, rel=4.0 * np.sqrt(2.0 / count))
    for lag in (1, 2, 5):
        correlation = np.mean(innovations[lag:] * innovations[:-lag]) / variance
        assert abs(correlation) < 4.0 / np.sqrt(count - lag * RUNS)


def test_the_covariance_is_that_before_the_sample() -> None:
    """Or the test above would compare with another one: (28) with - X, by hand."""
    a_o = extended(1.0)
    gain, x, _ = solved(1.0, 0.01)
    innovation = OUTPUT @ x @ OUTPUT.T + 0.01
    taken_off = a_o @ x @ OUTPUT.T @ np.linalg.inv(innovation) @ OUTPUT @ x @ a_o.T
    np.testing.assert_allclose(a_o @ x @ a_o.T - taken_off + 0.1 * np.eye(3), x, rtol=1e-9)
    np.testing.assert_allclose(gain, a_o @ x @ OUTPUT.T / innovation, rtol=1e-9)


def loop_poles(ratio: float, noise: NoiseModel, stage: Stage, true: Plant) -> Matrix:
    """Sorted poles by the product."""
    poles = closed_loop_poles(
        SAMPLED, servo_gains(SAMPLED, ratio), kalman_gain(SAMPLED, noise), noise, stage, true.discretise(PERIOD_S)
    )
    return np.sort_complex(np.array(poles))


def speed_loop(ratio: float, noise: NoiseModel, true: Plant) -> Matrix:
    """Speed stage by hand, [x2, x_o1 - x1, x_o2, x_o3, I]: the position itself enters nowhere."""
    (a, b), (a_m, b_m) = plant_matrices(true), plant_matrices(MODEL)
    ours = servo_gains(SAMPLED, ratio)
    l1, l2, l3 = kalman_gain(SAMPLED, noise).predictor
    loop = np.zeros((5, 5))
    effort = np.array([0.0, 0.0, -ours.f12, 0.0, 1.0])
    speed, error, estimate, disturbance = np.eye(5)[:4]
    loop[0] = a[1, 1] * speed + b[1, 0] * effort
    model_push, true_push = effort + disturbance, effort
    # Innovation y - x_o1 = -error.
    loop[1] = (1.0 - l1) * error + a_m[0, 1] * estimate + b_m[0, 0] * model_push - a[0, 1] * speed - b[0, 0] * true_push
    loop[2] = a_m[1, 1] * estimate + b_m[1, 0] * model_push - l2 * error
    loop[3] = noise.disturbance_memory * disturbance - l3 * error
    loop[4] = np.eye(5)[4] - ours.f22 * estimate
    return loop


@pytest.mark.parametrize("memory", [0.0, 1.0])
@pytest.mark.parametrize("ratio", [SLOW, QUICK])
def test_the_poles_of_the_speed_stage_separate(ratio: float, memory: float) -> None:
    """On the plant as modelled: those of [x2, I] under f12 and f22, and those of the estimator."""
    a, b = plant_matrices(MODEL)
    gain, _, _ = control.dlqr(
        np.block([[a, np.zeros((2, 1))], [np.array([[-1.0, 0.0, 1.0]])]]),
        np.vstack([b, [[0.0]]]),
        ratio * np.diag([1.0, 0.0, 1.0]),
        np.eye(1),
    )
    _, f12, minus_f22 = np.asarray(gain)[0]
    servo = np.array([[a[1, 1] - b[1, 0] * f12, b[1, 0]], [minus_f22, 1.0]])
    _, _, estimator = solved(memory, 0.01)
    expected = np.sort_complex(np.concatenate([np.linalg.eigvals(servo), estimator]))
    ours = loop_poles(ratio, NoiseModel(disturbance_memory=memory), Stage.SPEED, MODEL)
    np.testing.assert_allclose(ours, expected, atol=1e-6)


@pytest.mark.parametrize(
    "noise",
    [NoiseModel(), NoiseModel(disturbance_memory=0.0), NoiseModel((0.0, 0.0, 0.1))],
    ids=["corrected", "erratum 5", "erratum 8"],
)
@pytest.mark.parametrize("ratio", [SLOW, QUICK])
def test_the_poles_on_a_plant_30_percent_off_are_those_of_the_loop_by_hand(ratio: float, noise: NoiseModel) -> None:
    by_hand = np.sort_complex(np.linalg.eigvals(speed_loop(ratio, noise, TRUE)))
    np.testing.assert_allclose(loop_poles(ratio, noise, Stage.SPEED, TRUE), by_hand, atol=1e-6)


def test_example_2_is_stable_as_corrected_and_unstable_with_a_variance_of_the_disturbance_alone() -> None:
    """Erratum 8: an observer that trusts its model cannot be told that the drive is another."""
    corrected, printed = (
        np.max(np.abs(np.linalg.eigvals(speed_loop(QUICK, noise, TRUE))))
        for noise in (NoiseModel(), NoiseModel((0.0, 0.0, 0.1)))
    )
    assert corrected < 0.95
    assert printed > 1.01
    for stage in Stage:
        assert np.max(np.abs(loop_poles(QUICK, NoiseModel(), stage, TRUE))) < 0.96


def test_without_memory_example_2_is_as_stable_but_cruises_at_the_wrong_speed() -> None:
    """Erratum 5: what goes without the third estimate is not damping but the steady state.

    With an input of v to the sum, ``x = loop x + [0, 0, 0, 0, f22 v]``: the estimate settles at v, the axis where the
    model's error lets it.
    """
    f22 = servo_gains(SAMPLED, QUICK).f22
    speeds = {}
    for memory in (0.0, 1.0):
        loop = speed_loop(QUICK, NoiseModel(disturbance_memory=memory), TRUE)
        assert np.max(np.abs(np.linalg.eigvals(loop))) < 0.95
        settled = np.linalg.solve(np.eye(5) - loop, np.array([0.0, 0.0, 0.0, 0.0, f22 * 100.0]))
        assert settled[2] == pytest.approx(100.0)
        speeds[memory] = settled[0]
    assert speeds[1.0] == pytest.approx(100.0)
    assert speeds[0.0] > 180.0
