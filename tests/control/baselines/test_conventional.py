"""The conventional law of section III against its matrices, its hand-over by hand, and what a load does to it."""

import math
from dataclasses import dataclass

import control
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.control.baselines.rig import MODEL, PERIOD_S, QUICK, SAMPLED, SLOW, Axis
from twostage_servo.control.baselines.conventional import ConventionalTwoStage
from twostage_servo.control.baselines.velocity import Differentiator, speed_sensor
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.optimal import ServoGains, servo_gains
from twostage_servo.control.plant import Plant

Matrix = NDArray[np.float64]
plants = st.builds(Plant, gain=st.floats(50.0, 500.0), pole=st.floats(5.0, 40.0))
exponents = st.floats(-5.0, -2.0)
velocities = st.floats(5.0, 250.0)
signs = st.sampled_from([1.0, -1.0])
CRUISES = [(SLOW, 100.0, 400.0), (QUICK, 100.0, 400.0), (SLOW, 250.0, -1234.5), (QUICK, 40.0, -77.7)]


@dataclass
class Move:
    """A run of the law, and what it made of it; `changeover` is the k of (15)-(18), whose effort is still of (14)."""

    law: ConventionalTwoStage
    position: Matrix
    velocity: Matrix
    effort: Matrix
    law_velocity: list[float]
    changeover: int | None


def move(
    gains: ServoGains,
    target: float,
    velocity: float,
    ticks: int,
    *,
    model: Plant = MODEL,
    true: Plant | None = None,
    load: float = 0.0,
    difference_gain: float = 0.0,
    sum_as_printed: bool = False,
) -> Move:
    axis = Axis(true or model, load)
    law = ConventionalTwoStage(
        model.discretise(PERIOD_S),
        gains,
        speed_sensor(lambda: axis.velocity),
        difference_gain=difference_gain,
        sum_as_printed=sum_as_printed,
    )
    law.set_target(target, velocity)
    rows, law_velocity, changeover = [], [], None
    for k in range(ticks):
        rows.append(axis.drive(law, 1)[:, 0])
        law_velocity.append(law.velocity)
        if law.stage is Stage.POSITION and changeover is None:
            changeover = k
    position, velocities_, effort = np.array(rows).T
    return Move(law, position, velocities_, effort, law_velocity, changeover)


def entries(plant: Plant) -> tuple[Matrix, Matrix]:
    """A and B of equation (1) by python-control."""
    sampled = control.c2d(
        control.ss([[0.0, 1.0], [0.0, -plant.pole]], [[0.0], [plant.gain]], np.eye(2), 0.0), PERIOD_S, "zoh"
    )
    return np.asarray(sampled.A), np.asarray(sampled.B)


def speed_stage(plant: Plant, gains: ServoGains, reference: float, ticks: int) -> tuple[Matrix, Matrix, Matrix]:
    """Equation (14) closed round the plant: [x1, x2, I] and u, for a step of v; rows of position, velocity and sum."""
    a, b = entries(plant)
    feedback = np.array([[0.0, gains.f12]])
    loop_a = np.block([[a - b @ feedback, b], [np.array([[0.0, -gains.f22, 1.0]])]])
    loop = control.ss(loop_a, np.array([[0.0], [0.0], [gains.f22]]), np.eye(3), 0.0, PERIOD_S)
    states = np.asarray(
        control.forced_response(loop, PERIOD_S * np.arange(ticks), np.full(ticks, reference)).outputs
    ).reshape(3, ticks)
    return states[0], states[1], states[2]


