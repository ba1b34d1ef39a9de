"""One axis: what the operator may ask, what the limits do, and what a trip leaves behind."""

import contextlib
import itertools
import math
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import DesignError, design_axis
from twostage_servo.axis.messages import NO_EFFORT, DriveTraits, Feedback
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.state import ENABLED, State
from twostage_servo.axis.trips import RULES, Reaction, TripCode
from twostage_servo.control.plant import Plant


def rig_with(**limits: float) -> AxisRig:
    return AxisRig(Axis(design_axis(axis_settings(None, None, **limits), PERIOD_S), TRAITS))


def refusal(rig: AxisRig, request: str, *arguments: float) -> Refused:
    with pytest.raises(Refused) as caught:
        getattr(rig.axis, request)(*arguments)
    return caught.value


def test_a_move_goes_through_its_states() -> None:
    rig = AxisRig().armed()
    move = rig.axis.move_to(400.0, 100.0)
    rig.seconds(10.0)
    seen = [state for state, before in zip(rig.states[1:], rig.states, strict=False) if state is not before]
    assert seen == [
        State.ARMING, State.HOLDING, State.SPEED_STAGE, State.POSITION_STAGE, State.HOLDING,
    ]  # fmt: skip
    assert move.outcome == "reached"
    assert rig.position == pytest.approx(400.0, abs=0.05)
    assert rig.axis.trip is None


@pytest.mark.parametrize("target", [400.0, -400.0, 5.0, 0.05, 2000.0, -2500.0])
@pytest.mark.parametrize("velocity", [100.0, 200.0, 250.0])
def test_moves_settle_without_a_trip(target: float, velocity: float) -> None:
    rig = AxisRig().armed()
    move = rig.axis.move_to(target, velocity)
    rig.seconds(abs(target) / velocity + 8.0)
    assert rig.axis.trip is None
    assert move.outcome == "reached"
    assert rig.position == pytest.approx(target, abs=0.05)


@pytest.mark.parametrize("plant", [Plant(234.0, 9.8), Plant(126.0, 18.2)], ids=["+30 %", "-30 %"])
def test_a_plant_30_percent_off_does_not_trip(plant: Plant) -> None:
    rig = AxisRig(plant=plant).armed()
    move = rig.axis.move_to(400.0, 100.0)
    rig.seconds(12.0)
    assert (rig.axis.trip, move.outcome) == (None, "reached")


def test_nothing_is_sent_before_arming_or_after_a_disarm() -> None:
    rig = AxisRig().seconds(0.5)
    assert set(rig.commands) == {NO_EFFORT}
    rig.armed()
    rig.axis.disarm()
    assert rig.tick() == NO_EFFORT


def test_arming_starts_where_the_axis_is_with_no_effort() -> None:
    rig = AxisRig()
    rig.position = rig.sample = 123.456
    rig.seconds(0.05)
    rig.axis.arm()
    first = [rig.tick() for _ in range(30)]
    assert max(abs(command.effort) for command in first) < 1e-6
    assert rig.axis.law.target == pytest.approx(123.456)


def test_arming_needs_the_drive_to_say_it_is_enabled() -> None:
    rig = AxisRig(enables=False).seconds(0.05)
    rig.axis.arm()
    rig.seconds(0.4)
    assert rig.state() is State.ARMING
    assert refusal(rig, "move_to", 10.0, 10.0).code == "busy"
    rig.seconds(0.2)
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.DRIVE_NOT_ENABLED
    assert all(command.effort == 0.0 for command in rig.commands)


def test_arming_is_refused_with_the_reason() -> None:
    assert refusal(AxisRig(silent=True).seconds(0.1), "arm").code == "no_feedback"
    assert refusal(AxisRig(fault_code=3).seconds(0.1), "arm").code == "drive_fault"
    outside = AxisRig(position=2600.0, sample=2600.0).seconds(0.1)
    assert "move it back by hand" in str(refusal(outside, "arm"))
    assert refusal(AxisRig().armed(), "arm").code == "already_armed"


