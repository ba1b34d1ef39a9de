"""Decisions within a move, by hand: the last rises of the speed, and whether braking can still meet the set-point."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.control.laws.adaptive.acceptance import cautious
from twostage_servo.control.laws.adaptive.changeover import Changeover, _needed_evenly, _Plan
from twostage_servo.control.laws.adaptive.departure import Departure
from twostage_servo.control.laws.adaptive.reference import Shape, Ways
from twostage_servo.control.laws.adaptive.speed_stage import SpeedStage
from twostage_servo.control.plant import Plant

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


@pytest.mark.parametrize(
    ("speed", "slope", "least"),
    [
        (50.0, -3.0, 45.0),  # its slope may change by 2 mm/s in a tick
        (50.0, 5.0, 53.0),
        (50.0, -9.5, 40.0),  # and be -10 mm/s at most, by the acceleration
        (50.0, -12.0, 38.0),  # or what it is already
        (0.5, -3.0, 0.0),  # from ahead it does not turn back
        (3.0, -3.0, 0.0),
        (-2.0, -1.0, -5.0),
    ],
)
def test_how_slow_a_smooth_reference_may_be_a_tick_ahead(speed: float, slope: float, least: float) -> None:
    changeover: Any = SimpleNamespace(
        _smoothing=SimpleNamespace(step=lambda gain: gain / 90.0),
        _estimate=SimpleNamespace(model=SimpleNamespace(plant=SimpleNamespace(gain=180.0))),
        _acceleration_limit=1000.0,
        _period_s=0.01,
    )
    course: Any = SimpleNamespace(speed=speed, slope=slope)
    assert Changeover._falls_from(changeover, course) == pytest.approx(least)
    changeover._smoothing = None
    assert Changeover._falls_from(changeover, course) == speed


@pytest.mark.parametrize(
    ("target", "direction", "ahead", "slope", "after"),
    [
        (120.0, 1.0, -0.5, -2.0, (1.0, -0.5, -2.0)),  # the set-point is still ahead
        (80.0, 1.0, -0.5, -2.0, (-1.0, 0.5, 2.0)),  # it has been passed: forward is the other way now
        (80.0, -1.0, -0.5, -2.0, (-1.0, -0.5, -2.0)),
        (120.0, -1.0, 0.0, -2.0, (1.0, 0.0, 2.0)),
    ],
)
def test_an_axis_that_has_turned_round_counts_forward_towards_its_set_point(
    target: float, direction: float, ahead: float, slope: float, after: tuple[float, float, float]
) -> None:
    set_out: list[float] = []
    stage: Any = SimpleNamespace(
        _estimate=SimpleNamespace(position=100.0), _departure=SimpleNamespace(set_out=set_out.append)
    )
    course: Any = SimpleNamespace(target=target, direction=direction, slope=slope, speed=9.0, turns=True)
    SpeedStage._turn_round(stage, course, ahead)
    assert (course.direction, course.speed, course.slope) == after
    assert (course.turns, set_out) == (False, [100.0])


@pytest.mark.parametrize(
    ("left", "deceleration", "smooth", "late"),
    [
        (0.139, 3000.0, True, True),  # 7 ms at 20 mm/s are 0.14 mm
        (0.141, 3000.0, True, False),
        (0.139, 3000.0, False, True),  # it stops within the tick, which takes as much
        (0.141, 3000.0, False, False),
        (0.239, 1000.0, False, True),  # 20 mm/s and then 10 take 0.14 + 0.1 mm
        (0.241, 1000.0, False, False),
        (0.239, 1000.0, True, True),
        (0.241, 1000.0, True, False),
    ],
)
def test_a_braking_is_late_where_less_is_left_than_it_takes(
    left: float, deceleration: float, smooth: bool, late: bool
) -> None:
    """3 ms of the speed a tick ahead are gone by then, and 0.5 mm for the taps of the average."""
    changeover: Any = SimpleNamespace(
        _estimate=SimpleNamespace(model=SimpleNamespace(ways=Ways(0.003, 0.007, 0.01))),
        _smoothing=SimpleNamespace() if smooth else None,
        _period_s=0.01,
    )
    plan: Any = SimpleNamespace(shape=SimpleNamespace(speed=20.0, way=0.5), deceleration=deceleration)
    assert Changeover._is_late(changeover, 30.0, plan, left + 0.5 + 0.09) is late


@pytest.mark.parametrize(
    ("ticks", "sure", "ends_at"), [(200, True, 5), (200, False, 12), (4, True, None), (11, False, None)]
)
def test_identification_ends_in_a_cruise_that_has_shown_enough_or_has_lasted_long(
    ticks: int, sure: bool, ends_at: int | None
) -> None:
    ended: list[int] = []
    course: Any = SimpleNamespace(ticks_cruised=0)
    stage: Any = SimpleNamespace(
        _estimate=SimpleNamespace(
            learning=SimpleNamespace(is_sure=sure), finish=lambda: ended.append(course.ticks_cruised)
        ),
        _rules=SimpleNamespace(identification_ticks=5, longest_identification_ticks=12),
    )
    for _ in range(ticks):
        SpeedStage._cruise(stage, course)
        if ended:
            break
    assert (ended[0] if ended else None) == ends_at


@pytest.mark.parametrize(("ticks", "least_s"), [(5.0, 0.01), (1.0, 0.05)])
@pytest.mark.parametrize(
    ("cautious", "new", "smooth", "speed", "cruise", "target", "rise"),
    [
        # Towards 1.2 times 100 mm/s in time constants of 5 ticks of 10 ms: a fifth of what is missing.
        (True, True, False, 0.0, 100.0, 125.0, 24.0),
        (True, True, False, 20.0, 100.0, -125.0, 20.0),
        (True, True, False, 100.0, 100.0, 125.0, 4.0),
        (True, False, False, 20.0, 100.0, 125.0, 20.0),
        (True, True, False, 0.0, 100.0, 1.0, 4.0),  # 1 mm in 50 ms² is 0.4 mm/ms², 4 mm/s a tick
        (True, True, True, 0.0, 100.0, 1.0, 4.0),
        (True, False, False, 0.0, 100.0, 1.0, 24.0),
        (True, True, False, 0.0, 1000.0, 400.0, 50.0),  # the acceleration allows no more
        (True, False, True, 20.0, 100.0, 125.0, 50.0),  # what is smooth rises by less at its end in any case
        (False, True, False, 0.0, 100.0, 1.0, 50.0),
    ],
)
def test_the_speed_rises_by_less_the_faster_it_is(
    cautious: bool,
    new: bool,
    smooth: bool,
    speed: float,
    cruise: float,
    target: float,
    rise: float,
    ticks: float,
    least_s: float,
) -> None:
    stage: Any = SimpleNamespace(
        _rules=SimpleNamespace(is_cautious=cautious, acceleration_ticks=ticks, acceleration_s=least_s, overreach=1.2),
        _estimate=SimpleNamespace(learning=SimpleNamespace(is_new=new)),
        _departure=SimpleNamespace(position=0.0),
        _smoothing="some" if smooth else None,
        _loop_period_s=0.01,
        _period_s=0.01,
        _ramp=50.0,
    )
    course: Any = SimpleNamespace(speed=speed, cruise_velocity=cruise, target=target)
    assert SpeedStage._largest_rise(stage, course) == pytest.approx(rise)


@pytest.mark.parametrize(("asked", "ahead"), [(60.0, 56.0), (55.0, 55.0), (54.5, 54.5), (40.0, 54.0)])
def test_a_smooth_reference_whose_effort_a_limit_cuts_changes_smoothly(asked: float, ahead: float) -> None:
    """It would go on to 55 mm/s with the slope that it has, and its slope may change by 1 mm/s in a tick."""
    stage: Any = SimpleNamespace(
        _smoothing=SimpleNamespace(step=lambda gain: gain / 180.0),
        _estimate=SimpleNamespace(model=SimpleNamespace(plant=SimpleNamespace(gain=180.0))),
    )
    course: Any = SimpleNamespace(speed=50.0, slope=5.0)
    assert SpeedStage._withheld(stage, course, asked) == ahead
    stage._smoothing = None
    assert SpeedStage._withheld(stage, course, asked) == asked


@pytest.mark.parametrize(
    ("speed", "left", "turns"),
    [
        (20.0, 0.35, False),  # 1000 mm/s² are planned, and a ninth more is allowed: 20, 10 and 0 mm/s take 0.34 mm
        (20.0, 0.20, True),
        (20.0, 0.13, True),  # less than the tick in which it stops
        (20.0, -0.1, True),
        (0.0, -0.1, False),  # its slope runs out at rest
        (-3.0, -0.1, False),
    ],
)
def test_a_smooth_reference_turns_round_where_no_even_braking_meets_the_set_point(
    speed: float, left: float, turns: bool
) -> None:
    shape: Any = SimpleNamespace(speed=speed, way=0.0, last_weight=1.0, lead=list, history=lambda: [speed])
    plan = _Plan(shape, 1000.0)
    changeover: Any = SimpleNamespace(
        _estimate=SimpleNamespace(position=100.0, model=SimpleNamespace(ways=Ways(0.003, 0.007, 0.01))),
        _rules=SimpleNamespace(braking_share=0.66),
        _acceleration_limit=1000.0,
        _smoothing=SimpleNamespace(),
        _plan=lambda *_: plan,
    )
    course: Any = SimpleNamespace(
        direction=1.0, speed=20.0, turns=False, has_changed_over=False, position=0.0, braking=None, top=0.0
    )
    Changeover._begin_braking(changeover, course, 20.0, plan, left)
    assert (course.turns, course.has_changed_over) == (turns, not turns)
    assert (course.braking is not None) is (not turns and speed > 0.0)


@pytest.mark.parametrize(("ahead", "rise"), [(105.0, 5.0), (120.0, 20.0), (180.0, 20.0), (100.0, 0.0), (90.0, 0.0)])
def test_a_braking_is_planned_from_no_steeper_rise_than_the_reference_has_by_itself(ahead: float, rise: float) -> None:
    """2000 mm/s² are 20 mm/s a tick. An axis that is driven takes the reference along faster than that.

    A spurious load, of a coarse encoder, once made it rise by 25 ticks' worth in one: it braked 2.9 m early.
    """
    model = SimpleNamespace(plant=SimpleNamespace(gain=180.0), ways=Ways(0.003, 0.007, 0.01))
    changeover: Any = SimpleNamespace(
        _estimate=SimpleNamespace(model=model),
        _smoothing=None,
        _largest_step=10.0,
        _acceleration_limit=2000.0,
        _period_s=0.01,
    )
    course: Any = SimpleNamespace(speed=100.0, cruise_velocity=250.0)
    plan: Any = Changeover._plan(changeover, course, ahead, 1000.0)
    assert plan.shape.rise == pytest.approx(rise)


@pytest.mark.parametrize(
    ("tick", "rise", "sample", "wanted", "effort"),
    [
        (1, 20.0, 5.0, 24.0, 2.0 + 10.0 + 3.36),  # 20 mm/s over coasting at 2 mm/s a volt, and 14 % of 24 V
        (4, -20.0, 5.0, -24.0, 2.0 - 10.0 - 3.36),
        (4, 20.0, 5.0, 9.0, 9.0),
        (5, 20.0, 5.0, 24.0, 2.0 + 3.36),  # by now it would have been seen to move
        (5, 20.0, None, 24.0, 2.0 + 10.0 + 3.36),  # a sample that is lost shows nothing
        (5, 20.0, 5.31, 24.0, 24.0),  # it is: three standard deviations of 0.1 mm
        (5, 20.0, 4.69, 24.0, 24.0),
        (15, 20.0, 5.0, 24.0, 2.0 + 3.36),
        (16, 20.0, 5.0, 24.0, 24.0),  # 0.15 s later a stall is detected, or there is friction that takes more
    ],
)
def test_an_axis_that_is_not_seen_to_move_is_pushed_by_little_once_it_should_have_been(
    tick: int, rise: float, sample: float | None, wanted: float, effort: float
) -> None:
    estimate: Any = SimpleNamespace(spread=0.1, model=SimpleNamespace(sampled=SimpleNamespace(b2=2.0)))
    departure = Departure(estimate, 0.01, 0.01)
    departure.set_out(5.0)
    departure.hold(2.0)
    for _ in range(tick - 1):
        departure.held_back(wanted, rise, 5.0, 24.0)
    assert departure.held_back(wanted, rise, sample, 24.0) == pytest.approx(effort)
    assert departure.is_held is (effort != wanted or tick == 4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("gain", "kept"), [(0.6, 0.7), (0.7, 0.7), (0.71, 0.71), (1.6, 1.6)])
def test_a_first_move_is_not_pushed_by_more_than_the_least_of_gains_asks_for(
    gain: float, kept: float, sign: float
) -> None:
    """A plant may be 30 % off its model."""
    plant = cautious(Plant(sign * gain * 180.0, 9.0), Plant(sign * 180.0, 14.0))
    assert plant.gain == pytest.approx(sign * kept * 180.0)
    assert plant.pole == 9.0


@pytest.mark.parametrize(
    ("speed", "left", "needed"),
    [(0.0, 0.3, 0.0), (1e-310, 0.3, 0.0), (1e-9, 0.3, 0.0), (10.0, 0.0, math.inf), (10.0, -0.1, math.inf)],
)
def test_what_stands_or_has_no_way_left_needs_no_slope_or_any(speed: float, left: float, needed: float) -> None:
    """A slope of so little was divided by, once it was rounded to nothing."""
    assert _needed_evenly(Shape(1.0, speed, 1, 0.0), left, Ways(0.003, 0.007, 0.01)) == needed
