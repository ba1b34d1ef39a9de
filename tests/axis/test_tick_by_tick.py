"""What an axis does by itself in a tick: counts, time-outs, trips and what they leave, switches, the reference."""

import pytest

from tests.axis.rig import PERIOD_S, AxisRig, axis_settings
from tests.axis.test_modes import rig_with, until
from tests.axis.test_requests import decelerations
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.messages import NO_EFFORT, Command, DriveTraits, Feedback
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import RULES, Reaction, Trip, TripCode
from twostage_servo.control.laws.law import Stage


def axis_with(*, required: bool = False, position: float = 0.0) -> Axis:
    return Axis(
        design_axis(axis_settings({"required": required, "position": position}), PERIOD_S),
        DriveTraits(counter_modulus=16),
    )


def tripped(rig: AxisRig) -> TripCode | None:
    return None if rig.axis.trip is None else rig.axis.trip.code


def test_a_new_axis_is_disarmed_and_knows_nothing() -> None:
    axis = axis_with()
    assert (axis.state, axis.trip, axis.escalation, axis.trips, axis.move) == (State.DISARMED, None, None, {}, None)
    assert [axis.referenced, axis.ready_to_arm] == [True, False]
    assert [axis_with(required=True).referenced] == [False]
    assert axis.following_error == 0.0
    assert axis.law is axis.motion.law


def test_an_axis_may_be_armed_in_the_second_disabled_tick_in_which_it_is_seen() -> None:
    rig = AxisRig()
    assert (rig.axis.ready_to_arm, rig.axis.cia402_state) == (False, "switch on disabled")
    rig.tick()
    assert rig.axis.obstacle_to_arming() == ("still_enabled", "the drive is still being disabled: try again.")
    assert rig.axis.cia402_state == "switch on disabled"
    rig.tick()
    assert (rig.axis.ready_to_arm, rig.axis.cia402_state) == (True, "ready to switch on")
    rig.axis.arm()
    assert (rig.axis.ready_to_arm, rig.axis.cia402_state) == (False, "switched on")
    rig.seconds(0.1)
    assert (rig.axis.ready_to_arm, rig.axis.cia402_state) == (False, "operation enabled")
    rig.axis.disarm()
    rig.tick()
    assert [rig.axis.ready_to_arm] == [False]
    rig.tick()
    assert [rig.axis.ready_to_arm] == [True]


def test_a_command_enables_while_arming_and_driven_and_at_no_other_time() -> None:
    rig = AxisRig().seconds(0.05)
    assert rig.commands == [NO_EFFORT] * 5
    rig.axis.arm()
    assert [rig.tick() for _ in range(2)] == [Command(0.0, enable=True)] * 2
    assert rig.state() is State.HOLDING
    assert rig.tick().enable
    rig.axis.raise_trip(TripCode.DRIVE_FAULT, "as a test")
    assert rig.tick() == NO_EFFORT


@pytest.mark.parametrize(("missed", "trips"), [(2, False), (3, True)])
def test_more_than_two_missed_ticks_trip_a_driven_axis(missed: int, trips: bool) -> None:
    rig = AxisRig().armed()
    rig.tick(missed)
    assert (tripped(rig) is TripCode.MISSED_TICKS) is trips
    rig = AxisRig().seconds(0.05)
    rig.tick(missed)
    assert rig.axis.trip is None


def test_missed_ticks_are_predicted_where_it_is_driven_and_forgotten_where_it_is_not() -> None:
    rig = AxisRig().cruising(for_s=0.5)
    before = rig.axis.law.observer.position
    rig.axis.begin_tick(rig.tick_index + 2, 1)
    assert rig.axis.law.observer.position == pytest.approx(before + 1.0, abs=0.05)
    rig = AxisRig().seconds(0.05)
    assert rig.axis.motion.expected_position(driven=False) is not None
    rig.axis.begin_tick(rig.tick_index + 1, 0)
    assert rig.axis.motion.expected_position(driven=False) is not None
    rig.axis.begin_tick(rig.tick_index + 3, 1)
    assert rig.axis.motion.expected_position(driven=False) is None