@pytest.mark.parametrize("target", [2500.1, -2501.0, math.nan, math.inf, 1e300])
def test_a_set_point_outside_the_limits_is_refused_and_changes_nothing(target: float) -> None:
    rig = AxisRig().cruising()
    assert refusal(rig, "move_to", target, 100.0).code == "position_limit"
    assert rig.axis.law.target == 400.0
    assert rig.state() is State.SPEED_STAGE


@pytest.mark.parametrize("velocity", [0.0, -1.0, 250.1, math.nan, math.inf])
def test_a_velocity_outside_the_limits_is_refused(velocity: float) -> None:
    assert refusal(AxisRig().armed(), "move_to", 10.0, velocity).code == "velocity_limit"


def test_a_disarmed_axis_does_not_move() -> None:
    rig = AxisRig().seconds(0.1)
    for request, arguments in (("move_to", (10.0, 10.0)), ("move_by", (10.0, 10.0)), ("stop", ())):
        assert refusal(rig, request, *arguments).code == "disarmed"


def test_relative_moves_add_up_exactly() -> None:
    rig = AxisRig().armed()
    for _ in range(3):
        rig.axis.move_by(100.0, 100.0)
        rig.seconds(0.3)
    assert rig.axis.law.target == pytest.approx(300.0, abs=1e-9)
    rig.seconds(10.0)
    assert rig.position == pytest.approx(300.0, abs=0.05)


def test_a_new_set_point_replaces_the_move() -> None:
    rig = AxisRig().cruising()
    first = rig.axis.move
    second = rig.axis.move_to(0.0, 50.0)
    assert first is not None
    assert (first.outcome, second.outcome, second.number) == ("replaced", "moving", first.number + 1)
    rig.seconds(12.0)
    assert second.outcome == "reached"


def test_stop_comes_to_rest_and_holds() -> None:
    rig = AxisRig().cruising()
    at = rig.position
    rig.axis.stop()
    assert rig.state() is State.STOPPING
    rig.seconds(1.0)
    assert rig.state() is State.HOLDING
    assert rig.axis.move is not None
    assert rig.axis.move.outcome == "stopped"
    assert at + 1.25 < rig.position < at + rig.axis.design.stopping_distance(100.0, 2000.0)
    rig.seconds(3.0)
    assert abs(rig.velocity) < 0.01


def test_disarm_in_mid_move_brakes_before_it_disables() -> None:
    rig = AxisRig().cruising()
    rig.axis.disarm()
    before = len(rig.commands)
    rig.seconds(1.0)
    braking = [command for command in rig.commands[before:] if command.enable]
    assert 5 <= len(braking) <= 30  # 100 mm/s at 2000 mm/s2 take five ticks
    assert rig.state() is State.DISARMED
    assert abs(rig.velocity) < 2.0


def test_a_braking_that_takes_too_long_can_be_ended() -> None:
    rig = AxisRig().cruising()
    rig.axis.disarm()
    rig.tick()
    rig.axis.end_braking()
    assert rig.state() is State.DISARMED
    assert rig.tick() == NO_EFFORT


# Limits and trips ----------------------------------------------------------------------------------------------------


def trip_of(rig: AxisRig) -> TripCode:
    assert rig.axis.trip is not None
    return rig.axis.trip.code


def cause_of(rig: AxisRig) -> str:
    assert rig.axis.trip is not None
    return rig.axis.trip.cause


def test_stale_feedback_is_met_by_a_quick_stop_on_the_model() -> None:
    rig = AxisRig().cruising()
    rig.silent = True
    rig.seconds(0.02)
    assert rig.axis.move is not None
    assert rig.axis.move.outcome == "moving"
    rig.tick()
    assert trip_of(rig) is TripCode.STALE_FEEDBACK
    assert rig.state() is State.TRIPPED_QUICK_STOP
    rig.seconds(0.2)
    assert rig.state() is State.TRIPPED
    assert rig.commands[-1] == NO_EFFORT
    assert abs(rig.velocity) < 1.0  # the model brakes as well as the feedback would
    assert "for 30 ms" in cause_of(rig)


