"""Resonance and backlash, against the matrix exponential, an integrated equation and hand computations."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from twostage_servo.simulation.coupling import Coupling
from twostage_servo.simulation.faults import DriveFaults
from twostage_servo.simulation.plant import TruePlant
from twostage_servo.simulation.settings import SimulationSettings
from twostage_servo.simulation.true_axis import TrueAxis

resonances_hz = st.floats(0.1, 1000.0)
dampings = st.floats(0.0001, 0.99)
poles = st.floats(0.1, 100.0)
ticks_s = st.floats(0.001, 0.1)
efforts = st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=12)


def coupled(
    pole: float, resonance_hz: float, damping: float, backlash: float = 0.0, friction: float = 0.0
) -> tuple[TruePlant, Coupling]:
    coupling = Coupling(resonance_hz, damping, backlash, 0.0)
    return TruePlant(180.0, pole, friction, coupling=coupling), coupling


@given(poles, resonances_hz, dampings, ticks_s, efforts)
def test_without_backlash_it_is_the_matrix_exponential(
    pole: float, resonance_hz: float, damping: float, tick_s: float, efforts: list[float]
) -> None:
    plant, load = coupled(pole, resonance_hz, damping)
    omega = 2.0 * math.pi * resonance_hz
    stiffness, viscosity = omega * omega, 2.0 * damping * omega
    generator = np.zeros((5, 5))  # drive's position and velocity, the load's, effort
    generator[0, 1] = generator[2, 3] = 1.0
    generator[1] = [0.0, -pole, 0.0, 0.0, 180.0]
    generator[3] = [stiffness, viscosity, -stiffness, -viscosity, 0.0]
    state, step = np.zeros(5), expm(generator * tick_s)
    for effort in efforts:
        plant.advance(tick_s, effort)
        state[4] = effort
        state = step @ state
    scale = 1.0 + np.abs(state[1]) * tick_s * len(efforts)
    assert plant.position == pytest.approx(state[0], rel=1e-9, abs=1e-9)
    assert load.position == pytest.approx(state[2], rel=1e-8, abs=1e-8 * scale)
    assert load.velocity == pytest.approx(state[3], rel=1e-8, abs=1e-8 * scale * max(1.0, omega))


def integrated(
    pole: float, resonance_hz: float, damping: float, backlash: float, friction: float, tick_s: float,
    efforts: list[float],
) -> tuple[float, float]:  # fmt: skip
    """Integrate drive, gap and spring in steps of 5 µs, as the equations say: no phases, no contact time.

    The gap follows the drive's position from step to step, which is what a play operator is defined by.
    """
    omega, step_s, half = 2.0 * math.pi * resonance_hz, 5e-6, 0.5 * backlash
    drive = speed = passed = load = load_speed = 0.0
    for effort in efforts:
        for _ in range(round(tick_s / step_s)):
            net = effort - math.copysign(friction, speed) if speed else effort
            held = speed == 0.0 and abs(effort) <= friction
            before_speed = speed
            if not held:
                if speed == 0.0:
                    net = effort - math.copysign(friction, effort)
                speed += step_s * (180.0 * net - pole * speed)
                if before_speed * speed < 0.0:
                    speed = 0.0
                drive += 0.5 * step_s * (before_speed + speed)
            before = passed
            passed = min(max(passed, drive - half), drive + half)
            push = omega * omega * (0.5 * (passed + before) - load)
            push += 2.0 * damping * omega * ((passed - before) / step_s - load_speed)
            load_speed += step_s * push
            load += step_s * load_speed
    return load, load_speed


@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("backlash", [0.0, 0.2, 3.0])
@pytest.mark.parametrize(("resonance_hz", "damping"), [(15.0, 0.02), (4.0, 0.3)])
def test_with_backlash_it_is_the_integrated_equation(
    resonance_hz: float, damping: float, backlash: float, friction: float
) -> None:
    efforts = [8.0, 8.0, -3.0, -8.0, -8.0, 0.0, 0.2, 5.0]
    plant, load = coupled(14.0, resonance_hz, damping, backlash, friction)
    for effort in efforts:
        plant.advance(0.05, effort)
    position, velocity = integrated(14.0, resonance_hz, damping, backlash, friction, 0.05, efforts)
    assert load.position == pytest.approx(position, abs=5e-3)
    assert load.velocity == pytest.approx(velocity, abs=0.5)


def test_a_drive_that_stops_on_its_way_is_followed_by_the_integrated_equation() -> None:
    """Friction stops the drive within the tick: three phases, with the spring ringing on through all of them."""
    plant, load = coupled(14.0, 15.0, 0.02, friction=0.5)
    plant.velocity, load.velocity = 20.0, 20.0
    plant.advance(0.2, 0.0)
    omega = 2.0 * math.pi * 15.0
    stop_s = math.log(1.0 + 14.0 * 20.0 / 90.0) / 14.0

    def slope(time_s: float, state: list[float]) -> list[float]:
        moves = time_s < stop_s
        drive, speed, place, velocity = state
        acceleration = omega * omega * (drive - place) + 0.04 * omega * ((speed if moves else 0.0) - velocity)
        return [speed if moves else 0.0, -90.0 - 14.0 * speed if moves else 0.0, velocity, acceleration]

    first = solve_ivp(slope, (0.0, stop_s), [0.0, 20.0, 0.0, 20.0], rtol=1e-10, atol=1e-12).y[:, -1]
    last = solve_ivp(slope, (stop_s, 0.2), first, rtol=1e-10, atol=1e-12).y[:, -1]
    assert load.position == pytest.approx(last[2], abs=1e-6)
    assert load.velocity == pytest.approx(last[3], abs=1e-4)


@given(
    poles, st.one_of(st.just(0.0), resonances_hz), dampings, st.sampled_from([0.0, 0.2, 5.0]), ticks_s, efforts,
    st.floats(0.0, 1.0),
)  # fmt: skip
def test_splitting_a_duration_changes_nothing(
    pole: float, resonance_hz: float, damping: float, backlash: float, tick_s: float, efforts: list[float], share: float
) -> None:
    plant, load = coupled(pole, resonance_hz, damping, backlash, friction=0.5)
    split, split_load = coupled(pole, resonance_hz, damping, backlash, friction=0.5)
    for effort in efforts:
        plant.advance(tick_s, effort)
        split.advance(tick_s * share, effort)
        split.advance(tick_s - tick_s * share, effort)
    assert split_load.position == pytest.approx(load.position, rel=1e-7, abs=1e-6)


@given(poles, st.floats(0.001, 10.0), ticks_s, efforts)
def test_the_load_follows_the_drive_within_half_of_the_gap_and_only_when_it_is_pushed(
    pole: float, backlash: float, tick_s: float, efforts: list[float]
) -> None:
    """The play operator by its definition, with a drive that has no coupling to compare with."""
    plant, load = coupled(pole, 0.0, 0.02, backlash)
    alone, passed = TruePlant(180.0, pole), 0.0
    for effort in efforts:
        turned = alone.advance(tick_s, effort)
        plant.advance(tick_s, effort)
        assert (plant.position, plant.velocity) == (alone.position, alone.velocity)
        for position in (turned, alone.position):  # it is monotonous between these
            passed = min(max(passed, position - backlash / 2.0), position + backlash / 2.0)
        assert load.position == pytest.approx(passed, rel=1e-9, abs=1e-9)


def test_it_rings_at_its_frequency_and_dies_down_with_its_damping() -> None:
    """Logarithmic decrement of the standard text: 2 π ζ / sqrt(1 - ζ²) from one swing to the next."""
    plant, load = coupled(14.0, 15.0, 0.02, friction=1.0)
    load.velocity = 100.0
    peaks, before = [], (0.0, 0.0)
    for step in range(40_000):
        plant.advance(1e-5, 0.0)
        if before[1] > 0.0 >= load.velocity:
            peaks.append((step * 1e-5, load.position))
        before = load.position, load.velocity
    for (early_s, high), (late_s, low) in pairwise(peaks):
        assert late_s - early_s == pytest.approx(1.0 / (15.0 * math.sqrt(1.0 - 0.02**2)), abs=2e-5)
        assert math.log(high / low) == pytest.approx(2.0 * math.pi * 0.02 / math.sqrt(1.0 - 0.02**2), rel=1e-3)
    assert len(peaks) == 6


def test_a_stiff_coupling_is_a_fixed_one() -> None:
    stiff, load = coupled(14.0, 10_000.0, 0.5)
    fixed = TruePlant(180.0, 14.0)
    for effort in (5.0, -3.0, 1.0):
        stiff.advance(0.05, effort)
        fixed.advance(0.05, effort)
    assert load.position == pytest.approx(fixed.position, abs=1e-5)
    assert (stiff.position, stiff.velocity) == (fixed.position, fixed.velocity)


@pytest.mark.parametrize(
    ("resonance_hz", "damping", "backlash"),
    [(-1.0, 0.02, 0.0), (math.nan, 0.02, 0.0), (15.0, 0.0, 0.0), (15.0, 1.0, 0.0), (15.0, 0.02, -0.1),
     (15.0, 0.02, math.inf)],
)  # fmt: skip
def test_a_coupling_that_cannot_be_is_refused(resonance_hz: float, damping: float, backlash: float) -> None:
    with pytest.raises(ValueError, match="coupling with a"):
        Coupling(resonance_hz, damping, backlash, 0.0)


# By the settings ------------------------------------------------------------------------------------------------------


def axis(**settings: float) -> TrueAxis:
    return TrueAxis(SimulationSettings.model_validate(settings), 0.0)


def test_by_the_settings_the_encoder_is_on_the_load() -> None:
    """A reversal of the drive crosses the gap before the load moves: lost motion."""
    loose, fixed = axis(backlash=0.2, initial_position=7.0), axis(initial_position=7.0)
    for one in (loose, fixed):
        one.advance(1.0, 5.0)
        one.advance(2.0, 0.0)
    assert loose.position == pytest.approx(fixed.position - 0.1, abs=1e-9)
    for one in (loose, fixed):
        one.advance(3.0, -5.0)
        one.advance(4.0, 0.0)
    assert loose.position == pytest.approx(fixed.position + 0.1, abs=1e-9)


def test_without_the_keys_it_is_the_plant_to_the_last_bit() -> None:
    keyless, zero = axis(coulomb_friction=0.5), axis(coulomb_friction=0.5, resonance_hz=0.0, backlash=0.0)
    plant = TruePlant(180.0, 14.0, 0.5)
    for tick, effort in enumerate([8.0, 8.0, -3.0, -0.1, 0.2, 5.0], 1):
        keyless.advance(0.01 * tick, effort)
        zero.advance(0.01 * tick, effort)
        plant.advance(0.01 * tick - 0.01 * (tick - 1), effort)
        assert (keyless.position, keyless.velocity) == (zero.position, zero.velocity)
        assert (keyless.position, keyless.velocity) == (plant.position, plant.velocity)


@pytest.mark.parametrize("settings", [{"resonance_hz": 15.0}, {"backlash": 0.2}])
def test_a_stalled_axis_stands_with_its_load(settings: dict[str, float]) -> None:
    stalled = axis(**settings)
    stalled.advance(0.1, 8.0)
    stalled.change(DriveFaults(stalled=True))
    place = stalled.position
    stalled.advance(1.0, 8.0)
    assert (stalled.position, stalled.velocity) == (place, 0.0)


def test_the_switches_are_on_the_load() -> None:
    """The drive reaches its stop while the gap is still open; a fixed load would have gone 0.1 mm on."""
    loose = axis(backlash=0.2, positive_limit_from=50.0, initial_position=49.95, hard_stop_maximum=50.05)
    loose.advance(1.0, 5.0)
    assert loose.position == 49.95
    assert not loose.positive_limit
    fixed = axis(positive_limit_from=50.0, initial_position=49.95, hard_stop_maximum=50.05)
    fixed.advance(1.0, 5.0)
    assert fixed.positive_limit


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"resonance_hz": -1.0}, "greater than or equal to 0"),
        ({"resonance_hz": 0.01}, r"0.01 Hz is no resonance of a drive: give 0.1 Hz or more, or 0"),
        ({"resonance_hz": 1e5}, "less than or equal to 10000"),
        ({"resonance_damping": 0.0}, "greater than or equal to 0.0001"),
        ({"resonance_damping": 1.0}, "less than or equal to 0.99"),
        ({"backlash": -0.2}, "greater than or equal to 0"),
        (
            {"backlash": 5.0, "hard_stop_minimum": -2.0, "hard_stop_maximum": 3.0},
            "backlash = 5 is not below the way of 5 between the hard stops",
        ),
    ],
)
def test_nonsense_settings_are_refused(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        SimulationSettings.model_validate(settings)
