"""The baselines with parameters: what each claims on the plant of its model, and that it is linear as told."""

import random
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from math import exp, inf

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from tests.control.baselines.rig import MODEL, PERIOD_S, SAMPLED
from twostage_servo.control.baselines.active_disturbance_rejection import ACTIVE_DISTURBANCE_REJECTION
from twostage_servo.control.baselines.composite_nonlinear import COMPOSITE_NONLINEAR, CompositeNonlinearServo
from twostage_servo.control.baselines.initial_value import INITIAL_VALUE, InitialValueServo, sum_gains
from twostage_servo.control.baselines.profile_pid import PROFILE_PID
from twostage_servo.control.baselines.proximate_time_optimal import PROXIMATE_TIME_OPTIMAL, ProximateTimeOptimalServo
from twostage_servo.control.baselines.speed_stage import SpeedStage
from twostage_servo.control.baselines.state_feedback import Pair, feedback_gains, observer_gain
from twostage_servo.control.baselines.trapezoid import Trapezoid
from twostage_servo.control.baselines.tunable import TunableLaw, TunableLawType
from twostage_servo.control.laws.law import ControlTask
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, extended_model, kalman_gain
from twostage_servo.control.plant import Plant

LAWS = {
    "trapezoid": "TRAPEZOID",
    "jerk_limited": "JERK_LIMITED",
    "proximate_time_optimal": "PROXIMATE_TIME_OPTIMAL",
    "composite_nonlinear": "COMPOSITE_NONLINEAR",
    "initial_value": "INITIAL_VALUE",
    "active_disturbance_rejection": "ACTIVE_DISTURBANCE_REJECTION",
    "profile_pid": "PROFILE_PID",
    "optimal_two_stage": "OPTIMAL_TWO_STAGE",
}
EFFORT_LIMIT, EFFORT_RATE = 10.0, 1000.0


def task_of(plant: Plant = MODEL) -> ControlTask:
    sampled = plant.discretise(PERIOD_S)
    kalman = kalman_gain(sampled, NoiseModel())
    return ControlTask(plant, sampled, PERIOD_S, NoiseModel(), kalman, inf, 1e9, EFFORT_LIMIT, EFFORT_RATE, 0.0)


@pytest.fixture(params=LAWS)
def law_type(request: pytest.FixtureRequest) -> TunableLawType:
    if request.param == "jerk_limited":
        pytest.importorskip("ruckig")
    module = import_module(f"twostage_servo.control.baselines.{request.param}")
    found: TunableLawType = getattr(module, LAWS[request.param])
    return found


def drive(law: TunableLaw, ticks: int, load: float = 0.0, plant: Plant = MODEL) -> NDArray[np.float64]:
    """Close the loop with a sample that is a period old; return position and effort of each tick in two rows."""
    continuous = np.array([[0.0, 1.0, 0.0], [0.0, -plant.pole, plant.gain], [0.0, 0.0, 0.0]])
    (_, a12, b1), (_, a22, b2), _ = expm(continuous * PERIOD_S).tolist()
    position = velocity = sample = 0.0
    rows = []
    for _ in range(ticks):
        effort = law.step(sample)
        sample = position
        rows.append((position, effort))
        position, velocity = position + a12 * velocity + b1 * (effort - load), a22 * velocity + b2 * (effort - load)
    return np.array(rows).T


def test_it_settles_on_the_plant_of_its_model(law_type: TunableLawType) -> None:
    law = law_type.build(task_of(), law_type.start())
    law.set_target(100.0, 100.0)
    position, effort = drive(law, 400)
    assert np.all(np.abs(position[250:] - 100.0) < 0.1)
    assert position[-1] == pytest.approx(100.0, abs=1e-3)
    assert np.max(np.abs(effort)) <= EFFORT_LIMIT
    assert np.max(np.abs(np.diff(effort, prepend=0.0))) <= EFFORT_RATE * PERIOD_S + 1e-9
    assert np.max(np.diff(position)) / PERIOD_S <= 110.0


