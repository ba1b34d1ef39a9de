"""Homing, jogging, the approach from one side, and what happens to positions while nobody drives."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.messages import DriveTraits, Feedback, Reception
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.plant import Plant

SEARCH = {"velocity": 40.0, "slow_velocity": 5.0, "travel": 300.0, "position": 12.0}


def rig_with(
    homing: dict[str, Any] | None = None, approach: dict[str, Any] | None = None, period: float = 0.0, **limits: float
) -> AxisRig:
    design = design_axis(axis_settings(homing, approach, **limits), PERIOD_S)
    return AxisRig(Axis(design, replace(TRAITS, position_period=period)))


def until(
    rig: AxisRig, condition: Callable[[], bool], longest_s: float, each: Callable[[], None] = lambda: None
) -> None:
    for _ in range(round(longest_s / PERIOD_S)):
        if condition():
            return
        each()
        rig.tick()
    raise AssertionError(f"not within {longest_s} s: {rig.state()}, {rig.axis.trip}")


def refused(request: Callable[[], object]) -> str:
    with pytest.raises(Refused) as caught:
        request()
    return caught.value.code


def largest_step(rig: AxisRig) -> float:
    efforts = [command.effort for command in rig.commands]
    return max(abs(b - a) for a, b in itertools.pairwise(efforts))


# Homing --------------------------------------------------------------------------------------------------------------


def test_without_a_reference_there_are_no_set_points_but_slow_jogs() -> None:
    rig = rig_with({"required": True, **SEARCH}).armed()
    assert refused(lambda: rig.axis.move_to(10.0, 10.0)) == "not_homed"
    assert refused(lambda: rig.axis.jog(41.0)) == "velocity_limit"
    rig.axis.jog(40.0)
    until(rig, lambda: rig.position > 3.0, 2.0)
    rig.seconds(1.0)
    assert rig.state() is State.HOLDING
    rig.axis.home()  # set_here
    assert rig.axis.drive.position == pytest.approx(12.0, abs=0.01)
    rig.axis.move_to(20.0, 10.0)
    rig.seconds(5.0)
    assert rig.axis.trip is None
    assert rig.axis.drive.position == pytest.approx(20.0, abs=0.05)


@pytest.mark.parametrize("start", [0.0, -180.0])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_homing_to_a_switch_takes_the_edge_at_which_it_opens(start: float, direction: float) -> None:
    """The switch is active beyond 150 mm of travel in the direction; its edge becomes 12 mm."""
    way = "positive" if direction > 0.0 else "negative"
    rig = rig_with({"method": "switch", "direction": way, **SEARCH})
    rig.position = rig.sample = -direction * start

    def see() -> None:
        rig.inputs["home_switch"] = direction * rig.position >= 150.0

    see()
    rig.seconds(0.1)
    rig.armed()
    rig.axis.home()
    assert rig.state() is State.HOMING
    until(rig, lambda: rig.state() is not State.HOMING, 90.0, see)
    assert (rig.state(), rig.axis.trip) == (State.HOLDING, None)
    assert rig.axis.referenced
    assert rig.axis.move is not None
    assert (rig.axis.move.kind, rig.axis.move.outcome) == ("home", "reached")
    # True position minus axis position: the edge, to what 5 mm/s travel in a tick or two.
    assert rig.axis.drive.position is not None
    assert rig.sample - rig.axis.drive.position == pytest.approx(direction * 150.0 - 12.0, abs=0.15)
    assert largest_step(rig) <= 10.0 + 1e-9


def test_homing_to_a_hard_stop_never_pushes_harder_than_it_may() -> None:
    rig = rig_with({"method": "hard_stop", "direction": "positive", "effort": 3.0, **SEARCH}).armed()
    rig.axis.home()

    def stop() -> None:
        if rig.position >= 60.0:
            rig.position, rig.velocity = 60.0, min(rig.velocity, 0.0)

    until(rig, lambda: rig.state() is not State.HOMING, 60.0, stop)
    assert (rig.state(), rig.axis.trip) == (State.HOLDING, None)
    assert (
        max(abs(command.effort) for command in rig.commands) <= 3.05
    )  # what holds is the estimated load, not the limit
    assert 1.0 <= 60.0 - rig.position <= 1.25  # 20 windows of 0.05 mm off it, and the way of the stop
    assert rig.axis.drive.position == pytest.approx(rig.sample - 48.0, abs=0.01)
    move = rig.axis.move
    assert move is not None
    assert (move.target, move.outcome) == (12.0, "reached")
    assert move.start == pytest.approx(-48.0, abs=0.1)
    assert abs(rig.commands[-1].effort) < 0.05
    assert rig.axis.law.effort_limit == 24.0
    rig.axis.move_to(0.0, 50.0)
    rig.seconds(4.0)
    assert rig.position == pytest.approx(48.0, abs=0.05)


@pytest.mark.parametrize("effort", [1.5, 5.0, 10.0])
@pytest.mark.parametrize(("direction", "load"), [("positive", 0.0), ("negative", 0.5)])
def test_after_a_hard_stop_the_axis_moves_off_it(effort: float, direction: str, load: float) -> None:
    sign = 1.0 if direction == "positive" else -1.0
    rig = rig_with({"method": "hard_stop", "direction": direction, "effort": effort, "back_off": 3.0, **SEARCH})
    rig.load = load
    rig.armed()
    rig.axis.home()

    def stop() -> None:
        if sign * rig.position >= 60.0:
            rig.position, rig.velocity = sign * 60.0, sign * min(sign * rig.velocity, 0.0)

    until(rig, lambda: rig.state() is not State.HOMING, 60.0, stop)
    assert 56.75 <= sign * rig.position <= 57.0
    rig.seconds(1.0)
    rig.axis.move_to(12.0 - sign * 40.0, 100.0)
    rig.seconds(4.0)
    assert (rig.state(), rig.axis.trip) == (State.HOLDING, None)
    assert sign * rig.position == pytest.approx(20.0, abs=0.05)


@pytest.mark.parametrize("effort", [1.5, 5.0])
@pytest.mark.parametrize("velocity", [2.0, 20.0])
def test_an_encoder_the_wrong_way_round_is_noticed_in_the_search_for_a_hard_stop(
    effort: float, velocity: float
) -> None:
    search = SEARCH | {"slow_velocity": velocity}
    rig = rig_with({"method": "hard_stop", "direction": "positive", "effort": effort, **search})
    rig.sees = lambda position: -position
    rig.armed()
    rig.axis.home()
    rig.seconds(3.0)
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.SIGN_REVERSED
    assert abs(rig.position) < 2.0


def test_homing_to_an_index_mark_takes_what_the_drive_latched() -> None:
    rig = rig_with({"method": "index", "direction": "positive", **SEARCH}).armed()
    rig.axis.home()

    def see() -> None:
        if rig.position >= 33.25:
            rig.axis.drive.record_index(33.25)

    until(rig, lambda: rig.state() is not State.HOMING, 30.0, see)
    assert rig.state() is State.HOLDING
    assert rig.axis.drive.position is not None
    assert rig.sample - rig.axis.drive.position == pytest.approx(33.25 - 12.0, abs=1e-9)


def test_an_index_mark_where_the_axis_has_not_been_is_no_reference() -> None:
    """A message at another scale, or of another node: the axis was "homed" there, 900 mm off."""
    rig = rig_with({"method": "index", "direction": "positive", **SEARCH}).armed()
    rig.axis.home()
    rig.seconds(1.0)
    rig.axis.drive.record_index(900.0)
    rig.seconds(1.0)
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.HOMING_FAILED
    assert "an index mark at 900 mm" in rig.axis.trip.cause
    assert not rig.axis.reference.is_homed


def test_a_switch_that_only_flickers_is_no_reference() -> None:
    rig = rig_with({"method": "switch", "direction": "positive", **SEARCH})
    rig.inputs["home_switch"] = False
    rig.armed()
    rig.axis.home()
    rig.seconds(1.0)
    rig.inputs["home_switch"] = True
    rig.tick()
    rig.inputs["home_switch"] = False
    rig.seconds(1.0)
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.HOMING_FAILED
    assert "lower axis.homing.velocity" in rig.axis.trip.cause


def test_homing_off_a_limit_switch_works_and_into_one_is_refused() -> None:
    rig = rig_with({"method": "switch", "direction": "negative", **SEARCH})
    rig.inputs.update(home_switch=False, negative_limit=False, positive_limit=False)
    rig.armed()
    rig.axis.move_to(10.0, 50.0)
    rig.seconds(3.0)
    rig.inputs["positive_limit"] = True
    rig.axis.home()
    rig.seconds(1.0)
    assert (rig.axis.trip, rig.state()) == (None, State.HOMING)
    rig.axis.stop()
    rig.seconds(1.0)
    rig.inputs["negative_limit"] = True
    rig.tick()
    assert refused(rig.axis.home) == "limit_switch"


@pytest.mark.parametrize("method", ["switch", "index", "hard_stop"])
def test_a_reference_that_is_not_there_fails_within_the_travel(method: str) -> None:
    rig = rig_with({"method": method, "direction": "positive", **SEARCH, "travel": 30.0})
    rig.inputs["home_switch"] = False
    rig.armed()
    rig.axis.home()
    until(rig, lambda: rig.axis.trip is not None, 30.0)
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.HOMING_FAILED
    rig.seconds(1.0)
    assert rig.state() is State.TRIPPED
    assert 30.0 <= rig.position < 36.0
    assert rig.axis.law.effort_limit == 24.0


def test_a_drive_without_a_home_switch_cannot_home_to_one() -> None:
    rig = rig_with({"method": "switch", **SEARCH}).armed()
    rig.axis.home()
    rig.tick()
    assert rig.axis.trip is not None
    assert "protocol.feedback.home_switch" in rig.axis.trip.cause


@settings(max_examples=25, deadline=None)
@given(place=st.floats(-2000.0, 2000.0), load=st.floats(-2.0, 2.0))
def test_saying_where_the_axis_is_moves_nothing(place: float, load: float) -> None:
    def run(*, says: bool) -> list[float]:
        rig = AxisRig(load=load).armed().seconds(2.0)
        if says:
            rig.axis.set_position(place)
            assert rig.axis.drive.position == pytest.approx(place)
        return [rig.seconds(0.05).position for _ in range(20)]

    assert run(says=True) == pytest.approx(run(says=False), abs=1e-6)


def test_the_place_cannot_be_set_in_motion_or_to_nonsense() -> None:
    rig = AxisRig().cruising()
    assert refused(lambda: rig.axis.set_position(0.0)) == "busy"
    assert refused(lambda: AxisRig().seconds(0.1).axis.set_position(math.nan)) == "position_limit"
    coasting = AxisRig().seconds(0.1)
    coasting.tick(missed=1)  # one sample behind a gap does not tell that it moves
    assert refused(lambda: coasting.axis.set_position(0.0)) == "busy"
    coasting.tick()
    coasting.axis.set_position(0.0)
    assert refused(lambda: AxisRig(silent=True).seconds(0.1).axis.set_position(0.0)) == "no_feedback"


# Jogging -------------------------------------------------------------------------------------------------------------


def test_a_jog_lasts_as_long_as_it_is_asked_for() -> None:
    rig = AxisRig().armed()
    for _ in range(20):
        rig.axis.jog(-50.0)
        rig.seconds(0.1)
    assert rig.state() is State.JOGGING
    assert rig.velocity == pytest.approx(-50.0, abs=2.0)
    assert rig.axis.move is not None
    assert rig.axis.move.number == 1
    rig.seconds(0.19)
    assert rig.state() is State.JOGGING
    rig.seconds(0.3)
    assert rig.state() is State.HOLDING
    assert rig.axis.move.outcome == "stopped"
    assert "300 ms" in str(rig.axis.move.reason)


def test_a_jog_ends_at_the_position_limit() -> None:
    rig = AxisRig(position=2400.0, sample=2400.0).armed()
    until(rig, lambda: rig.state() is State.HOLDING and rig.axis.move is not None, 10.0, lambda: rig.axis.jog(100.0))
    assert rig.position == pytest.approx(2500.0, abs=0.05)
    assert rig.axis.trip is None
    assert refused(lambda: rig.axis.jog(1.0)) == "position_limit"
    rig.axis.jog(-1.0)


def test_a_jog_can_be_turned_round() -> None:
    rig = AxisRig().armed()
    until(rig, lambda: rig.velocity > 45.0, 3.0, lambda: rig.axis.jog(50.0))
    until(rig, lambda: rig.velocity < -45.0, 5.0, lambda: rig.axis.jog(-50.0))
    assert rig.axis.trip is None
    assert largest_step(rig) < 10.0


def test_jog_and_move_do_not_take_over_from_each_other() -> None:
    rig = AxisRig().cruising()
    assert refused(lambda: rig.axis.jog(10.0)) == "busy"
    rig = AxisRig().armed()
    rig.axis.jog(10.0)
    assert refused(lambda: rig.axis.move_to(1.0, 1.0)) == "busy"
    for velocity in (0.0, math.nan, math.inf, 251.0):
        assert refused(lambda v=velocity: rig.axis.jog(v)) == "velocity_limit"  # type: ignore[misc]


# The approach --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", ["positive", "negative"])
@pytest.mark.parametrize("target", [60.0, -60.0])
def test_every_move_ends_from_the_same_side(direction: str, target: float) -> None:
    sign = 1.0 if direction == "positive" else -1.0
    rig = rig_with(approach={"direction": direction, "distance": 5.0}).armed()
    move = rig.axis.move_to(target, 50.0)
    path = []
    until(rig, lambda: move.outcome != "moving", 30.0, lambda: path.append(rig.position))
    assert (move.outcome, move.target) == ("reached", target)
    assert rig.position == pytest.approx(target, abs=0.05)
    beyond = [position for position in path if sign * (position - target) < -4.9]
    assert beyond, "it has not been on the far side"
    last = path[path.index(beyond[-1]) :]
    assert sign * (last[-1] - last[0]) > 0.0
    rig.axis.move_by(10.0, 50.0)
    assert rig.axis.move is not None
    assert rig.axis.move.target == pytest.approx(target + 10.0)


def test_a_stop_in_the_detour_ends_the_move() -> None:
    rig = rig_with(approach={"direction": "positive", "distance": 20.0}).armed()
    move = rig.axis.move_to(-60.0, 50.0)
    rig.seconds(1.0)
    rig.axis.stop()
    rig.seconds(4.0)
    assert (rig.state(), move.outcome) == (State.HOLDING, "stopped")
    assert rig.position > -60.0


# Wrap, hands, dates --------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    steps=st.lists(st.floats(-0.49, 0.49), min_size=1, max_size=60),
    period=st.sampled_from([65.536, 65_536.0, 4_294_967.296]),
)
def test_a_counter_that_wraps_is_followed(steps: list[float], period: float) -> None:
    """Whatever the axis does between two samples, as long as it is less than half a revolution."""
    report = DriveReport(axis_settings(), PERIOD_S, DriveTraits(counter_modulus=16, position_period=period))
    true = 0.0
    for number, step in enumerate(steps):
        true += step * period
        report.begin_tick(0)
        report.accept_feedback(Feedback((true + period / 2.0) % period - period / 2.0, number % 16))
        assert report.position == pytest.approx(true, abs=1e-6 * period)


def test_a_move_through_the_end_of_the_counter_is_the_same_move() -> None:
    def path(period: float) -> list[float]:
        rig = rig_with(period=period)
        if period:
            rig.sees = lambda position: (position + period / 2.0) % period - period / 2.0
        rig.armed()
        rig.axis.move_to(400.0, 100.0)
        rig.seconds(8.0)
        assert rig.axis.trip is None
        return [command.effort for command in rig.commands]

    assert path(256.0) == pytest.approx(path(0.0), abs=1e-9)


def test_pushed_by_hand_while_disarmed_it_arms_where_it_is_without_a_jump() -> None:
    rig = AxisRig().armed()
    rig.axis.disarm()
    rig.seconds(0.1)
    for _ in range(100):
        rig.position += 1.7
        rig.tick()
    rig.seconds(0.3)
    rig.axis.arm()
    rig.seconds(1.0)
    assert rig.state() is State.HOLDING
    assert rig.position == pytest.approx(170.0, abs=0.05)
    assert max(abs(command.effort) for command in rig.commands) < 0.1


@pytest.mark.parametrize("velocity", [30.0, 150.0, -240.0])
def test_an_axis_that_moves_when_it_is_first_seen_is_tracked_at_its_speed(velocity: float) -> None:
    rig = AxisRig(velocity=velocity).seconds(0.15)
    assert rig.axis.law.observer.velocity == pytest.approx(rig.velocity, rel=0.15, abs=7.0)
    rig.seconds(0.2)
    assert rig.axis.law.observer.velocity == pytest.approx(rig.velocity, abs=2.5)
    assert rig.axis.law.observer.position == pytest.approx(rig.position, abs=0.3)


@settings(max_examples=20, deadline=None)
@given(ages=st.lists(st.floats(0.0, 0.02), min_size=50, max_size=50))
def test_samples_are_used_as_of_the_time_at_which_they_were_taken(ages: list[float]) -> None:
    """A drive that samples when it likes, and says when: at constant speed the estimate does not see it."""
    rig = AxisRig().cruising(2000.0, 100.0, for_s=3.0)
    worst = 0.0
    for age in ages:
        rig.tick_index += 1
        rig.axis.begin_tick(rig.tick_index, 0)
        rig.counter = (rig.counter + 1) % 16
        sample = rig.position - rig.velocity * age
        rig.axis.accept_feedback(Feedback(sample, rig.counter, rig.enabled), Reception(age))
        command = rig.axis.step()
        worst = max(worst, abs(rig.axis.law.observer.innovation))
        rig.sample = rig.position
        rig.move(command.effort)
    assert worst < 0.02  # without the dates up to 1 mm
    assert rig.axis.trip is None


def test_after_missed_ticks_a_sample_without_a_date_is_not_used() -> None:
    rig = AxisRig().cruising()
    predicted = rig.axis.motion.predicted
    rig.tick(missed=1)
    assert rig.axis.motion.predicted == predicted + 1
    rig.tick()
    assert rig.axis.motion.predicted == predicted + 1
    assert rig.axis.trip is None


def test_an_answer_is_not_replaced_by_what_the_drive_reports_unasked() -> None:
    report = DriveReport(axis_settings(), PERIOD_S, DriveTraits(counter_modulus=16))
    report.begin_tick(0)
    report.accept_feedback(Feedback(1.0, 1), Reception(0.01))
    report.accept_feedback(Feedback(2.0, 2, enabled=False), Reception(0.01, unasked=True))
    assert (report.position, report.enabled) == (1.0, False)
    report.begin_tick(0)
    report.accept_feedback(Feedback(3.0, 3), Reception(unasked=True))
    assert report.position == 3.0


def test_saying_where_the_axis_is_makes_no_speed() -> None:
    """The sample before counts from the new origin as well."""
    rig = AxisRig().seconds(0.1)
    rig.position = rig.sample = 5.0  # knocked just now
    rig.tick()
    assert refused(lambda: rig.axis.set_position(1000.0)) == "busy"  # it may be a spike
    rig.tick()
    rig.axis.set_position(1000.0)
    rig.position = rig.sample = 10.0  # and again
    for _ in range(5):
        rig.tick()
        assert rig.axis.law.observer.velocity == 0.0
    assert rig.axis.law.observer.position == pytest.approx(1005.0)


@pytest.mark.parametrize("missed", [1, 2])
def test_a_coasting_axis_is_armed_only_when_its_speed_is_known(missed: int) -> None:
    """Ticks that were missed let the tracking begin anew, and one sample says nothing of the speed."""
    rig = AxisRig().seconds(0.1)
    rig.plant = Plant(180.0, 2.0)
    rig.velocity = 60.0
    rig.seconds(0.05)
    rig.axis.arm()
    rig.tick()
    rig.tick(missed)
    assert rig.state() is State.ARMING
    rig.tick()
    assert rig.state() is State.STOPPING
    rig.seconds(1.0)
    assert (rig.state(), rig.axis.trip, rig.axis.referenced) == (State.HOLDING, None, True)
