"""The braking reference comes to rest on the set-point, tick by tick."""

import copy
import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.control.laws.adaptive.reference import Braking, Shape, Ways, next_speed
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01
PLANT = Plant(180.0, 14.0).discretise(PERIOD_S)
WAYS = Ways.of(PLANT)


def way_of(speeds: list[float]) -> float:
    """Return how far an axis goes whose speed takes these values from tick to tick, each at a constant effort."""
    return sum(WAYS.alpha * after + WAYS.beta * before for before, after in pairwise(speeds))


def test_a_tick_goes_as_far_as_the_plant_itself() -> None:
    before, after = 40.0, 55.0
    effort = (after - PLANT.a22 * before) / PLANT.b2
    assert way_of([before, after]) == pytest.approx(PLANT.a12 * before + PLANT.b1 * effort)


@given(st.floats(0.01, 500.0), st.floats(0.5, 300.0), st.floats(50.0, 5000.0))
def test_from_the_next_speed_it_comes_to_rest_within_the_way_that_is_left(
    way: float, speed: float, deceleration: float
) -> None:
    ahead = next_speed(way, speed, deceleration, WAYS)
    if ahead == 0.0:
        assert way <= WAYS.beta * speed
        return
    speeds, step = [speed, ahead], deceleration * PERIOD_S
    ticks = math.ceil(ahead / step - 1e-9)
    # With one more, smaller step it ends exactly there: n whole ones and a part, wherever the part is taken.
    fewest = way_of([*speeds, *(max(0.0, ahead - step * (index + 1)) for index in range(ticks))])
    assert fewest <= way + 1e-9 * (1.0 + way)
    assert way - fewest <= step * PERIOD_S


@given(st.floats(1.0, 250.0), st.floats(200.0, 4000.0), st.floats(200.0, 5000.0))
def test_a_braking_ends_on_the_set_point_by_steps_that_are_no_steeper_than_planned(
    speed: float, deceleration: float, effort_step: float
) -> None:
    """The change-over is where the speed would have to fall: what is left then is the way of the braking."""
    gain = 180.0
    shape = Shape.at(speed, speed, speed, deceleration, gain, effort_step * PERIOD_S, WAYS)
    unaveraged = Braking(Shape(0.0, speed, 1, 0.0), 0.0, deceleration)
    assert unaveraged.advance(WAYS) == 0.0
    left = speed * speed / (2.0 * deceleration) + 0.3 * speed * PERIOD_S
    ahead = next_speed(left, speed, deceleration, WAYS)
    if not 0.0 < ahead < speed:
        return
    braking, speeds = Braking(shape, left, deceleration), [speed]
    while not braking.done:
        speeds.append(braking.advance(WAYS))
        assert len(speeds) < 100_000
    assert speeds[-1] == 0.0
    assert way_of(speeds) == pytest.approx(left + shape.way, rel=1e-9, abs=1e-9)
    steps = [before - after for before, after in pairwise(speeds)]
    assert max(steps) <= max(deceleration * PERIOD_S, speed - ahead) * (1.0 + 1e-9)
    assert min(steps) >= -1e-9


@given(st.floats(0.0, 200.0), st.floats(0.0, 60.0), st.floats(0.3, 30.0))
def test_the_way_of_the_average_is_that_of_its_taps_one_by_one(speed: float, rise: float, effort_step: float) -> None:
    ahead = speed + rise
    shape = Shape.at(ahead, speed, 500.0, 2000.0, 180.0, effort_step, WAYS)
    swing = (2000.0 * PERIOD_S + rise) / (180.0 * PERIOD_S)
    assert shape.taps == max(2, math.ceil(swing / (0.75 * effort_step)))
    way = sum(
        WAYS.alpha * (shape.speed - j * shape.rise) + WAYS.beta * (shape.speed - (j + 1) * shape.rise)
        for i in range(1, shape.taps)
        for j in range(i)
    )
    assert shape.way == pytest.approx(way / shape.taps, rel=1e-12, abs=1e-12)


def test_a_copy_goes_on_by_itself() -> None:
    braking = Braking(Shape(0.0, 100.0, 3, 0.0), 5.0, 1000.0)
    braking.advance(WAYS)
    other = copy.copy(braking)
    mine = [braking.advance(WAYS) for _ in range(20)]
    assert [other.advance(WAYS) for _ in range(20)] == mine
    assert other.done