def test_it_uses_the_rate_of_the_effort_and_its_limit_and_no_more(law_type: TunableLawType) -> None:
    """9 V, 0.5 V in a tick: a cruise at 100 mm/s takes 7.8 V of them."""
    law = law_type.build(replace(task_of(), effort_limit=9.0, effort_rate_limit=50.0), law_type.start())
    law.set_target(100.0, 110.0)
    _, effort = drive(law, 100)
    assert np.max(np.abs(np.diff(effort, prepend=0.0))) == pytest.approx(0.5)
    assert np.max(np.abs(effort)) <= 9.0
    law.set_target(-100.0, 200.0)
    _, effort = drive(law, 100)
    assert np.max(np.abs(effort)) == 9.0


def test_no_load_leaves_a_steady_error(law_type: TunableLawType) -> None:
    law = law_type.build(task_of(), law_type.start())
    drive(law, 200, load=1.0)
    law.set_target(50.0, 100.0)
    position, effort = drive(law, 600, load=1.0)
    assert position[-1] == pytest.approx(50.0, abs=1e-3)
    assert effort[-1] == pytest.approx(1.0, abs=1e-3)


def test_the_way_back_is_the_way_there_mirrored(law_type: TunableLawType) -> None:
    there, back = (law_type.build(task_of(), law_type.start()) for _ in range(2))
    there.set_target(30.0, 80.0)
    back.set_target(-30.0, 80.0)
    assert np.array_equal(drive(there, 150), -drive(back, 150))


def test_a_negative_gain_mirrors_the_effort(law_type: TunableLawType) -> None:
    other = replace(MODEL, gain=-MODEL.gain)
    law, mirrored = (law_type.build(task_of(plant), law_type.start()) for plant in (MODEL, other))
    law.set_target(30.0, 80.0)
    mirrored.set_target(30.0, 80.0)
    position, effort = drive(law, 200)
    same, negative = drive(mirrored, 200, plant=other)
    assert same == pytest.approx(position, abs=1e-6)
    assert negative == pytest.approx(-effort, abs=1e-6)


def test_near_the_set_point_it_is_its_linear_controller(law_type: TunableLawType) -> None:
    law = law_type.build(task_of(), law_type.start())
    told = law_type.build(task_of(), law_type.start()).controller()
    a, b, c = (np.array(matrix) for matrix in (told.a, told.b, told.c))
    state, noise = np.zeros((len(a), 1)), random.Random(3)  # noqa: S311 - no secret
    for _ in range(50):
        sample = 1e-7 * noise.gauss(0.0, 1.0)
        state = a @ state + b * sample
        assert law.step(sample) == pytest.approx(float((c @ state)[0, 0]), abs=1e-11)


def test_its_parameters_begin_within_their_bounds(law_type: TunableLawType) -> None:
    for parameter in law_type.parameters.values():
        assert 0.0 < parameter.low <= parameter.start <= parameter.high
        assert parameter.meaning
    assert set(law_type.start()) == set(law_type.parameters)


PAIR, SINGLE = Pair.of(30.0, 0.6, PERIOD_S), exp(-0.2)
PAIR_ROOTS = [complex(root) for root in np.roots([1.0, -PAIR.total, PAIR.product])]


def assert_poles(matrix: NDArray[np.float64], wanted: Sequence[complex]) -> None:
    poles = np.linalg.eigvals(matrix)
    assert np.poly(poles) == pytest.approx(np.poly(np.array(wanted)), abs=1e-9)


def test_a_pair_has_its_frequency_and_damping() -> None:
    pole = np.log(PAIR_ROOTS[0]) / PERIOD_S
    assert abs(pole) == pytest.approx(30.0)
    assert -pole.real / abs(pole) == pytest.approx(0.6)


def test_gains_place_the_poles_that_were_asked_for() -> None:
    state, effort, output = extended_model(SAMPLED, 1.0)
    gain = np.array(observer_gain(SAMPLED, SINGLE, PAIR)).reshape(3, 1)
    assert_poles(state - gain @ output, [SINGLE, *PAIR_ROOTS])
    feedback = np.array([feedback_gains(SAMPLED, PAIR)])
    assert_poles(state[:2, :2] - effort[:2] @ feedback, PAIR_ROOTS)
    f1, f2, f3 = sum_gains(SAMPLED, PAIR, SINGLE)
    open_loop = np.array([[1.0, SAMPLED.a12, 0.0], [0.0, SAMPLED.a22, 0.0], [-f3, 0.0, 1.0]])
    assert_poles(open_loop + effort @ np.array([[-f1, -f2, 1.0]]), [SINGLE, *PAIR_ROOTS])