@settings(max_examples=40)
@given(plant=plants, exponent=exponents, velocity=velocities, sign=signs)
def test_the_speed_stage_is_its_matrices_and_ends_with_the_first_sample_within_p(
    plant: Plant, exponent: float, velocity: float, sign: float
) -> None:
    gains = servo_gains(plant.discretise(PERIOD_S), 10.0**exponent)
    p = gains.f11 * velocity * PERIOD_S / gains.f22
    target = sign * (2.3 * p + 40.0 * velocity * PERIOD_S)
    ticks = 2 * round(abs(target) / velocity / PERIOD_S)
    position, speed, total = speed_stage(plant, gains, sign * velocity, ticks)
    remaining = sign * (target - position)
    assume(np.min(np.abs(remaining - p)) > 1e-6 * p)
    last = int(np.argmax(remaining <= p))  # the tick k of (15) and (18), whose effort is still the speed stage's
    assert last > 0
    ours = move(gains, target, velocity, last + 2, model=plant)
    assert ours.changeover == last
    assert ours.law.changeovers == 1
    scale = velocity * plant.pole / plant.gain
    np.testing.assert_allclose(ours.position[: last + 1], position[: last + 1], atol=1e-8 * abs(target))
    np.testing.assert_allclose(ours.velocity[: last + 1], speed[: last + 1], atol=1e-8 * velocity)
    expected = total - gains.f12 * speed
    np.testing.assert_allclose(ours.effort[: last + 1], expected[: last + 1], atol=1e-8 * scale)


@pytest.mark.parametrize("sum_as_printed", [False, True])
@pytest.mark.parametrize(("gains", "velocity", "target"), CRUISES)
def test_the_model_starts_one_tick_of_way_on_at_the_reference_velocity(
    gains: ServoGains, velocity: float, target: float, *, sum_as_printed: bool
) -> None:
    """Equations (15)-(17); the true plant is another, so that its own velocity cannot be mistaken for v."""
    true = Plant(234.0, 9.8)
    run = move(gains, target, velocity, 3000, true=true, sum_as_printed=sum_as_printed)
    assert run.changeover is not None
    k, v = run.changeover, math.copysign(velocity, target)
    total = run.effort[k] + gains.f12 * run.velocity[k]  # u = I - f12 x2
    if not sum_as_printed:
        total += gains.f22 * (target - run.position[k])
    assert run.law_velocity[k] == run.velocity[k]
    assert run.law_velocity[k + 1] == v
    assert run.effort[k + 1] == pytest.approx(total - gains.f11 * v * PERIOD_S - gains.f12 * v, rel=1e-9)


@pytest.mark.parametrize("feeds_difference", [False, True])
@pytest.mark.parametrize(("gains", "velocity", "target"), CRUISES)
def test_the_position_stage_is_its_matrices(
    gains: ServoGains, velocity: float, target: float, *, feeds_difference: bool
) -> None:
    """Plant, model and sum in one matrix, [x1, x2, xm1, xm2, I] and a 1 for the set-point and the anchor."""
    true = Plant(234.0, 9.8)
    difference_gain = gains.f11 if feeds_difference else 0.0
    run = move(gains, target, velocity, 4000, true=true, load=0.5, difference_gain=difference_gain)
    assert run.changeover is not None
    k = run.changeover
    anchor, v = run.position[k], math.copysign(velocity, target)
    (a, b), (a_m, b_m) = entries(true), entries(MODEL)
    g = difference_gain
    effort = np.array([[-g, 0.0, g - gains.f11, -gains.f12, 1.0, g * anchor]])
    matrix = np.zeros((6, 6))
    matrix[:2, :2], matrix[:2, 5:] = a, -0.5 * b
    matrix[2:4, 2:4] = a_m
    matrix[4, [0, 4, 5]] = -gains.f22, 1.0, gains.f22 * target
    matrix[5, 5] = 1.0
    matrix[:4] += np.vstack([b, b_m]) @ effort
    total = run.effort[k] + gains.f12 * run.velocity[k] + gains.f22 * (target - run.position[k])
    state = np.array([run.position[k + 1], run.velocity[k + 1], v * PERIOD_S, v, total, 1.0])
    for at in range(k + 1, min(k + 1001, 4000)):
        assert run.position[at] == pytest.approx(state[0], abs=1e-7 * abs(target))
        assert run.effort[at] == pytest.approx((effort @ state).item(), abs=1e-7)
        assert run.law_velocity[at] == pytest.approx(state[3], abs=1e-7 * velocity)
        state = matrix @ state