@pytest.mark.parametrize("missed", [0, 2])
def test_a_jog_ends_300_ms_after_it_was_last_asked_for_missed_ticks_included(missed: int) -> None:
    rig = AxisRig().armed()
    rig.axis.jog(10.0)
    for _ in range(10):
        rig.tick()
    rig.axis.jog(10.0)
    ends = 30 // (1 + missed)
    states = [(rig.tick(missed), rig.state())[1] for _ in range(ends)]
    assert states == [State.JOGGING] * (ends - 1) + [State.STOPPING]
    assert rig.axis.move is not None
    assert (rig.axis.move.outcome, rig.axis.move.reason) == ("stopped", "the jog was not renewed within 300 ms")
    assert rig.axis.law.stage is Stage.BRAKE


def test_a_trip_is_kept_with_its_tick_and_a_later_one_beside_it_where_it_is_more_severe() -> None:
    rig = AxisRig().cruising(for_s=0.5)
    move, tick = rig.axis.move, rig.tick_index
    rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "first")
    first = Trip(TripCode.FOLLOWING_ERROR, "first", tick)
    assert (rig.axis.trip, rig.axis.escalation) == (first, None)
    assert move is not None
    assert (move.outcome, move.reason) == ("tripped", "first")
    braking = rig.state()
    rig.tick()
    rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "again")
    assert (rig.axis.escalation, rig.axis.trips, rig.state()) == (None, {first.code: first}, braking)
    rig.axis.raise_trip(TripCode.DRIVE_FAULT, "worse")
    worse = Trip(TripCode.DRIVE_FAULT, "worse", tick + 1)
    assert (rig.axis.trip, rig.axis.escalation) == (first, worse)
    assert rig.axis.trips == {first.code: first, worse.code: worse}
    assert (rig.state(), move.reason) == (State.TRIPPED, "first")


@pytest.mark.parametrize(
    ("code", "blind", "distrusted", "referenced"),
    [
        (TripCode.FOLLOWING_ERROR, False, False, True),
        (TripCode.STALE_FEEDBACK, True, False, True),
        (TripCode.POSITION_JUMP, True, False, False),
        (TripCode.SIGN_REVERSED, True, True, False),
        (TripCode.MODEL_MISMATCH, True, True, False),
        (TripCode.STALL, True, True, False),
        (TripCode.OVERSPEED, False, False, False),
        (TripCode.DRIVE_REBOOTED, False, False, False),
    ],
)
def test_a_trip_leaves_what_its_cause_has_made_uncertain(
    code: TripCode, blind: bool, distrusted: bool, referenced: bool
) -> None:
    rig = AxisRig().cruising(for_s=0.5)
    rig.axis.law.observer.velocity = 1.0  # which is wrong
    rig.axis.raise_trip(code, "as a test")
    assert (rig.axis.motion.blind, rig.axis.referenced) == (blind, referenced)
    assert (rig.axis.law.observer.velocity == pytest.approx(rig.velocity, rel=1e-3)) is distrusted
    rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "as a test")
    assert (rig.axis.motion.blind, rig.axis.referenced) == (blind, referenced)


def test_a_braking_that_is_given_up_ends_as_it_would_at_rest() -> None:
    for begin, braking, after in (
        ("stop", State.STOPPING, State.STOPPING),  # it would hold: that is not given up
        ("disarm", State.DISARMING, State.DISARMED),
        ("trip", State.TRIPPED_QUICK_STOP, State.TRIPPED),
        ("", State.SPEED_STAGE, State.SPEED_STAGE),
    ):
        rig = AxisRig().cruising(for_s=0.5)
        if begin == "trip":
            rig.axis.raise_trip(TripCode.HOMING_FAILED, "as a test")
        elif begin:
            getattr(rig.axis, begin)()
        assert rig.state() is braking
        rig.axis.end_braking()
        assert rig.state() is after