@pytest.mark.parametrize(("way", "velocity"), [(400.0, 100.0), (-3.0, 150.0), (0.01, 20.0), (50.0, 7.3), (0.5, 5.0)])
def test_a_trapezoid_keeps_its_limits_and_ends_exactly(way: float, velocity: float) -> None:
    profile = Trapezoid(5.0, 5.0 + way, velocity, 1000.0, 600.0, PERIOD_S)
    position, speed = np.array([profile.at(tick) for tick in range(2000)]).T
    assert position[0] == 5.0
    assert position[-1] == 5.0 + way
    assert np.max(np.abs(speed)) <= velocity + 1e-9
    change = np.diff(speed * np.sign(way)) / PERIOD_S
    assert np.max(change) <= 1000.0 + 1e-6
    assert np.min(change) >= -600.0 - 1e-6
    # Constant acceleration within each tick: the way of a tick is the mean of its speeds.
    assert np.diff(position) == pytest.approx(0.5 * PERIOD_S * (speed[1:] + speed[:-1]), abs=1e-9)
    shortest = abs(way) / velocity
    assert shortest <= PERIOD_S * np.count_nonzero(speed) <= shortest + velocity / 1000.0 + velocity / 600.0 + 0.04


def test_a_trapezoid_of_no_length_stays() -> None:
    assert Trapezoid(5.0, 5.0, 100.0, 1000.0, 600.0, PERIOD_S).at(0) == (5.0, 0.0)


def test_a_profile_of_limited_jerk_keeps_its_limits() -> None:
    pytest.importorskip("ruckig")
    from twostage_servo.control.baselines.jerk_limited import JerkLimited  # noqa: PLC0415

    profile = JerkLimited(5.0, -95.0, 80.0, 1000.0, 50_000.0, PERIOD_S)
    position, speed = np.array([profile.at(tick) for tick in range(200)]).T
    acceleration = np.diff(speed) / PERIOD_S
    assert (position[0], position[-1], speed[-1]) == (5.0, -95.0, 0.0)
    assert np.max(np.abs(speed)) <= 80.0 + 1e-9
    assert np.max(np.abs(acceleration)) <= 1000.0 + 1e-6
    assert np.max(np.abs(np.diff(acceleration))) / PERIOD_S <= 50_000.0 + 1e-3
    assert profile.at(10_000) == (-95.0, 0.0)


def test_the_velocity_that_ptos_asks_for_is_smooth_where_its_regions_meet() -> None:
    values = PROXIMATE_TIME_OPTIMAL.start()
    law = ProximateTimeOptimalServo(task_of(), values)
    law.set_target(0.0, 1e9)
    border = EFFORT_LIMIT * MODEL.gain / values["frequency"] ** 2
    below, at, above = (law.asked_velocity(border + step) for step in (-1e-4, 0.0, 1e-4))
    assert above - at == pytest.approx(at - below, rel=1e-3)
    # Beyond it the planned deceleration is the share of the effort that it may use.
    far = 50.0 * border
    slope = (law.asked_velocity(far + 1e-3) - law.asked_velocity(far - 1e-3)) / 2e-3
    braking = slope * (law.asked_velocity(far) + EFFORT_LIMIT / law.velocity_gain)
    assert braking == pytest.approx(values["effort_share"] * EFFORT_LIMIT * MODEL.gain, rel=1e-6)


def cost_of(start: float, error: float, velocity: float, values: dict[str, float]) -> float:
    """The cost of initial value compensation for a sum to begin with, added up tick by tick."""
    pair = Pair.of(values["feedback_frequency"], values["feedback_damping"], PERIOD_S)
    f1, f2, f3 = sum_gains(SAMPLED, pair, exp(-values["sum_frequency"] * PERIOD_S))
    total, cost = start, 0.0
    for _ in range(3000):
        effort = total - f1 * error - f2 * velocity
        cost += error * error + values["effort_weight"] * effort * effort
        total -= f3 * error
        error, velocity = (
            error + SAMPLED.a12 * velocity + SAMPLED.b1 * effort,
            SAMPLED.a22 * velocity + SAMPLED.b2 * effort,
        )
    return cost


