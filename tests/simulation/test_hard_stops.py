import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from twostage_servo.simulation.plant import TruePlant

STOP = 2.0

gains = st.sampled_from([180.0, -180.0, 20.0])
poles = st.floats(0.5, 50.0)
frictions = st.sampled_from([0.0, 0.3])
efforts = st.floats(-5.0, 5.0)
velocities = st.floats(-200.0, 200.0)
starts = st.floats(-STOP, STOP)
durations_s = st.floats(1e-6, 1.0)


def stopped(gain: float, pole: float, friction: float, position: float, velocity: float) -> TruePlant:
    plant = TruePlant(gain, pole, friction, position, -STOP, STOP)
    plant.velocity = velocity
    return plant


def direction_of(gain: float, friction: float, position: float, velocity: float, effort: float) -> float:
    if velocity != 0.0:
        return math.copysign(1.0, velocity)
    direction = math.copysign(1.0, gain * effort) if abs(effort) > friction else 0.0
    return 0.0 if direction * position >= STOP else direction


def reference(
    gain: float, pole: float, friction: float, position: float, velocity: float, effort: float, duration_s: float
) -> tuple[float, float]:
    """Integrate phase by phase with events at rest and at the stops; it knows no closed form and no bisection."""
    time_s = 0.0
    while time_s < duration_s and (direction := direction_of(gain, friction, position, velocity, effort)):
        if direction * position >= STOP:
            velocity = 0.0
            continue

        def slope(_: float, x: list[float], sign: float = direction) -> list[float]:
            return [x[1], -pole * x[1] + gain * effort - abs(gain) * friction * sign]

        def rest(_: float, x: list[float]) -> float:
            return x[1]

        def impact(_: float, x: list[float], sign: float = direction) -> float:
            return sign * x[0] - STOP

        for event, crossing in ((rest, -direction), (impact, 1.0)):
            event.terminal = True  # type: ignore[attr-defined]
            event.direction = crossing  # type: ignore[attr-defined]
        start = (position, velocity)
        phase = solve_ivp(slope, (time_s, duration_s), start, events=[rest, impact], rtol=1e-11, atol=1e-12)
        time_s = phase.t[-1]
        rested, met = (bool(times.size) for times in phase.t_events)
        position = direction * STOP if met else phase.y[0][-1]
        velocity = 0.0 if met or rested else phase.y[1][-1]
    return position, velocity


@pytest.mark.parametrize(
    ("position", "velocity", "effort", "duration_s"),
    [
        pytest.param(0.0, 100.0, 0.0, 1.0, id="coasts into the stop"),
        pytest.param(0.0, -100.0, -3.0, 1.0, id="is pushed into the other one"),
        pytest.param(0.0, 100.0, 0.0, 0.01, id="not there yet"),
        pytest.param(0.0, 100.0, -4.0, 0.05, id="is pulled off again"),
        pytest.param(0.0, 100.0, -4.0, 1.0, id="is pulled off and into the other one"),
        pytest.param(1.9, 10.0, -4.0, 1.0, id="turns round before it and meets the other one"),
        pytest.param(2.0, 0.0, 3.0, 1.0, id="leans on it"),
        pytest.param(2.0, 0.0, -3.0, 0.02, id="leaves it"),
        pytest.param(2.0, 0.0, -0.2, 1.0, id="stays on it by friction"),
        pytest.param(-2.0, -5.0, 1.0, 0.02, id="begins with an impact"),
    ],
)
@pytest.mark.parametrize("gain", [180.0, -180.0])
def test_it_is_the_integrated_equation(
    gain: float, position: float, velocity: float, effort: float, duration_s: float
) -> None:
    effort = math.copysign(effort, effort * gain)
    plant = stopped(gain, 14.0, 0.3, position, velocity)
    plant.advance(duration_s, effort)
    expected_position, expected_velocity = reference(gain, 14.0, 0.3, position, velocity, effort, duration_s)
    assert plant.position == pytest.approx(expected_position, abs=1e-6)
    assert plant.velocity == pytest.approx(expected_velocity, abs=1e-5)


@given(gains, poles, frictions, starts, velocities, st.lists(st.tuples(durations_s, efforts), max_size=8))
def test_it_is_never_beyond_a_stop_nor_moves_into_it(
    gain: float, pole: float, friction: float, start: float, velocity: float, phases: list[tuple[float, float]]
) -> None:
    plant = stopped(gain, pole, friction, start, velocity)
    for duration_s, effort in phases:
        plant.advance(duration_s, effort)
        assert abs(plant.position) <= STOP
        assert abs(plant.position) < STOP or plant.position * plant.velocity <= 0.0


@given(gains, poles, frictions, starts, velocities, efforts, durations_s, st.floats(0.0, 1.0))
def test_splitting_a_duration_changes_nothing_and_the_way_is_the_one_that_it_tells(
    gain: float, pole: float, friction: float, start: float, velocity: float, effort: float, duration_s: float,
    share: float,
) -> None:  # fmt: skip
    whole = stopped(gain, pole, friction, start, velocity)
    first_stop = whole.advance(duration_s, effort)
    split = stopped(gain, pole, friction, start, velocity)
    split.advance(duration_s * share, effort)
    lowest, *_, highest = sorted((start, first_stop, whole.position))
    assert lowest - 1e-9 <= split.position <= highest + 1e-9
    split.advance(duration_s - duration_s * share, effort)
    assert split.position == pytest.approx(whole.position, rel=1e-8, abs=1e-8)
    assert split.velocity == pytest.approx(whole.velocity, rel=1e-8, abs=1e-6)


def test_it_tells_where_it_turned_round() -> None:
    """From 10 against 180 * 1 with pole 14: it stops after t = ln(1 + 14 * 10 / 180) / 14 s at (10 - 180 t) / 14."""
    plant = TruePlant(180.0, 14.0)
    plant.velocity = 10.0
    turned = plant.advance(0.5, -1.0)
    assert turned == pytest.approx((10.0 - 180.0 * math.log(1.0 + 140.0 / 180.0) / 14.0) / 14.0)
    assert plant.position < 0.0 < turned
    assert plant.advance(0.5, -1.0) == plant.position


def test_other_parameters_act_from_where_it_is() -> None:
    plant = TruePlant(180.0, 14.0)
    plant.advance(0.1, 1.0)
    position, velocity = plant.position, plant.velocity
    plant.change(90.0, 7.0, 0.0)
    assert (plant.position, plant.velocity) == (position, velocity)
    plant.advance(100.0, 1.0)
    assert plant.velocity == pytest.approx(90.0 / 7.0)
    with pytest.raises(ValueError, match="gain must not be 0"):
        plant.change(0.0, 7.0, 0.0)
    with pytest.raises(ValueError, match="finite and not negative"):
        plant.change(1.0, 7.0, -1.0)
    plant.advance(1.0, 1.0)
    assert plant.velocity == pytest.approx(90.0 / 7.0)


@pytest.mark.parametrize("position", [-2.1, 2.1])
def test_it_does_not_begin_beyond_a_stop(position: float) -> None:
    with pytest.raises(ValueError, match="between its stops"):
        stopped(1.0, 1.0, 0.0, position, 0.0)
