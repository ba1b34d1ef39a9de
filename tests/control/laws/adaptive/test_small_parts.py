"""Decisions within a move, by hand: the last rises of the speed, and whether braking can still meet the set-point."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.control.laws.adaptive.changeover import Changeover
from twostage_servo.control.laws.adaptive.reference import Shape
from twostage_servo.control.laws.adaptive.speed_stage import SpeedStage

STEP = 2.0
"""By how much the rise of the speed may change in a tick, in mm/s: 4 V in a tick, of 0.5 mm/(V s) each."""


def last_rise(left: float) -> float:
    estimate = SimpleNamespace(model=SimpleNamespace(sampled=SimpleNamespace(b2=-0.5)))
    stage: Any = SimpleNamespace(_estimate=estimate, _largest_step=4.0)
    return SpeedStage._last_rise(stage, left)


@pytest.mark.parametrize("ticks", [1, 2, 3, 7])
def test_whole_ticks_of_smaller_and_smaller_rises_add_up_to_what_is_left(ticks: int) -> None:
    """n + (n-1) + ... + 1 steps are n (n + 1)/2 of them."""
    assert last_rise(STEP * ticks * (ticks + 1) / 2.0) == pytest.approx(STEP * ticks)


@given(st.floats(0.01, 500.0))
def test_each_rise_is_smaller_by_a_step_at_most_and_the_last_one_ends_at_the_goal(left: float) -> None:
    before, ticks = math.inf, 0
    while left > 1e-9:
        rise = last_rise(left)
        assert 0.0 < rise <= left * (1.0 + 1e-12)
        assert rise <= before
        assert ticks == 0 or before - rise <= STEP * (1.0 + 1e-9)
        left, before, ticks = left - rise, rise, ticks + 1
        assert ticks < 50
    assert before <= STEP * (1.0 + 1e-9)


def begun(*, ahead: float, speed: float, left: float, braking_speed: float = 20.0) -> Any:
    """Return the course of a move at 100 mm in which braking with 100 mm/s² is begun `left` mm before the set-point."""
    ways = SimpleNamespace(alpha=0.003, beta=0.007)
    changeover: Any = SimpleNamespace(
        _estimate=SimpleNamespace(position=100.0, model=SimpleNamespace(ways=ways)),
        _rules=SimpleNamespace(braking_share=0.66),
        _acceleration_limit=150.0,
        _smoothing=None,
    )
    course: Any = SimpleNamespace(
        direction=-1.0, speed=speed, turns=False, has_changed_over=False, position=0.0, braking=None, top=0.0
    )
    shape = Shape(0.0, braking_speed, 2, 0.0)
    plan: Any = (shape, 100.0)
    Changeover._begin_braking(changeover, course, ahead, plan, left)
    return course


@pytest.mark.parametrize(
    ("ahead", "speed", "left", "turns"),
    [
        (20.0, 20.0, 1.01, False),  # 20²/2 mm²/s² over 1 mm are 200 mm/s²: twice what is planned
        (20.0, 20.0, 0.99, True),
        (0.5, 20.0, 0.99, True),
        (0.0, 20.0, 0.99, False),  # it comes to rest within this tick in any case
        (20.0, 0.0, 0.99, False),
        (20.0, 20.0, 0.0, True),
        (20.0, 20.0, -1.0, True),
    ],
)
def test_an_axis_turns_round_where_no_braking_meets_the_set_point(
    ahead: float, speed: float, left: float, turns: bool
) -> None:
    course = begun(ahead=ahead, speed=speed, left=left)
    assert (course.turns, course.has_changed_over) == (turns, not turns)


def test_the_reference_begins_where_the_axis_is_a_tick_ahead() -> None:
    """100 mm, less 0.007 s of 30 mm/s and 0.003 s of 20 mm/s; it brakes as hard as the set-point needs."""
    course = begun(ahead=20.0, speed=30.0, left=1.6)
    assert course.position == pytest.approx(100.0 - 0.21 - 0.06)
    assert course.top == 20.0
    assert course.braking._deceleration == pytest.approx(125.0)
    assert begun(ahead=20.0, speed=30.0, left=4.0).braking._deceleration == pytest.approx(100.0)
    assert begun(ahead=0.0, speed=30.0, left=4.0).braking is None