def test_one_lost_frame_is_bridged() -> None:
    rig = AxisRig().cruising()
    rig.silent = True
    rig.seconds(0.02)
    rig.silent = False
    rig.seconds(8.0)
    assert rig.axis.trip is None
    assert rig.position == pytest.approx(400.0, abs=0.05)


def test_a_frozen_encoder_is_noticed_within_two_samples_at_speed() -> None:
    rig = AxisRig().cruising()
    at, frozen = rig.position, rig.sample
    rig.sees = lambda _: frozen
    rig.seconds(0.5)
    assert trip_of(rig) is TripCode.POSITION_JUMP
    assert rig.state() is State.TRIPPED
    assert rig.position - at < 8.0
    assert rig.axis.move is not None
    assert rig.axis.move.outcome == "tripped"


def test_an_encoder_turned_round_is_stopped_within_a_millimetre() -> None:
    rig = AxisRig()
    rig.sees = lambda position: -position
    rig.armed()
    rig.axis.move_to(400.0, 100.0)
    rig.seconds(2.0)
    assert rig.axis.trip is not None
    assert rig.state() is State.TRIPPED
    assert trip_of(rig) is TripCode.SIGN_REVERSED
    assert abs(rig.position) < 2.0


def test_a_load_that_the_effort_cannot_hold_trips_on_saturation() -> None:
    rig = rig_with(following_error_minimum=1e6, innovation_gate=1e3)
    rig.cruising()
    rig.load = 16.5
    rig.seconds(4.0)
    assert trip_of(rig) is TripCode.SPEED_UNREACHABLE
    assert "500 ms" in cause_of(rig)
    rig.seconds(1.0)
    rig = rig_with(following_error_minimum=1e6, innovation_gate=1e3).armed()
    rig.load = 26.0
    rig.seconds(4.0)
    assert trip_of(rig) is TripCode.EFFORT_SATURATED


def test_overspeed_disables_at_once() -> None:
    rig = rig_with(following_error_minimum=1e6, innovation_gate=1e3)
    rig.cruising(2000.0, 250.0)
    rig.load = -20.0
    rig.seconds(1.0)
    assert trip_of(rig) is TripCode.OVERSPEED
    tripped = rig.states.index(State.TRIPPED)
    assert State.TRIPPED_QUICK_STOP not in rig.states
    assert all(command == NO_EFFORT for command in rig.commands[tripped:])


def test_leaving_the_position_limits_trips() -> None:
    rig = rig_with(following_error_minimum=1e6, effort_saturation_ms=60_000.0, innovation_gate=1e3)
    rig.armed()
    rig.axis.move_to(2500.0, 250.0)
    rig.seconds(14.0)
    rig.load = -26.0
    rig.seconds(3.0)
    assert trip_of(rig) is TripCode.POSITION_LIMIT


def test_a_position_that_is_not_a_number_counts_as_a_rejected_frame() -> None:
    rig = AxisRig().cruising()
    rig.sees = lambda _: math.nan
    rig.sample = math.nan
    rig.tick()
    assert (rig.axis.trip, rig.axis.drive.monitor.rejected) == (None, 1)
    rig.seconds(0.02)
    assert trip_of(rig) is TripCode.STALE_FEEDBACK


def test_a_drive_fault_and_a_drive_that_drops_out_disable() -> None:
    rig = AxisRig().cruising()
    rig.fault_code = 7
    rig.tick()
    assert trip_of(rig) is TripCode.DRIVE_FAULT
    assert "7" in cause_of(rig)
    rig = AxisRig().cruising()
    rig.enabled = False
    rig.tick()
    assert trip_of(rig) is TripCode.DRIVE_DROPPED_OUT