@settings(max_examples=20)
@given(plant=plants, exponent=exponents, velocity=velocities, share=st.floats(-0.99, 0.99))
def test_a_move_shorter_than_p_is_the_position_stages_from_rest(
    plant: Plant, exponent: float, velocity: float, share: float
) -> None:
    """The model then rests with the plant and stays with it: what remains is the incremental loop of section II."""
    gains = servo_gains(plant.discretise(PERIOD_S), 10.0**exponent)
    target = share * velocity * gains.f11 * PERIOD_S / gains.f22
    a, b = entries(plant)
    a_p = np.block([[a, np.zeros((2, 1))], [np.array([[-1.0, 0.0, 1.0]])]])
    loop = a_p - np.vstack([b, [[0.0]]]) @ np.array([[gains.f11, gains.f12, -gains.f22]])
    run = move(gains, target, velocity, 150, model=plant)
    assert (run.changeover, run.law.changeovers) == (0, 0)  # there was no speed stage to change from
    state, position = np.array([0.0, 0.0, target]), 0.0  # [dx1, dx2, e(k-1)] at k = 1
    for k in range(1, 150):
        position += state[0]
        assert run.position[k] == pytest.approx(position, abs=1e-8 * (1.0 + abs(target)))
        state = loop @ state


@settings(max_examples=30)
@given(exponent=exponents, velocity=velocities, cruise=st.floats(1.0, 2.0), sign=signs)
def test_out_of_a_steady_cruise_the_effort_goes_on_without_a_step(
    exponent: float, velocity: float, cruise: float, sign: float
) -> None:
    """By hand: the step is ``f22 (e(k) - p)``, and e(k) is at most v T_s short of p. As printed it is -f11 v T_s."""
    gains = servo_gains(SAMPLED, 10.0**exponent)
    time_s = gains.f11 * PERIOD_S / gains.f22
    target = sign * velocity * (time_s + cruise * 8.0)  # 8 s and more: nothing is left of the start
    ticks = round(abs(target) / velocity / PERIOD_S)
    steps = {}
    for printed in (False, True):
        run = move(gains, target, velocity, ticks, sum_as_printed=printed)
        assert run.changeover is not None
        steps[printed] = sign * float(run.effort[run.changeover + 1] - run.effort[run.changeover])
    assert -gains.f22 * velocity * PERIOD_S - 1e-6 <= steps[False] <= 1e-6
    assert steps[True] == pytest.approx(-gains.f11 * velocity * PERIOD_S, rel=1e-6)


def ticks_to_settle(plant: Plant, gains: ServoGains) -> int:
    """Until the slowest of the design's poles, and of the difference between plant and model, has died away."""
    a, b = entries(plant)
    a_p = np.block([[a, np.zeros((2, 1))], [np.array([[-1.0, 0.0, 1.0]])]])
    loop = a_p - np.vstack([b, [[0.0]]]) @ np.array([[gains.f11, gains.f12, -gains.f22]])
    slowest = max(float(np.max(np.abs(np.linalg.eigvals(loop)))), float(a[1, 1]))
    return math.ceil(math.log(1e-8) / math.log(slowest)) + 200