def test_initial_value_compensation_begins_with_the_sum_that_costs_least() -> None:
    values = INITIAL_VALUE.start()
    of_error, of_velocity = InitialValueServo(task_of(), values).initial_value
    best = of_error * -8.0 + of_velocity * 100.0
    least = cost_of(best, -8.0, 100.0, values)
    assert least < cost_of(best + 0.05, -8.0, 100.0, values)
    assert least < cost_of(best - 0.05, -8.0, 100.0, values)


def test_cnf_changes_over_with_no_more_than_its_own_change_in_a_tick() -> None:
    law = COMPOSITE_NONLINEAR.build(task_of(), COMPOSITE_NONLINEAR.start())
    law.set_target(200.0, 100.0)
    _, effort = drive(law, 400)
    cruise = 100.0 * MODEL.pole / MODEL.gain
    last = int(np.nonzero(np.abs(effort[50:250] - cruise) < 1e-6)[0][-1]) + 50
    in_a_tick = -law.controller().c[0][0] * 100.0 * PERIOD_S
    assert 0.0 < effort[last] - effort[last + 1] <= in_a_tick


def test_adrc_places_the_poles_of_its_bandwidths() -> None:
    values = ACTIVE_DISTURBANCE_REJECTION.start()
    told = ACTIVE_DISTURBANCE_REJECTION.build(task_of(), values).controller()
    b0 = MODEL.gain * values["gain_share"]
    state = np.array([[1.0, PERIOD_S, PERIOD_S**2 / 2.0], [0.0, 1.0, PERIOD_S], [0.0, 0.0, 1.0]])
    effort = np.array([[b0 * PERIOD_S**2 / 2.0], [b0 * PERIOD_S], [0.0]])
    observer = np.array(told.a) - effort @ np.array(told.c)
    assert_poles(observer, [exp(-values["observer_bandwidth"] * PERIOD_S)] * 3)
    assert observer == pytest.approx(state - np.array(told.b) @ np.array([[1.0, 0.0, 0.0]]))


def test_the_gains_of_a_pid_are_measured_by_three_poles() -> None:
    """``(s + w)³ = s³ + 3 w s² + 3 w² s + w³``: at w = 9 rad/s and b = 180, and each a multiple of that."""
    values = {**PROFILE_PID.start(), "frequency": 9.0, "proportional": 2.0, "integral": 0.5, "derivative": 3.0}
    told = PROFILE_PID.build(task_of(), values).controller()
    keeps = exp(-PERIOD_S / 0.01)
    assert told.c[0] == pytest.approx((-2.0 * 3.0 * 81.0 / 180.0, 1.0, 1.0))
    assert told.b[1][0] == pytest.approx(-0.5 * 729.0 / 180.0 * PERIOD_S)
    assert told.a[2][0] == pytest.approx(3.0 * 3.0 * 9.0 / 180.0 / PERIOD_S * (1.0 - keeps))
    assert told.a[2][2] == pytest.approx(keeps)


@pytest.mark.parametrize("frequency", [20.0, 50.0])
def test_ptos_has_its_frequency_where_it_is_linear(frequency: float) -> None:
    """``u = k1 e - (k2 - a/b) v`` gives ``s² + b k2 s + b k1``: w² is b k1, and its damping is 1/sqrt(2 alpha)."""
    values = {**PROXIMATE_TIME_OPTIMAL.start(), "frequency": frequency, "effort_share": 0.8}
    f1, f2, _ = linear_gains(PROXIMATE_TIME_OPTIMAL.build(task_of(), values))
    gain, pole = MODEL.gain, MODEL.pole
    natural = np.roots([1.0, pole + gain * f2, gain * f1])
    assert np.abs(np.prod(natural)) == pytest.approx(frequency**2)
    assert -np.sum(natural).real / (2.0 * frequency) == pytest.approx((2.0 * 0.8) ** -0.5)


def linear_gains(law: TunableLaw) -> tuple[float, float, float]:
    """Return f1, f2 and f3 of ``u = -f1 x1 - f2 x2 - f3 x3`` near the set-point."""
    f1, f2, f3 = (-gain for gain in law.controller().c[0])
    return f1, f2, f3