def test_the_following_error_is_that_of_the_motion_while_it_is_driven() -> None:
    rig = AxisRig().armed()
    rig.axis.motion.nominal.observer.position = 3.0
    assert rig.axis.following_error == pytest.approx(-3.0, abs=1e-6)
    rig.axis.disarm()
    assert rig.axis.following_error == 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_switch_counts_in_the_direction_of_motion_and_of_what_was_asked_for(side: float) -> None:
    ahead, behind = ("positive_limit", "negative_limit")[:: 1 if side > 0.0 else -1]
    for asked in ("move", "jog", "neither"):
        for name, trips in ((ahead, asked != "neither"), (behind, False)):
            rig = AxisRig().armed()
            if asked == "move":
                rig.axis.move_to(side * 0.5, 0.2)  # slower than the 2.5 mm/s of rest
            elif asked == "jog":
                rig.axis.jog(side * 0.2)
            rig.tick()
            rig.inputs = {name: True}
            rig.tick()
            assert (tripped(rig) is TripCode.LIMIT_SWITCH) is trips
    for name, trips in ((ahead, True), (behind, False)):
        rig = AxisRig().armed()
        rig.axis.move_to(side * 100.0, 50.0)
        rig.seconds(0.3)
        rig.axis.stop()
        rig.inputs = {name: True}
        rig.tick()
        assert (tripped(rig) is TripCode.LIMIT_SWITCH) is trips


def test_a_search_counts_in_the_direction_in_which_it_looks() -> None:
    for name, trips in (("negative_limit", True), ("positive_limit", False)):
        rig = rig_with({"method": "index", "velocity": 2.0, "slow_velocity": 1.0, "direction": "negative"}).armed()
        rig.axis.home()
        rig.tick()
        rig.inputs = {name: True}
        rig.tick()
        assert (tripped(rig) is TripCode.LIMIT_SWITCH) is trips


def test_a_found_reference_moves_the_origin_and_ends_the_search() -> None:
    rig = rig_with({"method": "index", "velocity": 40.0, "slow_velocity": 20.0, "position": 12.0, "required": True})
    rig.armed().axis.home()
    rig.seconds(1.0)
    place = rig.position
    rig.axis.drive.record_index(place)
    until(rig, lambda: rig.state() is not State.HOMING, 5.0)
    assert (rig.state(), rig.axis.referenced) == (State.HOLDING, True)
    assert rig.axis.move is not None
    assert (rig.axis.move.outcome, rig.axis.move.reason) == ("reached", None)
    assert rig.axis.law.observer.position == pytest.approx(12.0 + rig.position - place, abs=0.02)
    assert rig.axis.drive.position == pytest.approx(rig.axis.law.observer.position, abs=0.5)


def test_a_search_that_fails_trips_with_its_text_and_gives_the_effort_limit_back() -> None:
    rig = rig_with({"method": "hard_stop", "effort": 4.0, "travel": 5.0, "slow_velocity": 20.0}).armed()
    rig.axis.home()
    assert rig.axis.law.effort_limit == 4.0
    until(rig, lambda: rig.axis.trip is not None, 3.0)
    assert tripped(rig) is TripCode.HOMING_FAILED
    assert rig.axis.move is not None
    assert rig.axis.move.reason is not None
    assert rig.axis.move.reason.startswith("no hard stop within 5")
    assert rig.axis.law.effort_limit == 24.0


def test_a_reboot_trips_an_enabled_axis_and_a_foreign_command_too() -> None:
    rig = AxisRig().armed()
    rig.axis.record_heartbeat(1)
    rig.axis.record_heartbeat(1)
    assert [rig.axis.referenced] == [True]
    rig.axis.record_heartbeat(2)
    assert (tripped(rig), rig.axis.referenced) == (TripCode.DRIVE_REBOOTED, False)
    rig = AxisRig().armed()
    rig.axis.record_foreign_command("0x201")
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.FOREIGN_COMMAND
    assert rig.axis.trip.cause.endswith("0x201")


@pytest.mark.parametrize(
    ("required", "other_rules", "knew", "knows"),
    [
        (True, False, True, True), (True, False, False, False),
        (True, True, True, False), (True, True, False, False),
        (False, True, True, False), (False, True, False, False), (False, False, True, True),
    ],
)  # fmt: skip
def test_after_other_settings_a_reference_is_known_that_was_found_by_the_same_rules(
    required: bool, other_rules: bool, knew: bool, knows: bool
) -> None:
    former = axis_with(required=required, position=7.0 if other_rules else 0.0)
    if knew:
        former.reference.find()
    else:
        former.reference.lose("a test")
    former.begin_tick(1, 0)
    former.accept_feedback(Feedback(33.0, 1))
    axis = axis_with(required=required)
    axis.continue_from(former)
    assert (axis.referenced, axis.drive.position) == (knows, 33.0)


