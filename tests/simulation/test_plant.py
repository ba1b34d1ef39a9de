import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from twostage_servo.simulation.plant import TruePlant

gains = st.floats(1.0, 1000.0)
poles = st.floats(0.1, 100.0)
frictions = st.floats(0.0, 3.0)
efforts = st.floats(-10.0, 10.0)
velocities = st.floats(-500.0, 500.0)
durations_s = st.floats(1e-6, 2.0)


def moving(gain: float, pole: float, friction: float, velocity: float) -> TruePlant:
    plant = TruePlant(gain, pole, friction)
    plant.velocity = velocity
    return plant


@given(gains, poles, efforts, velocities, durations_s)
def test_without_friction_it_is_the_matrix_exponential(
    gain: float, pole: float, effort: float, velocity: float, duration_s: float
) -> None:
    plant = moving(gain, pole, 0.0, velocity)
    plant.advance(duration_s, effort)
    generator = np.array([[0.0, 1.0, 0.0], [0.0, -pole, gain], [0.0, 0.0, 0.0]])
    position, velocity, _ = expm(generator * duration_s) @ [0.0, velocity, effort]
    assert plant.position == pytest.approx(position, rel=1e-9, abs=1e-9)
    assert plant.velocity == pytest.approx(velocity, rel=1e-9, abs=1e-9)


def reference(
    gain: float, pole: float, friction: float, velocity: float, effort: float, duration_s: float
) -> tuple[float, float]:
    """Integrate phase by phase with an event at each stop: it knows neither the closed form nor the crossing time."""
    state, time_s = [0.0, velocity], 0.0
    while time_s < duration_s:
        if state[1] == 0.0:
            if abs(effort) <= friction:
                break
            direction = math.copysign(1.0, effort)
        else:
            direction = math.copysign(1.0, state[1])

        def slope(_: float, x: list[float], sign: float = direction) -> list[float]:
            return [x[1], -pole * x[1] + gain * (effort - friction * sign)]

        def stop(_: float, x: list[float]) -> float:
            return x[1]

        stop.terminal = True  # type: ignore[attr-defined]
        stop.direction = -direction  # type: ignore[attr-defined]
        phase = solve_ivp(slope, (time_s, duration_s), state, events=stop, rtol=1e-10, atol=1e-11)
        time_s = phase.t[-1]
        state = [phase.y[0][-1], 0.0 if phase.status == 1 else phase.y[1][-1]]
    return state[0], state[1]


@pytest.mark.parametrize(
    ("velocity", "effort", "duration_s"),
    [
        pytest.param(100.0, 0.0, 0.05, id="coasts, still moving"),
        pytest.param(100.0, 0.0, 1.0, id="coasts to rest"),
        pytest.param(100.0, 0.4, 1.0, id="held by stiction after the stop"),
        pytest.param(100.0, -2.0, 1.0, id="stops and turns round"),
        pytest.param(-100.0, 2.0, 1.0, id="stops and turns round, mirrored"),
        pytest.param(0.0, 0.5, 1.0, id="effort equal to the friction does not move it"),
        pytest.param(0.0, 0.7, 1.0, id="breaks away"),
        pytest.param(0.0, -0.7, 1.0, id="breaks away, mirrored"),
        pytest.param(100.0, 0.5, 0.3, id="effort cancels the friction"),
        pytest.param(1.0, 3.0, 0.3, id="accelerates"),
    ],
)
def test_with_friction_it_is_the_integrated_equation(velocity: float, effort: float, duration_s: float) -> None:
    plant = moving(180.0, 14.0, 0.5, velocity)
    plant.advance(duration_s, effort)
    expected_position, expected_velocity = reference(180.0, 14.0, 0.5, velocity, effort, duration_s)
    assert plant.position == pytest.approx(expected_position, abs=1e-6)
    assert plant.velocity == pytest.approx(expected_velocity, abs=1e-6)


