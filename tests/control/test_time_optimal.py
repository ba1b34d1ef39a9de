"""The quickest move: its parts by hand, and the whole of it by integration in small steps."""

from dataclasses import astuple
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.control.time_optimal import Capability

STEP_S = 2e-5


def by_steps(able: Capability, distance: float, velocity: float, band: float) -> float:
    """When the band is reached, by the speed that it may have at each place: braking from the end, then forward."""
    braking, speed, way = [(0.0, 0.0)], 0.0, 0.0
    while speed < velocity and way < distance + band:
        speed += STEP_S * min(able.acceleration, able.down + able.pole * speed)
        way += STEP_S * speed
        braking.append((way, speed))
    place = speed = time_s = 0.0
    index = len(braking) - 1
    end = distance + band
    while place < distance - band:
        left = end - place
        while index and braking[index][0] > left:
            index -= 1
        speed = min(speed + STEP_S * min(able.acceleration, able.up - able.pole * speed), velocity)
        if len(braking) > 1 and left < braking[-1][0]:
            speed = min(speed, max(braking[index][1], 1e-9))
        place += STEP_S * speed
        time_s += STEP_S
    return time_s


@pytest.mark.parametrize("acceleration", [inf, 2000.0, 1500.0, 300.0])
@pytest.mark.parametrize(("distance", "velocity"), [(20.0, 60.0), (2.0, 60.0), (60.0, 250.0)])
def test_the_bound_is_that_of_an_integration(acceleration: float, distance: float, velocity: float) -> None:
    able = Capability(1700.0, 1900.0, 14.0, acceleration)
    found = able.quickest_move(distance, velocity, 0.1)
    speed = min(velocity, 1700.0 / 14.0)
    assert found.bound_s == pytest.approx(by_steps(able, distance, speed, 0.1), abs=1e-3)


def test_an_acceleration_limit_below_the_effort_gives_the_trapezoid_of_school() -> None:
    """500 mm/s² up to 100 mm/s: 0.2 s and 10 mm each way; 79.9 + 0.1 mm at 100 mm/s between."""
    found = Capability(1e6, 1e6, 1e-3, 500.0).quickest_move(99.9, 100.0, 0.1)
    assert found.accelerating_s == pytest.approx(0.2)
    assert found.cruising_s == pytest.approx(0.8)
    assert found.braking_s == pytest.approx(0.2)
    assert found.in_band_s == pytest.approx((2.0 * 0.2 / 500.0) ** 0.5)


@given(st.floats(0.1, 1000.0), st.floats(1.0, 200.0), st.floats(10.0, 1e5))
def test_a_limit_never_makes_a_move_quicker(distance: float, velocity: float, acceleration: float) -> None:
    """Of a length that the band does not swallow: of 0.01 mm half lies in it, and the way there is nearly all."""
    free = Capability(1800.0, 1800.0, 14.0).quickest_move(distance, velocity, 0.005)
    held = Capability(1800.0, 1800.0, 14.0, acceleration).quickest_move(distance, velocity, 0.005)
    assert 0.0 <= free.bound_s <= held.bound_s + 1e-9
    slower = Capability(1800.0, 1800.0, 14.0).quickest_move(distance, 0.9 * velocity, 0.005)
    assert free.bound_s <= slower.bound_s + 1e-9


@pytest.mark.parametrize("length", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("distance", [0.3, 20.0])
def test_the_same_move_in_another_unit_takes_as_long(distance: float, length: float) -> None:
    """Also one whose top speed is below 1 of the unit, and whose last part is."""
    able = Capability(1700.0, 1900.0, 14.0, 1500.0)
    other = Capability(1700.0 * length, 1900.0 * length, 14.0, 1500.0 * length)
    same = other.quickest_move(distance * length, 60.0 * length, 0.1 * length)
    assert astuple(same) == pytest.approx(astuple(able.quickest_move(distance, 60.0, 0.1)))
