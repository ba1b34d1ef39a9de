"""Each limit exactly where it lies, on an axis whose motion is written by hand: which code, and in which tick."""

import math
from types import SimpleNamespace
from typing import Any

import pytest

from tests.axis.rig import PERIOD_S, axis_settings
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.state import State
from twostage_servo.axis.supervision import Supervision
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.laws.law import Stage

DESIGN = design_axis(axis_settings(position_minimum=-100.0, position_maximum=250.0), PERIOD_S)
"""Overspeed 320 mm/s, overrun 20 mm, rest 2.5 mm/s, window 0.05 mm for 10 ticks, stall 2.5 V for 5, 24 V for 50."""


def motion(**changes: Any) -> Any:
    """Return what a supervision looks at: an axis that holds at 0, and what is changed of it."""
    law = SimpleNamespace(
        effort=0.0,
        target=0.0,
        saturated=False,
        stage=Stage.POSITION,
        cruise_velocity=0.0,
        observer=SimpleNamespace(position=0.0, velocity=0.0),
    )
    whole = SimpleNamespace(
        law=law,
        nominal=SimpleNamespace(observer=SimpleNamespace(position=0.0, velocity=0.0)),
        model_monitor=SimpleNamespace(better_factor=None, surprise=1.0, seems_to_stand=False),
        blind=False,
        implausible=0,
        implausible_distance=0.0,
        innovation_gate=0.5,
        recent_way=math.inf,
        unchanged_effort=0.0,
        following_error=0.0,
    )
    for path, value in changes.items():
        change(whole, path, value)
    return whole


def change(whole: Any, path: str, value: object) -> None:
    *parents, name = path.split("__")
    for parent in parents:
        whole = getattr(whole, parent)
    setattr(whole, name, value)


def codes(
    whole: Any, state: State = State.POSITION_STAGE, *, referenced: bool = True, method: str = "set_here"
) -> list[TripCode]:
    design = DESIGN
    if method != "set_here":
        design = design_axis(axis_settings({"method": method}), PERIOD_S)
    return [code for code, _ in Supervision(design, whole).violations(state, referenced=referenced)]


def first_tick(
    supervision: Supervision, code: TripCode, state: State = State.POSITION_STAGE, longest: int = 200
) -> int:
    for tick in range(1, longest + 1):
        if code in {violated for violated, _ in supervision.violations(state, referenced=True)}:
            return tick
    return 0


@pytest.mark.parametrize("velocity", [320.0, -320.0, 320.1, -320.1, math.nan])
def test_overspeed(velocity: float) -> None:
    for state in (State.HOLDING, State.STOPPING, State.HOMING):
        too_fast = TripCode.OVERSPEED in codes(motion(law__observer__velocity=velocity), state, referenced=False)
        assert too_fast is not (abs(velocity) == 320.0)


def test_the_second_implausible_sample_in_a_row_trips_unless_the_axis_is_blind_already() -> None:
    assert codes(motion(implausible=1)) == []
    assert codes(motion(implausible=2)) == [TripCode.POSITION_JUMP]
    assert codes(motion(implausible=3), State.STOPPING) == [TripCode.POSITION_JUMP]
    assert codes(motion(implausible=2, blind=True)) == []


@pytest.mark.parametrize(
    ("position", "outside"), [(-120.0, False), (-120.1, True), (270.0, False), (270.1, True), (math.nan, True)]
)
def test_an_axis_at_rest_trips_past_its_overrun(position: float, outside: bool) -> None:
    there = motion(law__observer__position=position)
    assert (codes(there) == [TripCode.POSITION_LIMIT]) is outside
    assert codes(there, referenced=False) == []


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_moving_axis_trips_while_a_quick_stop_and_a_tick_still_end_in_the_overrun(side: float) -> None:
    distance = DESIGN.certain_stopping_distance(200.0, 4000.0) + 200.0 * PERIOD_S
    end = 270.0 if side > 0.0 else -120.0
    for short, tripped in ((0.001, False), (-0.001, True)):
        towards = motion(law__observer__velocity=side * 200.0, law__observer__position=end - side * (distance + short))
        assert (TripCode.POSITION_LIMIT in codes(towards)) is tripped
        # At the same place with the opposite speed it has room.
        change(towards, "law__observer__velocity", -side * 200.0)
        assert TripCode.POSITION_LIMIT not in codes(towards)