def test_the_stop_by_hand() -> None:
    """From 10 at deceleration 180 * 0.5 = 90 with pole 14: ln(1 + 14 * 10 / 90) / 14 s, then exactly still."""
    stop_s = math.log(1 + 140 / 90) / 14
    plant = moving(180.0, 14.0, 0.5, 10.0)
    plant.advance(stop_s * 0.999, 0.0)
    assert plant.velocity > 0.0
    plant.advance(stop_s * 0.002, 0.0)
    assert plant.velocity == 0.0
    # integral of velocity' = -pole velocity - 90 up to the stop: 0 - 10 = -14 position - 90 stop_s
    assert plant.position == pytest.approx((10 - 90 * stop_s) / 14)


@given(gains, poles, frictions, efforts, velocities, durations_s, st.floats(0.0, 1.0))
def test_splitting_a_duration_changes_nothing(
    gain: float, pole: float, friction: float, effort: float, velocity: float, duration_s: float, share: float
) -> None:
    whole = moving(gain, pole, friction, velocity)
    whole.advance(duration_s, effort)
    split = moving(gain, pole, friction, velocity)
    split.advance(duration_s * share, effort)
    split.advance(duration_s - duration_s * share, effort)
    assert split.position == pytest.approx(whole.position, rel=1e-9, abs=1e-8)
    assert split.velocity == pytest.approx(whole.velocity, rel=1e-9, abs=1e-8)


@given(gains, poles, frictions, st.floats(-1.0, 1.0), st.lists(durations_s, max_size=5))
def test_stiction_holds_it_at_rest_without_the_least_creep(
    gain: float, pole: float, friction: float, share: float, durations: list[float]
) -> None:
    plant = TruePlant(gain, pole, friction, position=12.5)
    for duration_s in durations:
        plant.advance(duration_s, friction * share)
    assert (plant.position, plant.velocity) == (12.5, 0.0)


@given(gains, poles, st.floats(0.01, 3.0), velocities, st.lists(st.floats(1e-4, 0.1), max_size=20))
def test_left_to_itself_it_loses_energy_and_never_turns_round(
    gain: float, pole: float, friction: float, velocity: float, durations: list[float]
) -> None:
    plant = moving(gain, pole, friction, velocity)
    for duration_s in durations:
        before = plant.velocity
        plant.advance(duration_s, 0.0)
        assert abs(plant.velocity) < abs(before) or plant.velocity == before == 0.0
        assert plant.velocity * velocity >= 0.0


@given(gains, poles, frictions, efforts, velocities, durations_s)
def test_it_is_symmetric(
    gain: float, pole: float, friction: float, effort: float, velocity: float, duration_s: float
) -> None:
    plant, mirrored = moving(gain, pole, friction, velocity), moving(gain, pole, friction, -velocity)
    plant.advance(duration_s, effort)
    mirrored.advance(duration_s, -effort)
    assert (mirrored.position, mirrored.velocity) == (-plant.position, -plant.velocity)


@given(gains, poles, st.floats(0.5, 3.0), st.floats(3.5, 10.0))
def test_friction_takes_its_share_of_the_final_velocity(
    gain: float, pole: float, friction: float, effort: float
) -> None:
    plant = TruePlant(gain, pole, friction)
    plant.advance(60.0 / pole, effort)
    assert plant.velocity == pytest.approx(gain * (effort - friction) / pole, rel=1e-12)


@pytest.mark.parametrize(("duration_s", "effort"), [(-1e-9, 0.0), (math.nan, 0.0), (math.inf, 0.0), (0.1, math.nan)])
def test_nonsense_is_refused_and_changes_nothing(duration_s: float, effort: float) -> None:
    plant = moving(180.0, 14.0, 0.5, 10.0)
    with pytest.raises(ValueError, match="cannot advance"):
        plant.advance(duration_s, effort)
    assert (plant.position, plant.velocity) == (0.0, 10.0)


@pytest.mark.parametrize(
    ("gain", "pole", "friction", "position"),
    [
        (0.0, 14.0, 0.0, 0.0),
        (180.0, 0.0, 0.0, 0.0),
        (180.0, 14.0, -0.1, 0.0),
        (180.0, math.nan, 0.0, 0.0),
        (1.0, 1.0, 0.0, math.inf),
    ],
)
def test_a_plant_that_cannot_be_is_refused(gain: float, pole: float, friction: float, position: float) -> None:
    with pytest.raises(ValueError, match=r"must be finite|gain must not be 0"):
        TruePlant(gain, pole, friction, position)
