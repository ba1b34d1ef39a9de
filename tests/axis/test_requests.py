"""What each request leaves behind at once: the move with its numbers, its outcome, the deceleration, the refusal."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from tests.axis.rig import PERIOD_S, AxisRig, axis_settings
from tests.axis.test_modes import refused, rig_with, until
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.axis.moves import Move
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import ENABLED, Event, State, next_state
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.laws.law import Stage

REQUESTS: dict[Event, Callable[[Axis], object]] = {
    Event.ARM: lambda axis: axis.arm(),
    Event.DISARM: lambda axis: axis.disarm(),
    Event.MOVE_SPEED: lambda axis: axis.move_to(200.0, 100.0),
    Event.JOG: lambda axis: axis.jog(10.0),
    Event.HOME: lambda axis: axis.home(),
    Event.STOP: lambda axis: axis.stop(),
    Event.QUICK_STOP: lambda axis: axis.stop(quick=True),
    Event.RESET: lambda axis: axis.reset(),
}
SEARCH: dict[str, Any] = {"method": "index", "velocity": 40.0, "slow_velocity": 5.0, "travel": 300.0, "position": 12.0}


def decelerations(rig: AxisRig, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return a list to which each braking from now on adds its deceleration; only an ordinary one may be smooth."""
    begun: list[float] = []
    stop = rig.axis.motion.stop

    def noted(deceleration: float, *, smooth: bool) -> None:
        assert smooth is (deceleration == 2000.0 and rig.axis.trip is None)
        begun.append(deceleration)
        stop(deceleration, smooth=smooth)

    monkeypatch.setattr(rig.axis.motion, "stop", noted)
    return begun


@pytest.mark.parametrize("state", list(State))
@pytest.mark.parametrize("event", list(REQUESTS))
def test_a_request_is_refused_in_those_states_alone_in_which_the_table_lists_no_such_event(
    event: Event, state: State
) -> None:
    rig = rig_with(SEARCH | {"required": False})
    rig = rig.armed() if state in ENABLED else rig.seconds(0.1)
    rig.axis.machine.state = state
    if next_state(state, event) is None:
        with pytest.raises(Refused):
            REQUESTS[event](rig.axis)
    else:
        REQUESTS[event](rig.axis)
    assert rig.state() is (next_state(state, event) or state)


def test_a_move_is_kept_with_its_numbers() -> None:
    rig = AxisRig(position=7.0, sample=7.0).armed()
    move = rig.axis.move_to(200.0, 100.0)
    assert move == Move(1, "move", 200.0, 100.0, pytest.approx(7.0))  # type: ignore[arg-type]
    assert rig.axis.move is move
    rig.seconds(0.2)
    second = rig.axis.move_by(-50.0, 20.0)
    assert (second.number, second.kind, second.target, second.velocity) == (2, "move", 150.0, 20.0)
    assert (move.outcome, move.reason, second.outcome) == ("replaced", None, "moving")


def test_a_jog_and_a_search_are_kept_as_moves() -> None:
    rig = rig_with(SEARCH).armed()
    rig.axis.jog(-10.0)
    first = rig.axis.move
    assert first is not None
    assert (first.number, first.kind, first.target, first.velocity) == (1, "jog", -2500.0, -10.0)
    rig.axis.jog(-10.0)  # renewed, it is the same
    assert rig.axis.move is first
    rig.axis.jog(-11.0)
    assert rig.axis.move is not first
    assert first.outcome == "replaced"
    until(rig, lambda: rig.state() is State.HOLDING, 2.0)
    rig.axis.home()
    move = rig.axis.move
    assert move is not None
    assert (move.number, move.kind, move.target, move.velocity) == (3, "home", 12.0, 40.0)


@pytest.mark.parametrize("armed", [True, False])
def test_a_position_that_is_declared_is_kept_as_a_homing_in_place_of_the_move_before(*, armed: bool) -> None:
    rig = AxisRig().armed()
    rig.axis.move_to(30.0, 100.0)
    until(rig, lambda: rig.state() is State.HOLDING, 5.0)
    if not armed:
        rig.axis.disarm()
        rig.seconds(0.1)
    stands_at = rig.axis.drive.position
    assert stands_at is not None
    rig.axis.set_position(500.0)
    move = rig.axis.move
    assert move is not None
    assert (move.number, move.kind, move.target, move.velocity, move.outcome) == (2, "home", 500.0, 0.0, "reached")
    assert move.start == pytest.approx(500.0, abs=0.1)
    if armed:
        assert rig.axis.set_point == pytest.approx(30.0 + 500.0 - stands_at)


def test_a_jog_without_a_reference_goes_as_far_as_an_hour_takes() -> None:
    rig = rig_with({"required": True}, velocity=250.0)
    rig.position = rig.sample = 5.0
    rig.armed().axis.jog(-10.0)
    assert rig.axis.move is not None
    assert rig.axis.move.target == pytest.approx(5.0 - 36_000.0)
    assert rig.axis.law.cruise_velocity == 10.0