def test_adrc_has_a_double_pole_at_the_bandwidth_of_its_feedback() -> None:
    """On a plant that is a double integrator with gain b0: ``s² + 2 w s + w²``; 1 for its disturbance."""
    values = {**ACTIVE_DISTURBANCE_REJECTION.start(), "feedback_bandwidth": 25.0, "gain_share": 1.5}
    f1, f2, f3 = linear_gains(ACTIVE_DISTURBANCE_REJECTION.build(task_of(), values))
    b0 = 1.5 * MODEL.gain
    assert (b0 * f1, b0 * f2, b0 * f3) == pytest.approx((625.0, 50.0, 1.0))


def test_the_nonlinear_part_of_cnf_goes_with_the_cost_to_come_of_its_linear_one() -> None:
    """``B' P (A - B F)/(B' P B)`` with P the sum of ``(A - B F)'^k W (A - B F)^k``, added up term by term."""
    values = {**COMPOSITE_NONLINEAR.start(), "nonlinear_share": 0.7, "velocity_weight_s": 0.05}
    f1, f2, _ = linear_gains(COMPOSITE_NONLINEAR.build(task_of(), values))
    pair = Pair.of(values["feedback_frequency"], values["feedback_damping"], PERIOD_S)
    feedback = np.array([feedback_gains(SAMPLED, pair)])
    state = np.array([[1.0, SAMPLED.a12], [0.0, SAMPLED.a22]])
    effort = np.array([[SAMPLED.b1], [SAMPLED.b2]])
    closed, weight = state - effort @ feedback, np.diag([1.0, 0.05**2])
    cost, power = np.zeros((2, 2)), np.eye(2)
    for _ in range(2000):
        cost += power.T @ weight @ power
        power = power @ closed
    added = 0.7 * (effort.T @ cost @ closed) / (effort.T @ cost @ effort)
    assert (f1, f2) == pytest.approx(tuple((feedback + added)[0]))


def test_cnf_adds_the_more_of_its_nonlinear_part_the_less_is_left() -> None:
    """``exp(-alpha share)`` of it, here with alpha 3."""
    law = CompositeNonlinearServo(task_of(), COMPOSITE_NONLINEAR.start() | {"nonlinear_decay": 3.0})
    law._observer.position, law._observer.velocity, law._observer.disturbance = 0.0, 20.0, 1.5
    for share in (1.0, 0.5, 0.0):
        blend = exp(-3.0 * share)
        expected = (law._f1 + blend * law._n1) * 8.0 - (law._f2 + blend * law._n2) * 20.0 - 1.5
        assert law._position_stage(8.0, share) == pytest.approx(expected)


def test_a_speed_stage_has_its_pole_and_holds_a_cruise_against_a_load() -> None:
    """``x2(k+1) = a22 x2 + b2 (u + x3)``: a deviation of the speed falls by exp(-w T) a tick, and w is 60 rad/s."""
    stage = SpeedStage(task_of(), {"speed_frequency": 60.0})
    observer = DisturbanceObserver(SAMPLED, (0.0, 0.0, 0.0))
    observer.velocity, observer.disturbance = 100.0, -1.5
    for deviation in (0.0, 5.0, -8.0):
        observer.velocity = 100.0 + deviation
        effort = stage.effort(100.0, observer)
        after = SAMPLED.a22 * observer.velocity + SAMPLED.b2 * (effort - 1.5)
        assert after - 100.0 == pytest.approx(deviation * exp(-0.6))


def test_the_parts_of_a_trapezoid_take_no_tick_more_than_they_need() -> None:
    """100 mm/s at 1000 and 500 mm/s²: ten ticks up, twenty down; 25 mm leave ten ticks of cruise."""
    profile = Trapezoid(0.0, 25.0, 100.0, 1000.0, 500.0, PERIOD_S)
    speeds = [profile.at(tick)[1] for tick in range(42)]
    assert speeds[9:21] == pytest.approx([90.0, *[100.0] * 11])
    assert speeds[21] == pytest.approx(95.0)
    assert speeds[39:] == pytest.approx([5.0, 0.0, 0.0])