@pytest.mark.parametrize(
    ("state", "watched"),
    [
        (State.HOLDING, True),
        (State.JOGGING, True),
        (State.STOPPING, True),
        (State.DISARMING, True),
        (State.TRIPPED_STOPPING, True),
        (State.QUICK_STOPPING, False),
        (State.TRIPPED_QUICK_STOP, False),
        (State.HOMING, False),
    ],
)
def test_where_position_limits_count(state: State, watched: bool) -> None:
    there = motion(law__observer__position=300.0)
    assert (codes(there, state) == [TripCode.POSITION_LIMIT]) is watched
    assert codes(there, state, referenced=False) == []
    there.blind = True
    braking = state in {State.STOPPING, State.DISARMING, State.TRIPPED_STOPPING}
    assert (codes(there, state) == [TripCode.POSITION_LIMIT]) is (watched and not braking)


def test_an_axis_that_brakes_or_looks_for_a_hard_stop_is_held_to_less() -> None:
    broken = motion(following_error=1e6, model_monitor__better_factor=0.5)
    both = [TripCode.MODEL_MISMATCH, TripCode.FOLLOWING_ERROR]
    assert codes(broken) == codes(broken, State.HOMING, method="switch") == both
    assert codes(broken, method="hard_stop") == both
    assert codes(broken, State.STOPPING) == [TripCode.MODEL_MISMATCH]  # watched while braking as well
    assert codes(broken, State.TRIPPED_STOPPING) == both  # a stop that is not followed gives way to a quick stop
    assert codes(broken, State.TRIPPED_QUICK_STOP) == [TripCode.MODEL_MISMATCH]
    assert codes(broken, State.HOMING, method="hard_stop") == []
    broken.model_monitor.better_factor = -1.0
    assert codes(broken, State.HOMING, method="hard_stop") == [TripCode.SIGN_REVERSED]
    assert codes(broken)[0] is TripCode.SIGN_REVERSED
    broken.model_monitor.better_factor = 0.0  # what a hard stop does
    assert codes(broken, State.HOMING, method="hard_stop") == []
    assert codes(broken, State.STOPPING) == [TripCode.STALL]
    broken.model_monitor.better_factor = 2.0  # which no hard stop does
    assert codes(broken, State.HOMING, method="hard_stop") == [TripCode.MODEL_MISMATCH]


def test_a_blind_axis_is_not_held_to_what_it_does_not_see() -> None:
    blind = motion(blind=True, model_monitor__better_factor=-1.0, following_error=1e6)
    assert codes(blind, State.TRIPPED_QUICK_STOP) == codes(blind, State.TRIPPED_STOPPING) == []


def test_the_cause_names_what_is_wrong() -> None:
    for changes, words in (
        ({"model_monitor__better_factor": -1.0}, "mm; the sign of encoder or effort is wrong"),
        ({"model_monitor__better_factor": 0.5}, "mm; the scale of encoder or effort is wrong"),
        (
            {"model_monitor__better_factor": 0.0, "law__observer__position": 12.5, "model_monitor__surprise": 0.625},
            "froze at 12.5 mm from one sample to the next: the model and plants like it have recently been off by 0.62",
        ),
        ({"law__observer__velocity": 400.0}, "velocity is 400 mm/s; axis.limits.overspeed is 320"),
    ):
        causes = [
            cause for _, cause in Supervision(DESIGN, motion(**changes)).violations(State.HOLDING, referenced=False)
        ]
        assert any(words in cause for cause in causes)
    for stage, words in ((Stage.SPEED, "70 mm/s cannot be reached"), (Stage.POSITION, "a load or an obstacle")):
        saturated = Supervision(DESIGN, motion(law__saturated=True, law__stage=stage, law__cruise_velocity=70.0))
        causes = [cause for _ in range(50) for _, cause in saturated.violations(State.JOGGING, referenced=True)]
        assert [cause.endswith(words) for cause in causes] == [True]