def test_too_many_missed_ticks_trip_and_a_few_do_not() -> None:
    rig = AxisRig().cruising()
    rig.tick(missed=2)
    rig.seconds(0.5)
    assert rig.axis.trip is None
    rig = rig_with(stale_feedback_ms=1000.0)
    rig.cruising()
    rig.tick(missed=6)
    assert trip_of(rig) is TripCode.MISSED_TICKS
    assert rig.state() is State.TRIPPED_QUICK_STOP
    rig.seconds(1.0)
    assert rig.state() is State.TRIPPED


def test_a_trip_is_latched_until_reset_and_then_needs_arming() -> None:
    rig = AxisRig().cruising()
    rig.axis.raise_trip(TripCode.BUS_FAILED, "pulled")
    rig.seconds(0.2)
    for request, arguments in (("arm", ()), ("move_to", (10.0, 10.0)), ("stop", ())):
        assert refusal(rig, request, *arguments).code == "tripped"
    rig.axis.reset()
    assert rig.state() is State.DISARMED
    assert rig.axis.trip is None
    rig.seconds(0.2)
    assert rig.commands[-1] == NO_EFFORT
    assert refusal(rig, "move_to", 10.0, 10.0).code == "disarmed"


def test_the_first_trip_stays_and_the_more_severe_reaction_wins() -> None:
    rig = AxisRig().cruising()
    rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "first")
    assert rig.state() is State.TRIPPED_QUICK_STOP
    assert refusal(rig, "reset").code == "busy"
    rig.axis.raise_trip(TripCode.OVERSPEED, "second")
    assert rig.state() is State.TRIPPED
    assert cause_of(rig) == "first"
    assert rig.axis.escalation is not None
    assert rig.axis.escalation.cause == "second"
    assert rig.tick() == NO_EFFORT


def test_a_quick_stop_brakes_harder_than_a_stop() -> None:
    def braking_distance(request: str) -> float:
        rig = AxisRig().cruising(2000.0, 250.0)
        at = rig.position
        if request == "stop":
            rig.axis.stop()
        else:
            rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "test")
        rig.seconds(3.0)
        return rig.position - at

    assert 0.0 < braking_distance("trip") < braking_distance("stop")


def test_a_trip_while_disarmed_changes_nothing() -> None:
    rig = AxisRig().seconds(0.1)
    rig.axis.raise_trip(TripCode.BUS_FAILED, "pulled")
    assert (rig.axis.state, rig.axis.trip) == (State.DISARMED, None)


def test_every_trip_says_what_to_do_next() -> None:
    assert set(RULES) == set(TripCode)
    for code, rule in RULES.items():
        assert rule.reaction in Reaction, code
        assert "reset" in rule.next_action or "started again" in rule.next_action, code


@settings(max_examples=60, deadline=None)
@given(
    requests=st.lists(
        st.one_of(
            st.tuples(st.just("move_to"), st.floats(-3000.0, 3000.0), st.floats(1.0, 300.0)),
            st.tuples(st.sampled_from(["arm", "disarm", "stop", "reset"])),
            st.tuples(st.just("silence"), st.booleans()),
            st.tuples(st.just("load"), st.floats(-30.0, 30.0)),
            st.tuples(st.just("missed"), st.integers(0, 8)),
        ),
        max_size=25,
    )
)
def test_whatever_happens_the_effort_stays_in_its_limits(requests: list[tuple[object, ...]]) -> None:
    rig = AxisRig().seconds(0.05)
    for name, *arguments in requests:
        missed = 0
        if name == "silence":
            rig.silent = bool(arguments[0])
        elif name == "load":
            rig.load = float(arguments[0])  # type: ignore[arg-type]
        elif name == "missed":
            missed = int(arguments[0])  # type: ignore[call-overload]
        else:
            with contextlib.suppress(Refused):
                getattr(rig.axis, str(name))(*arguments)
        rig.tick(missed)
        rig.seconds(0.3)
    for command, state in zip(rig.commands, rig.states, strict=True):
        assert math.isfinite(command.effort)
        assert abs(command.effort) <= 24.0
        assert command.enable == (state in ENABLED)
        if not command.enable or state is State.ARMING:
            assert command.effort == 0.0