@settings(max_examples=25)
@given(plant=plants, exponent=exponents, load=st.floats(-3.0, 3.0), moves=st.floats(-3.0, 3.0))
def test_a_load_leaves_the_error_of_the_running_model(plant: Plant, exponent: float, load: float, moves: float) -> None:
    """The effort that balances the load runs the model at ``load gain / pole`` for ever, and the sum runs after it."""
    gains = servo_gains(plant.discretise(PERIOD_S), 10.0**exponent)
    time_s = gains.f11 * PERIOD_S / gains.f22
    ticks = ticks_to_settle(plant, gains) + 2 * round((abs(moves) + 1.0) * time_s / PERIOD_S)
    assume(ticks < 6000)
    target = moves * 100.0 * time_s
    run = move(gains, target, 100.0, ticks, model=plant, load=load)
    runs_at = load * plant.gain / plant.pole
    tolerance = 1e-4 * (1.0 + abs(target))
    assert run.position[-1] - target == pytest.approx(-gains.f11 * runs_at * PERIOD_S / gains.f22, abs=tolerance)
    assert run.law_velocity[-1] == pytest.approx(runs_at, abs=tolerance)


@settings(max_examples=25)
@given(plant=plants, exponent=exponents, load=st.floats(-3.0, 3.0), moves=st.floats(-3.0, 3.0))
def test_with_the_difference_fed_back_a_load_leaves_no_error(
    plant: Plant, exponent: float, load: float, moves: float
) -> None:
    gains = servo_gains(plant.discretise(PERIOD_S), 10.0**exponent)
    time_s = gains.f11 * PERIOD_S / gains.f22
    ticks = ticks_to_settle(plant, gains) + 2 * round((abs(moves) + 1.0) * time_s / PERIOD_S)
    assume(ticks < 6000)
    target = moves * 100.0 * time_s
    run = move(gains, target, 100.0, ticks, model=plant, load=load, difference_gain=gains.f11)
    assert run.position[-1] == pytest.approx(target, abs=1e-4 * (1.0 + abs(target)))


def test_the_one_output_form_has_the_difference_of_two_samples_for_its_velocity() -> None:
    axis = Axis()
    law = ConventionalTwoStage(SAMPLED, SLOW, Differentiator(PERIOD_S))
    law.set_target(4000.0, 100.0)
    position, _, effort = axis.drive(law, 300)
    a, b = entries(MODEL)
    matrix = np.zeros((5, 5))  # [x1, x2, x1 before, I, 1]
    difference = np.array([1.0, 0.0, -1.0, 0.0, 0.0]) / PERIOD_S
    row = np.array([0.0, 0.0, 0.0, 1.0, 0.0]) - SLOW.f12 * difference
    matrix[:2, :2] = a
    matrix[:2] += b @ row[None, :]
    matrix[2, 0] = matrix[3, 3] = matrix[4, 4] = 1.0
    matrix[3] += SLOW.f22 * (np.array([0.0, 0.0, 0.0, 0.0, 100.0]) - difference)
    state = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    for k in range(300):
        assert position[k] == pytest.approx(state[0], abs=1e-7)
        assert effort[k] == pytest.approx(row @ state, abs=1e-7)
        state = matrix @ state


def test_a_differentiated_sample_carries_twice_its_variance_per_period_squared() -> None:
    """The variance of a sample variance of differences is 3 / N of its square (Bartlett, correlation -1/2)."""
    deviation, count = 0.03, 100_000
    samples = np.random.default_rng(5).normal(0.0, deviation, count + 1)
    differentiate = Differentiator(PERIOD_S)
    assert differentiate(12.5) == 0.0  # there is nothing before the first sample
    differences = [differentiate(sample) for sample in samples.tolist()][1:]
    theory = 2.0 * deviation**2 / PERIOD_S**2
    assert np.var(differences) == pytest.approx(theory, rel=4.0 * math.sqrt(3.0 / count))


@given(slope=st.floats(-1e3, 1e3), start=st.floats(-1e3, 1e3))
def test_a_constant_velocity_is_differentiated_exactly(slope: float, start: float) -> None:
    differentiate = Differentiator(PERIOD_S)
    differentiate(start)
    assert differentiate(start + slope * PERIOD_S) == pytest.approx(slope, abs=1e-9)