@pytest.mark.parametrize(
    ("error", "speed", "tripped"),
    [
        (10.0, 0.0, False), (-10.0, 0.0, False), (10.1, 0.0, True), (-10.1, 0.0, True), (math.nan, 0.0, True),
        (10.0, 40.0, False), (10.1, 40.0, True), (20.0, 100.0, False), (20.1, 100.0, True), (20.1, -100.0, True),
        (20.0, -100.0, False),
    ],
)  # fmt: skip
def test_the_following_error_may_be_10_mm_or_what_the_move_goes_in_200_ms(
    error: float, speed: float, tripped: bool
) -> None:
    there = motion(following_error=error, nominal__observer__velocity=speed)
    assert (codes(there) == [TripCode.FOLLOWING_ERROR]) is tripped


def test_the_speed_of_a_move_counts_until_it_is_forgotten() -> None:
    there = motion(nominal__observer__velocity=100.0, following_error=20.0)
    supervision = Supervision(DESIGN, there)
    for speed in (100.0, 3.0, 0.0):
        there.nominal.observer.velocity = speed
        assert first_tick(supervision, TripCode.FOLLOWING_ERROR, longest=1) == 0
    supervision.begin_move()
    assert first_tick(supervision, TripCode.FOLLOWING_ERROR, longest=1) == 0
    supervision.forget_move()
    assert first_tick(supervision, TripCode.FOLLOWING_ERROR) == 1
    there.following_error = 10.0
    assert first_tick(supervision, TripCode.FOLLOWING_ERROR, longest=3) == 0


def test_at_standstill_no_speed_is_left_that_would_allow_more() -> None:
    design = design_axis(axis_settings(following_error_time_s=20.0), PERIOD_S)
    assert first_tick(Supervision(design, motion(following_error=10.1)), TripCode.FOLLOWING_ERROR) == 1


@pytest.mark.parametrize(
    ("stage", "code"), [(Stage.SPEED, TripCode.SPEED_UNREACHABLE), (Stage.POSITION, TripCode.EFFORT_SATURATED)]
)
def test_an_effort_at_its_limit_trips_after_500_ms_in_a_row(stage: Stage, code: TripCode) -> None:
    there = motion(law__saturated=True, law__stage=stage)
    supervision = Supervision(DESIGN, there)
    assert first_tick(supervision, code, longest=49) == 0
    there.law.saturated = False
    assert first_tick(supervision, code, longest=1) == 0
    there.law.saturated = True
    assert first_tick(supervision, code) == 50
    supervision.start()
    assert first_tick(supervision, code) == 50


@pytest.mark.parametrize(
    ("effort", "way", "designed", "tick"),
    [
        (2.5, 0.125, 2.6, 5), (-2.5, 0.125, 2.6, 5), (2.5, 0.0, -2.6, 5),
        (2.49, 0.125, 2.6, 0), (2.5, 0.126, 2.6, 0), (2.5, 0.125, 2.5, 0),
    ],
)  # fmt: skip
def test_a_stall_is_an_effort_of_2_5_v_for_50_ms_with_no_more_way_than_at_rest(
    effort: float, way: float, designed: float, tick: int
) -> None:
    """2.5 mm/s for 50 ms are 0.125 mm."""
    there = motion(recent_way=way, nominal__observer__velocity=designed)
    supervision = Supervision(DESIGN, there)
    there.law.effort = effort
    assert first_tick(supervision, TripCode.STALL) == tick
    supervision.start()  # the load that it holds from now on does not count
    assert first_tick(supervision, TripCode.STALL) == 0


def test_a_stall_is_counted_in_a_row_and_from_the_effort_before_the_move() -> None:
    there = motion(recent_way=0.0, nominal__observer__velocity=10.0, law__effort=7.0)
    supervision = Supervision(DESIGN, there)
    there.law.effort = 4.5
    assert first_tick(supervision, TripCode.STALL, longest=4) == 0
    there.law.effort = 7.0
    assert first_tick(supervision, TripCode.STALL, longest=1) == 0
    there.law.effort = 4.5
    assert first_tick(supervision, TripCode.STALL, longest=4) == 0
    supervision.begin_move()
    there.law.effort = 2.1
    assert first_tick(supervision, TripCode.STALL) == 0
    there.law.effort = 2.0
    assert first_tick(supervision, TripCode.STALL) == 5