# What must not be taken out unnoticed --------------------------------------------------------------------


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_limits_hold_in_both_directions(direction: float) -> None:
    fast = rig_with(following_error_minimum=1e6, innovation_gate=1e3).cruising(direction * 2000.0, 250.0)
    fast.load = direction * -20.0
    fast.seconds(1.0)
    assert trip_of(fast) is TripCode.OVERSPEED
    held = rig_with(innovation_gate=1e3).cruising(direction * 400.0)
    held.load = direction * 20.0
    held.seconds(1.0)
    assert trip_of(held) is TripCode.FOLLOWING_ERROR
    pushed = rig_with(following_error_minimum=1e6, effort_saturation_ms=60_000.0, innovation_gate=1e3).armed()
    pushed.axis.move_to(direction * 2500.0, 250.0)
    pushed.seconds(14.0)
    pushed.load = direction * -26.0
    pushed.seconds(3.0)
    assert trip_of(pushed) is TripCode.POSITION_LIMIT


def test_missed_ticks_are_predicted_by_law_and_nominal() -> None:
    """Five blind ticks at 250 mm/s are 12.5 mm; neither the estimate nor the following error may show them."""
    rig = rig_with(stale_feedback_ms=1000.0).cruising(2000.0, 250.0)
    rig.tick(missed=5)
    assert abs(rig.axis.following_error) < 0.5
    assert rig.axis.law.observer.position == pytest.approx(rig.position - 2.5, abs=1.0)


def test_the_changeover_does_not_count_against_the_following_error() -> None:
    """A plant 30 % off is 10 mm away when the speed stage ends; the position stage begins with none."""
    rig = AxisRig(plant=Plant(126.0, 18.2)).cruising()
    while rig.state() is State.SPEED_STAGE:
        before = rig.axis.following_error
        rig.tick()
    assert abs(before) > 5.0
    assert rig.axis.following_error == 0.0


def test_after_arriving_no_more_than_the_minimum_is_allowed() -> None:
    rig = rig_with(following_error_minimum=3.0)
    rig.cruising()
    rig.seconds(9.0)
    assert rig.state() is State.HOLDING
    rig.load = 1.5  # sags by 1.5 / 0.378 = 4 mm, far less than the 20 mm of the move
    rig.seconds(1.0)
    assert trip_of(rig) is TripCode.FOLLOWING_ERROR
    assert cause_of(rig).endswith("; 3 mm is allowed")  # whatever speed the load gives it


def test_a_following_error_of_a_move_is_told_with_the_speed_that_allows_it() -> None:
    rig = rig_with(following_error_minimum=1.0, following_error_time_s=0.02)
    rig.cruising(400.0, 200.0, for_s=1.0)
    rig.load = 5.0
    rig.seconds(1.0)
    assert trip_of(rig) is TripCode.FOLLOWING_ERROR
    assert re.search(r"; 4\.\d+ mm is allowed in a motion at up to 20\d\.\d mm/s$", cause_of(rig))


def test_arming_waits_for_an_answer_to_the_enable_command() -> None:
    rig = AxisRig().seconds(0.05)
    rig.enabled = False
    rig.axis.arm()
    rig.tick()
    assert rig.state() is State.ARMING
    rig.silent = True
    rig.tick()
    assert rig.state() is State.ARMING
    rig.silent = False
    rig.tick()
    assert rig.state() is State.HOLDING


def test_disarm_and_arm_within_a_tick_do_not_skip_the_disabling() -> None:
    rig = AxisRig().armed()
    rig.load = 2.0
    rig.seconds(3.0)
    rig.axis.disarm()
    assert refusal(rig, "arm").code == "still_enabled"
    rig.seconds(0.03)
    assert rig.commands[-3:] == [NO_EFFORT] * 3
    rig.axis.arm()