def test_a_round_that_is_not_sure_loses_the_reference_for_good() -> None:
    axis = Axis(design_axis(axis_settings(), PERIOD_S), DriveTraits(counter_modulus=16, position_period=1000.0))
    axis.begin_tick(1, 0)
    axis.accept_feedback(Feedback(0.0))
    assert [axis.referenced] == [True]
    axis.begin_tick(1000, 998)
    axis.accept_feedback(Feedback(0.0))
    assert [axis.referenced] == [False]
    axis.begin_tick(1001, 0)
    axis.accept_feedback(Feedback(0.0))
    assert [axis.referenced] == [False]


@pytest.mark.parametrize(
    ("velocity", "state"), [(2.49, State.HOLDING), (2.51, State.STOPPING), (-2.51, State.STOPPING)]
)
def test_an_axis_is_caught_when_it_moves_faster_than_rest(velocity: float, state: State) -> None:
    rig = AxisRig().seconds(0.05)
    rig.axis.arm()
    rig.tick()
    rig.axis.law.observer.velocity = velocity / rig.axis.law.observer.plant.a22  # for a tick of coasting
    rig.axis.begin_tick(rig.tick_index + 1, 0)
    rig.axis.drive.fresh, rig.axis.drive.enabled = True, True
    rig.axis.drive.position = rig.axis.law.observer.position
    assert rig.axis.step() == Command(0.0, enable=True)  # the law begins in the next tick
    assert rig.state() is state
    assert (rig.axis.law.stage is Stage.BRAKE) is (state is State.STOPPING)


def test_after_a_move_is_reached_no_more_than_at_standstill_is_allowed() -> None:
    rig = AxisRig().armed()
    move = rig.axis.move_to(100.0, 100.0)
    until(rig, lambda: move.outcome != "moving", 6.0)
    assert (move.outcome, move.reason, rig.state()) == ("reached", None, State.HOLDING)
    rig.tick()
    rig.axis.motion.nominal.observer.position += 12.0
    rig.tick()
    assert tripped(rig) is TripCode.FOLLOWING_ERROR


def test_a_trip_brakes_once_with_the_deceleration_of_its_reaction(monkeypatch: pytest.MonkeyPatch) -> None:
    """A trip that has an axis stopped in the ordinary way comes first, then a quicker one, then any again."""
    rig = AxisRig().cruising(for_s=0.5)
    begun = decelerations(rig, monkeypatch)
    by_reaction = {rule.reaction: code for code, rule in RULES.items()}
    expected = []
    for reaction, deceleration in ((Reaction.CONTROLLED_STOP, 2000.0), (Reaction.QUICK_STOP, 4000.0)):
        if reaction in by_reaction:
            expected.append(deceleration)
            for _ in range(2):
                rig.axis.raise_trip(by_reaction[reaction], "as a test")
        assert begun == expected
    rig.axis.raise_trip(by_reaction[Reaction.DISABLE], "as a test")
    assert (begun, rig.state()) == (expected, State.TRIPPED)
    assert expected[-1] == 4000.0
    assert rig.axis.move is not None
    assert rig.axis.move.outcome == "tripped"


def test_a_quick_stop_that_trips_is_begun_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = AxisRig().cruising(for_s=0.5)
    rig.axis.stop()
    begun = decelerations(rig, monkeypatch)
    rig.axis.raise_trip(TripCode.STALE_FEEDBACK, "as a test")
    assert (begun, rig.state()) == ([4000.0], State.TRIPPED_QUICK_STOP)


def test_after_a_trip_and_a_reset_two_disabled_ticks_are_waited_for_again() -> None:
    rig = AxisRig().armed()
    rig.axis.raise_trip(TripCode.OVERSPEED, "as a test")
    rig.axis.reset()
    for ready in (False, True):
        rig.tick()
        assert rig.axis.ready_to_arm is ready