def test_an_encoder_that_shows_one_position_while_the_effort_changes_by_2_5_v_is_a_stall_after_50_ms() -> None:
    there = motion(unchanged_effort=2.49)
    supervision = Supervision(DESIGN, there)
    assert first_tick(supervision, TripCode.STALL) == 0
    there.unchanged_effort = 2.5
    assert first_tick(supervision, TripCode.STALL, longest=4) == 0
    there.unchanged_effort = 0.0
    assert first_tick(supervision, TripCode.STALL, longest=1) == 0
    there.unchanged_effort = 2.5
    assert first_tick(supervision, TripCode.STALL) == 5
    supervision.start()
    assert first_tick(supervision, TripCode.STALL) == 5


def test_half_the_stall_time_is_enough_where_only_a_standing_encoder_explains_the_samples() -> None:
    there = motion(unchanged_effort=2.5, model_monitor__seems_to_stand=True)
    supervision = Supervision(DESIGN, there)
    assert first_tick(supervision, TripCode.STALL) == 3
    supervision.start()
    assert first_tick(supervision, TripCode.STALL, longest=2) == 0
    there.unchanged_effort = 2.49  # friction may hold it, and its effort may just have been enough before
    assert first_tick(supervision, TripCode.STALL) == 0
    there.unchanged_effort = 2.5
    assert first_tick(supervision, TripCode.STALL, State.STOPPING) == 0


@pytest.mark.parametrize("velocity", [100.0, 0.0, -200.0])
def test_a_braking_may_take_twice_as_long_as_it_is_designed_to(velocity: float) -> None:
    there = motion(law__observer__velocity=velocity)
    supervision = Supervision(DESIGN, there)
    assert first_tick(supervision, TripCode.BRAKING_FAILED, State.STOPPING, longest=2000) == 0
    allowed = math.floor(2.0 * DESIGN.stopping_time_s(velocity, 2000.0) / PERIOD_S)
    for _ in range(2):
        supervision.begin_braking(2000.0)
        assert first_tick(supervision, TripCode.BRAKING_FAILED, State.STOPPING, longest=2000) == allowed + 1
    assert first_tick(supervision, TripCode.BRAKING_FAILED, State.HOLDING) == 0


def test_an_axis_has_arrived_after_more_than_10_ticks_in_the_window_in_a_row() -> None:
    there = motion(law__target=100.0, nominal__observer__position=100.0)
    supervision = Supervision(DESIGN, there)

    def ticks_to_arrive(position: float) -> int:
        return next((tick for tick in range(1, 40) if supervision.has_arrived(position)), 0)

    for position in (100.04, 99.96):
        supervision.begin_move()
        assert ticks_to_arrive(position) == 11
    assert not supervision.has_arrived(100.06)
    assert ticks_to_arrive(100.0) == 11
    for position in (100.06, 99.94):
        assert ticks_to_arrive(position) == 0
    for designed, arrives in ((100.04, 11), (100.06, 0), (99.96, 11), (99.94, 0)):
        supervision.begin_move()
        there.nominal.observer.position = designed
        assert ticks_to_arrive(100.0) == arrives
    there.nominal.observer.position = 100.0
    # The designed axis still moves: by the change-over time, 0.5449 s, its speed of 0.0917 mm/s is worth 0.05 mm.
    for speed, arrives in ((0.091, 11), (0.0925, 0), (-0.091, 11), (-0.0925, 0)):
        supervision.begin_move()
        there.nominal.observer.velocity = speed
        assert ticks_to_arrive(100.0) == arrives


@pytest.mark.parametrize(
    ("speed", "words"), [(40.0, "10 mm is allowed"), (100.0, "20 mm is allowed in a motion at up to 100 mm/s")]
)
def test_the_following_error_is_told_with_the_speed_where_that_allows_it(speed: float, words: str) -> None:
    """10 mm, or 0.2 s of the speed."""
    broken = motion(following_error=50.0, nominal__observer__velocity=-speed)
    (cause,) = [cause for _, cause in Supervision(DESIGN, broken).violations(State.HOLDING, referenced=False)]
    assert cause == f"the following error at 0 mm is 50 mm; {words}"