@pytest.mark.parametrize("velocity", [150.0, -40.0])
def test_arming_a_moving_axis_catches_it(velocity: float) -> None:
    rig = AxisRig(velocity=velocity).seconds(0.05)
    coasting = rig.velocity
    rig.axis.arm()
    rig.seconds(0.03)
    assert rig.state() is State.STOPPING
    assert abs(rig.velocity) < abs(coasting)
    rig.seconds(1.0)
    assert rig.state() is State.HOLDING
    assert rig.axis.trip is None
    efforts = [command.effort for command in rig.commands]
    assert max(abs(after - before) for before, after in itertools.pairwise(efforts)) < 10.0 + 1e-9  # 1000 V/s


def test_a_fault_is_not_overwritten_by_a_later_frame_of_the_same_tick() -> None:
    rig = AxisRig().cruising()
    rig.axis.begin_tick(rig.tick_index + 1, 0)
    rig.axis.accept_feedback(Feedback(rig.sample, rig.counter + 1, enabled=False, fault_code=7))
    rig.axis.accept_feedback(Feedback(rig.sample, rig.counter + 2, enabled=True))
    assert rig.axis.step() == NO_EFFORT
    assert trip_of(rig) is TripCode.DRIVE_FAULT


def test_after_the_bus_was_lost_the_position_is_unknown() -> None:
    rig = AxisRig().seconds(0.1)
    rig.axis.drive.forget()
    assert rig.axis.drive.position is None
    assert rig.axis.drive.is_stale
    assert refusal(rig, "arm").code == "no_feedback"


def test_after_a_result_that_is_no_number_the_observer_starts_afresh() -> None:
    rig = AxisRig().cruising()
    rig.axis.law.observer.velocity = math.nan
    rig.tick()
    assert trip_of(rig) is TripCode.NOT_FINITE
    rig.seconds(0.5)
    rig.axis.reset()
    rig.axis.arm()
    rig.seconds(1.0)
    assert rig.state() is State.HOLDING
    assert math.isfinite(rig.axis.law.observer.velocity)


def test_a_drive_mounted_the_other_way_round() -> None:
    turned = axis_settings().model_dump(exclude_unset=True)
    turned["plant"]["gain"] = -180.0
    axis = Axis(design_axis(AxisSettings.model_validate(turned), PERIOD_S), DriveTraits(counter_modulus=16))
    rig = AxisRig(axis, Plant(-180.0, 14.0)).cruising(for_s=8.0)
    assert rig.axis.trip is None
    assert rig.position == pytest.approx(400.0, abs=0.05)
    assert min(command.effort for command in rig.commands) < -7.0


# Design --------------------------------------------------------------------------------------------------------------


def changed(path: str, value: object) -> AxisSettings:
    table, key = path.split(".")
    settings_dump = axis_settings().model_dump(exclude_unset=True)
    settings_dump.setdefault(table, {})[key] = value
    return AxisSettings.model_validate(settings_dump)


@pytest.mark.parametrize(
    ("path", "value", "key", "said"),
    [
        ("limits.effort", 10.0, ("axis", "limits", "effort"), "lower the velocity limit below 128.571"),
        (
            "law.performance_index_ratio",
            10.0,
            ("axis", "law", "performance_index_ratio"),
            "speed stage would be unstable",
        ),
    ],
)
def test_an_axis_that_cannot_work_is_refused_with_its_key(
    path: str, value: object, key: tuple[str, ...], said: str
) -> None:
    with pytest.raises(DesignError, match=said) as caught:
        design_axis(changed(path, value), PERIOD_S)
    assert caught.value.key == key


def test_the_design_of_the_demo_is_example_1() -> None:
    design = design_axis(axis_settings(), PERIOD_S)
    assert f"{design.changeover_distance(100.0):.1f}" == "54.5"