def test_a_slow_jog_goes_the_way_of_its_sign_and_is_refused_at_the_window_of_its_limit() -> None:
    for side in (1.0, -1.0):
        for short, code in ((0.06, ""), (0.04, "position_limit")):
            rig = AxisRig(position=side * (2500.0 - short), sample=side * (2500.0 - short)).armed()
            rig.axis.law.observer.position = side * (2500.0 - short)
            if code:
                assert refused(lambda axis=rig.axis, v=side: axis.jog(0.5 * v)) == code  # type: ignore[misc]
            else:
                rig.axis.jog(0.5 * side)
                assert rig.axis.law.target == side * 2500.0


def test_a_disarming_brakes_at_once_with_the_deceleration_of_a_stop_and_only_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = AxisRig().cruising(for_s=0.5)
    begun, move = decelerations(rig, monkeypatch), rig.axis.move
    for _ in range(3):
        rig.axis.disarm()
        rig.tick()
    assert (begun, rig.state()) == ([2000.0], State.DISARMING)
    assert move is not None
    assert (move.outcome, move.reason) == ("stopped", None)
    rig.axis.stop()
    assert begun == [2000.0]
    rig.axis.stop(quick=True)
    assert (begun, rig.state()) == ([2000.0, 4000.0], State.DISARMING)


def test_an_axis_that_brakes_to_be_disarmed_says_when_it_can_be_armed() -> None:
    rig = AxisRig().cruising(for_s=0.5)
    rig.axis.disarm()
    with pytest.raises(Refused, match=r"^the axis brakes to be disarmed: `arm` it once it is\.$") as told:
        rig.axis.arm()
    assert told.value.code is RefusalCode.BUSY
    while rig.state() is State.DISARMING:
        rig.tick()
    rig.armed()


def test_a_disarming_keeps_the_deceleration_of_a_quick_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = AxisRig().cruising(for_s=0.5)
    begun = decelerations(rig, monkeypatch)
    rig.axis.stop("by hand", quick=True)
    rig.tick()
    rig.axis.stop(quick=True)
    rig.axis.stop()
    assert (begun, rig.state()) == ([4000.0], State.QUICK_STOPPING)
    assert rig.axis.move is not None
    assert (rig.axis.move.outcome, rig.axis.move.reason) == ("stopped", "by hand")
    rig.axis.disarm()
    assert begun == [4000.0, 4000.0]


def test_an_axis_that_holds_does_not_brake_for_a_quick_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = AxisRig().armed()
    begun = decelerations(rig, monkeypatch)
    rig.axis.stop(quick=True)
    assert (begun, rig.state(), rig.axis.law.stage) == ([], State.HOLDING, Stage.POSITION)