def test_trips_say_their_numbers() -> None:
    rig = AxisRig().armed()
    rig.tick(3)
    assert rig.axis.trip is not None
    assert rig.axis.trip.cause == "3 ticks of 10 ms were missed in a row; axis.limits.missed_ticks is 2"
    rig = AxisRig().armed()
    rig.fault_code = 77
    rig.tick()
    assert rig.axis.trip is not None
    assert (rig.axis.trip.code, rig.axis.trip.cause) == (
        TripCode.DRIVE_FAULT,
        "the drive reports fault code 77",
    )
    rig = AxisRig().armed()
    rig.axis.law.observer.velocity = 400.0
    rig.tick()
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.OVERSPEED
    assert rig.axis.trip.cause.endswith("axis.limits.overspeed is 320")
    rig = AxisRig().armed()
    rig.axis.law.observer.disturbance = float("nan")
    rig.tick()
    assert rig.axis.trip is not None
    assert (rig.axis.trip.code, rig.axis.trip.cause[:16]) == (TripCode.NOT_FINITE, "the law computed")
    rig = AxisRig().armed()
    rig.axis.move_to(100.0, 100.0)
    rig.inputs = {"positive_limit": True}
    rig.tick()
    assert rig.axis.trip is not None
    assert rig.axis.trip.cause.startswith("the positive limit switch is active at ")
    rig = AxisRig().armed()
    rig.axis.record_heartbeat(1)
    rig.axis.record_heartbeat(2)
    assert rig.axis.trip is not None
    assert rig.axis.trip.cause == "the drive rebooted while it was enabled"
    rig = AxisRig(enables=False).seconds(0.05)
    rig.axis.arm()
    rig.seconds(0.6)
    assert rig.axis.trip is not None
    assert rig.axis.trip.cause == "the drive did not report that it is enabled within 500 ms of arming"
    rig = AxisRig().seconds(0.05)
    rig.axis.arm()
    while rig.axis.trip is None and rig.tick_index < 200:
        rig.tick(missed=1)
    assert rig.axis.trip is not None
    assert rig.axis.trip.code == TripCode.DRIVE_NOT_ENABLED
    assert rig.axis.trip.cause.startswith("the speed is unknown, because no two consecutive fresh samples came")


def test_in_the_tick_of_a_trip_that_disables_no_effort_goes_out() -> None:
    rig = AxisRig().cruising(for_s=0.5)
    rig.axis.law.observer.velocity = 1000.0
    assert rig.tick() == NO_EFFORT
    assert tripped(rig) is TripCode.OVERSPEED


def test_an_axis_at_rest_is_not_stopped_by_a_switch_that_it_stands_on() -> None:
    for velocity in (1.0, -1.0):
        rig = AxisRig().armed()
        rig.inputs = {"positive_limit": True, "negative_limit": True}
        rig.axis.law.observer.velocity = velocity
        rig.tick()
        assert rig.axis.trip is None


def test_the_heading_is_from_where_the_axis_is() -> None:
    rig = AxisRig(position=100.0, sample=100.0).armed()
    rig.axis.move_to(99.5, 0.2)
    rig.inputs = {"positive_limit": True}
    rig.tick()
    assert rig.axis.trip is None
    rig.inputs = {"negative_limit": True}
    rig.tick()
    assert tripped(rig) is TripCode.LIMIT_SWITCH


def test_a_detour_goes_on_to_the_set_point_with_the_speed_of_the_move() -> None:
    rig = rig_with(approach={"direction": "positive", "distance": 3.0}).armed()
    move = rig.axis.move_to(-20.0, 30.0)
    until(rig, lambda: rig.axis.law.target == -20.0, 5.0)
    assert rig.axis.law.cruise_velocity == 30.0
    assert rig.position == pytest.approx(-23.0, abs=0.06)
    assert move.outcome == "moving"
    until(rig, lambda: move.outcome == "reached", 5.0)
    assert rig.position == pytest.approx(-20.0, abs=0.06)


def test_only_ticks_that_see_the_axis_count_for_the_window() -> None:
    rig = AxisRig().armed()
    move = rig.axis.move_to(0.0, 100.0)
    for tick in range(20):
        rig.silent = tick % 2 == 1
        rig.tick()
        assert move.outcome == "moving"
    rig.silent = False
    rig.tick()
    assert move.outcome == "reached"


def test_the_position_limits_mean_nothing_without_a_reference() -> None:
    rig = rig_with({"required": True})
    rig.position = rig.sample = 9000.0
    assert rig.armed().seconds(0.1).axis.trip is None
    rig = AxisRig().armed()
    rig.axis.reference.lose("a test")
    rig.axis.disarm()
    rig.seconds(0.05)
    rig.axis.drive.position = 9000.0
    assert rig.axis.obstacle_to_arming() is None
    rig.axis.reference.find()
    assert rig.axis.obstacle_to_arming() is not None


def test_a_switch_ahead_counts_while_the_axis_is_still_turning_round() -> None:
    rig = AxisRig().cruising(for_s=0.5)
    rig.axis.move_to(-100.0, 100.0)
    rig.inputs = {"positive_limit": True}
    rig.tick()
    assert tripped(rig) is TripCode.LIMIT_SWITCH


def test_ticks_missed_while_arming_do_not_trip() -> None:
    rig = AxisRig().seconds(0.05)
    rig.axis.arm()
    rig.axis.begin_tick(rig.tick_index + 4, 3)
    assert (rig.state(), rig.axis.trip) == (State.ARMING, None)


def test_the_rounds_of_the_encoder_are_chosen_by_the_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = AxisRig().cruising(for_s=0.5)
    told: list[tuple[int, float | None]] = []
    monkeypatch.setattr(rig.axis.drive, "begin_tick", lambda missed, expected=None: told.append((missed, expected)))
    rig.axis.motion.lose_track()
    rig.axis.begin_tick(rig.tick_index + 3, 2)
    assert told == [(2, rig.axis.law.observer.position)]
    rig.axis.raise_trip(TripCode.OVERSPEED, "as a test")
    rig.axis.begin_tick(rig.tick_index + 4, 0)
    assert told[1:] == [(0, None)]


def test_two_disabled_ticks_are_waited_for_with_a_drive_that_does_not_tell() -> None:
    axis = axis_with()

    def tick() -> State:
        axis.begin_tick(1, 0)
        axis.accept_feedback(Feedback(0.0))
        axis.step()
        return axis.state

    tick()
    tick()
    axis.arm()
    assert [tick() for _ in range(3)] == [State.ARMING, State.HOLDING, State.HOLDING]
    axis.disarm()
    assert [axis.ready_to_arm] == [False]
    tick()
    assert [axis.ready_to_arm] == [False]
    tick()
    assert [axis.ready_to_arm] == [True]


def test_in_the_tick_of_a_drive_fault_the_estimate_goes_on_by_one_tick() -> None:
    rig = AxisRig().cruising(for_s=1.0)
    before = rig.axis.law.observer.position
    rig.fault_code = 1
    rig.tick()
    assert rig.axis.law.observer.position - before == pytest.approx(1.0, abs=0.05)


def test_arming_waits_for_feedback_of_its_tick_also_where_the_drive_does_not_tell() -> None:
    axis = axis_with()
    for tick, state in enumerate([State.DISARMED] * 2 + [State.ARMING] * 2 + [State.HOLDING]):
        if tick == 2:
            axis.arm()
        axis.begin_tick(tick, 0)
        if tick != 3:
            axis.accept_feedback(Feedback(0.0))
        axis.step()
        assert axis.state is state


def test_what_is_supervised_depends_on_the_state_and_on_the_reference() -> None:
    rig = AxisRig().cruising(for_s=0.5)
    rig.axis.stop()
    rig.axis.motion.nominal.observer.position += 50.0  # a braking axis has no following error
    rig.tick()
    assert rig.axis.trip is None
    rig = AxisRig(position=2515.0, sample=2515.0).armed()
    for shift, code in ((4.0, None), (2.0, TripCode.POSITION_LIMIT)):
        rig.axis.drive.shift(shift)
        rig.axis.motion.shift(shift)
        rig.tick()
        assert tripped(rig) is code


def test_a_jog_that_reaches_its_limit_holds_there() -> None:
    rig = AxisRig(position=2499.0, sample=2499.0).armed()
    rig.axis.jog(5.0)
    until(rig, lambda: rig.state() is State.HOLDING, 3.0, lambda: rig.axis.jog(5.0))
    assert rig.axis.move is not None
    assert rig.axis.move.outcome == "reached"
    assert rig.position == pytest.approx(2500.0, abs=0.06)


def test_a_reboot_of_a_disarmed_drive_loses_the_reference_without_a_trip() -> None:
    axis = axis_with()
    axis.record_heartbeat(1)
    axis.record_heartbeat(2)
    assert (axis.referenced, axis.trip) == (False, None)


def test_a_sample_without_a_date_is_not_used_after_missed_ticks() -> None:
    rig = AxisRig().armed()
    predicted = rig.axis.motion.predicted
    for missed, more in ((0, 0), (2, 1), (0, 1)):
        rig.tick(missed)
        assert rig.axis.motion.predicted == predicted + more