def test_a_stop_brakes_once_and_a_quick_stop_takes_over(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = AxisRig().cruising(for_s=0.5)
    begun = decelerations(rig, monkeypatch)
    for quick in (False, False, True, False):
        rig.axis.stop(quick=quick)
        rig.tick()
    assert begun == [2000.0, 4000.0]
    rig.seconds(2.0)
    rig.axis.stop()
    rig.axis.stop(quick=True)
    assert (begun, rig.state()) == ([2000.0, 4000.0], State.HOLDING)
    rig.axis.disarm()
    assert (begun, rig.state()) == ([2000.0, 4000.0], State.DISARMED)


def test_a_tripped_axis_refuses_each_request_as_tripped() -> None:
    rig = rig_with(SEARCH).armed()
    rig.axis.raise_trip(TripCode.DRIVE_FAULT, "as a test")
    axis = rig.axis
    for request in (
        axis.arm,
        axis.home,
        axis.stop,
        lambda: axis.move_to(1.0, 1.0),
        lambda: axis.move_by(1.0, 1.0),
        lambda: axis.jog(1.0),
        lambda: axis.set_position(1.0),
    ):
        assert refused(request) == "tripped"
    axis.disarm()
    assert axis.state is State.TRIPPED
    axis.reset()
    assert (axis.state, axis.trip, axis.trips) == (State.DISARMED, None, {})
    axis.reset()  # again it does no harm
    rig.armed()
    assert refused(axis.reset) == "not_tripped"
    assert refused(axis.arm) == "already_armed"
    axis.move_to(100.0, 100.0)
    rig.seconds(0.3)
    axis.raise_trip(TripCode.FOLLOWING_ERROR, "as a test")
    assert refused(axis.reset) == "busy"


def test_the_way_is_judged_from_where_the_axis_is() -> None:
    rig = AxisRig(position=100.0, sample=100.0).armed()
    rig.inputs = {"negative_limit": True}
    rig.tick()
    assert refused(lambda: rig.axis.move_to(50.0, 10.0)) == "limit_switch"
    rig.axis.move_to(150.0, 10.0)
    rig = AxisRig(position=-100.0, sample=-100.0).armed()
    rig.inputs = {"positive_limit": True}
    rig.tick()
    assert refused(lambda: rig.axis.move_to(-50.0, 10.0)) == "limit_switch"
    rig.axis.move_to(-150.0, 10.0)


@pytest.mark.parametrize(
    ("direction", "target", "first"),
    [
        ("either", 90.0, 90.0), ("either", 110.0, 110.0),
        ("positive", 100.5, 100.5), ("positive", 99.5, 96.5), ("positive", 50.0, 47.0), ("positive", -2499.0, -2500.0),
        ("negative", 99.5, 99.5), ("negative", 100.5, 103.5), ("negative", 150.0, 153.0), ("negative", 2499.0, 2500.0),
        ("negative", -50.0, -50.0), ("positive", -50.0, -53.0),
    ],
)  # fmt: skip
def test_a_move_that_would_end_from_the_other_side_first_goes_3_mm_past_its_end_but_no_limit(
    direction: str, target: float, first: float
) -> None:
    rig = rig_with(approach={"direction": direction, "distance": 3.0})
    rig.position = rig.sample = 100.0
    rig.armed()
    rig.axis.law.observer.position = 100.0
    move = rig.axis.move_to(target, 20.0)
    assert (move.target, rig.axis.law.target) == (target, first)
    # A step is counted from the set-point in force, not from the end of the detour.
    if abs(target) < 2000.0:
        assert rig.axis.move_by(1.0, 20.0).target == target + 1.0


def test_at_the_set_point_itself_a_move_comes_from_the_right_side_too() -> None:
    for direction, first in (("positive", -3.0), ("negative", 3.0)):
        rig = rig_with(approach={"direction": direction, "distance": 3.0}).armed()
        rig.axis.law.observer.position = 0.0
        rig.axis.move_to(0.0, 20.0)
        assert rig.axis.law.target == first


def test_a_drive_that_has_a_heartbeat_is_not_armed_before_one() -> None:
    rig = AxisRig(
        Axis(design_axis(axis_settings(), PERIOD_S), DriveTraits(counter_modulus=16, has_heartbeat=True))
    ).seconds(0.05)
    assert refused(rig.axis.arm) == "heartbeat_lost"
    rig.axis.record_heartbeat(1)
    rig.armed()


@pytest.mark.parametrize(("resolution", "another"), [(0.3, False), (0.0, True)])
def test_less_than_one_and_a_half_steps_of_the_encoder_is_no_other_position(resolution: float, another: bool) -> None:
    """0.4 mm where a step is 0.3 mm; up to 0.5 mm is believed."""
    rig = AxisRig(
        Axis(design_axis(axis_settings(), PERIOD_S), DriveTraits(counter_modulus=16, position_quantum=resolution))
    ).armed()
    rig.axis.move_to(100.0, 100.0)
    rig.sees = lambda _: 0.0
    for _ in range(3):
        rig.tick()
    assert rig.axis.motion.unchanged_effort > 0.0
    rig.sample = 0.4
    rig.tick()
    assert rig.axis.motion.implausible == 0
    assert (rig.axis.motion.unchanged_effort == 0.0) is another


def test_a_move_to_where_the_axis_stands_is_reached_after_the_time_of_the_window_once() -> None:
    """100 ms, and the tick in which they are over."""
    rig = AxisRig().armed()
    move = rig.axis.move_to(0.0, 100.0)
    outcomes = [(rig.tick(), move.outcome)[1] for _ in range(11)]
    assert outcomes == ["moving"] * 10 + ["reached"]


def test_a_jog_that_has_ended_can_be_asked_for_again() -> None:
    rig = AxisRig().armed()
    for _ in range(2):
        rig.axis.jog(10.0)
        assert rig.state() is State.JOGGING
        until(rig, lambda: rig.state() is State.HOLDING, 2.0)


def test_a_stop_while_arming_brakes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = AxisRig().seconds(0.05)
    begun = decelerations(rig, monkeypatch)
    rig.axis.arm()
    rig.axis.stop()
    assert (begun, rig.state()) == ([], State.DISARMED)


def test_arming_waits_for_its_time_and_the_tick_after_each_request() -> None:
    """500 ms are 50 ticks: in the 51st the drive has not answered in time."""
    rig = AxisRig(enables=False).seconds(0.05)
    for _ in range(2):
        rig.axis.arm()
        states = [(rig.tick(), rig.state())[1] for _ in range(51)]
        assert states == [State.ARMING] * 50 + [State.TRIPPED]
        assert rig.axis.trip is not None
        assert rig.axis.trip.code is TripCode.DRIVE_NOT_ENABLED
        rig.seconds(0.05)
        rig.axis.reset()
    rig.enables = True
    rig.axis.arm()
    assert [(rig.tick(), rig.state())[1] for _ in range(2)] == [State.ARMING, State.HOLDING]
    assert math.isfinite(rig.axis.law.effort)


def test_a_move_that_is_ended_by_disarming_keeps_the_reason() -> None:
    rig = AxisRig().cruising()
    rig.axis.disarm("the service is ending")
    assert rig.axis.move is not None
    assert (rig.axis.move.outcome, rig.axis.move.reason) == ("stopped", "the service is ending")
