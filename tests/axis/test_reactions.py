"""Each fault that the axis can see itself: which trip it makes, how it reacts, and what is left afterwards."""

import math
from random import Random
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings, paper
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.messages import NO_EFFORT, DriveTraits
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import DRIVEN, State
from twostage_servo.axis.trips import RULES, Reaction, TripCode
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Callable


def rig_with(**limits: float) -> AxisRig:
    return AxisRig(Axis(design_axis(axis_settings(None, None, **limits), PERIOD_S), TRAITS))


def tripped(rig: AxisRig, code: TripCode, within_s: float = 1.0) -> AxisRig:
    """Let time pass until the axis has come to rest after a trip of this code."""
    for _ in range(round(within_s / PERIOD_S)):
        rig.tick()
        if rig.axis.trip is not None:
            break
    assert rig.axis.trip is not None, f"no trip within {within_s} s"
    assert rig.axis.trip.code is code, rig.axis.trip
    rig.seconds(0.5)
    assert rig.state() is State.TRIPPED
    assert rig.tick() == NO_EFFORT
    return rig


# The encoder ---------------------------------------------------------------------------------------------------------


def test_a_single_spike_is_bridged_and_forgotten() -> None:
    rig = AxisRig().cruising()
    rig.sample += 50.0
    rig.tick()
    assert rig.axis.motion.implausible == 1
    rig.seconds(6.0)
    assert (rig.axis.trip, rig.axis.motion.implausible) == (None, 0)
    assert rig.position == pytest.approx(400.0, abs=0.05)


@pytest.mark.parametrize("height", [3.0, -40.0, 1e6])
def test_a_jump_trips_loses_the_reference_and_is_never_believed(height: float) -> None:
    rig = AxisRig().cruising()
    at = rig.position
    rig.sees = lambda position: position + height
    estimates = []
    while rig.state() is not State.TRIPPED:
        rig.tick()
        estimates.append(rig.axis.law.observer.position)
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.POSITION_JUMP
    assert all(abs(estimate - at) < 10.0 for estimate in estimates)  # not a step towards the jump
    assert rig.position - at < 6.0
    assert not rig.axis.referenced
    rig.seconds(0.1)
    rig.axis.reset()
    rig.seconds(0.1)
    rig.axis.arm()
    rig.seconds(0.1)
    with pytest.raises(Refused, match="home") as refused:
        rig.axis.move_to(100.0, 50.0)
    assert refused.value.code == "not_homed"


def test_a_jump_while_an_untroubled_stop_brakes_trips_as_well() -> None:
    rig = AxisRig().cruising(2000.0, 250.0)
    rig.axis.stop()
    rig.sees = lambda position: position + 20.0
    tripped(rig, TripCode.POSITION_JUMP)


@pytest.mark.parametrize(
    ("factor", "code"),
    [(-1.0, TripCode.SIGN_REVERSED), (2.0, TripCode.MODEL_MISMATCH), (0.5, TripCode.MODEL_MISMATCH)],
)
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_wrong_sign_or_scale_shows_in_the_first_millimetres_of_a_move(
    factor: float, code: TripCode, direction: float
) -> None:
    rig = AxisRig()
    rig.sees = lambda position: factor * position
    rig.armed()
    rig.axis.move_to(direction * 400.0, 100.0)
    tripped(rig, code)
    assert abs(rig.position) < 8.0


@pytest.mark.parametrize("velocity", [20.0, 100.0])
@pytest.mark.parametrize("gain", [0.7, 1.3])
@pytest.mark.parametrize("pole", [0.7, 1.3])
@pytest.mark.parametrize("load", [-1.0, 1.0])
def test_a_plant_30_percent_off_with_noise_and_a_load_does_not_trip(
    velocity: float, gain: float, pole: float, load: float
) -> None:
    noise = Random(1)  # noqa: S311 - noise, no secret
    rig = AxisRig(plant=Plant(180.0 * gain, 14.0 * pole))
    rig.sees = lambda position: round((position + noise.gauss(0.0, 0.02)) * 1000.0) / 1000.0
    rig.armed()
    move = rig.axis.move_to(3.0 * velocity, velocity)
    rig.seconds(1.5)
    rig.load = load
    rig.seconds(10.0)
    assert rig.axis.trip is None
    assert move.outcome in {"reached", "moving"}
    assert rig.position == pytest.approx(3.0 * velocity, abs=0.3)


def test_a_frozen_encoder_at_low_speed_is_found_by_what_the_effort_does() -> None:
    rig = AxisRig().cruising(30.0, 10.0)
    at, place = rig.position, rig.sample
    rig.sees = lambda _: place
    tripped(rig, TripCode.STALL)
    # The effort rises by f22 times the missing speed a tick until it has changed by 2.5 V.
    ticks = 2.5 / (paper(rig.axis.design).servo_gains.f22 * 10.0)
    assert rig.position - at < (10.0 + 2.5 * 180.0 / 14.0) * ticks * PERIOD_S + 5.0


def test_an_axis_that_cannot_move_is_stalled_and_the_effort_stays_small() -> None:
    rig = AxisRig().armed()
    rig.plant = Plant(1e-9, 1e3)
    rig.axis.move_to(400.0, 100.0)
    tripped(rig, TripCode.STALL)
    assert max(abs(command.effort) for command in rig.commands) < 6.0


# Frames --------------------------------------------------------------------------------------------------------------


def test_many_bad_frames_trip_although_none_is_missed_for_long() -> None:
    """Two frames in a row lost, one that comes: never three, yet two thirds are missing."""
    rig = AxisRig().cruising(2000.0, 100.0)
    for index in range(60):
        rig.counter += 1 if index % 3 else 0
        rig.silent = bool(index % 3)
        rig.tick()
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.FEEDBACK_ERRORS
    assert "25" in rig.axis.trip.cause


def test_errors_of_long_ago_do_not_count() -> None:
    rig = AxisRig().cruising(2000.0, 100.0)
    for _ in range(24):
        rig.axis.drive.monitor.reject()
    rig.seconds(0.99)
    assert rig.axis.drive.monitor.recent_errors == 24
    rig.seconds(0.02)
    assert rig.axis.drive.monitor.recent_errors == 0
    assert rig.axis.trip is None


# The drive -----------------------------------------------------------------------------------------------------------


def test_safe_torque_off_disables_and_the_position_is_still_tracked() -> None:
    rig = AxisRig().cruising()
    rig.inputs["safe_torque_off"] = True
    rig.tick()
    assert rig.state() is State.TRIPPED
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.SAFE_TORQUE_OFF
    rig.seconds(0.5)
    assert rig.axis.law.observer.position == pytest.approx(rig.position, abs=0.05)
    rig.axis.reset()
    rig.seconds(0.1)
    with pytest.raises(Refused, match="safe torque off") as refused:
        rig.axis.arm()
    assert refused.value.code == "safe_torque_off"


def with_heartbeat() -> AxisRig:
    return AxisRig(
        Axis(
            design_axis(axis_settings(), PERIOD_S),
            DriveTraits(counter_modulus=16, position_quantum=0.001, has_heartbeat=True),
        )
    )


def test_a_silent_heartbeat_disables() -> None:
    rig = with_heartbeat().seconds(0.05)
    rig.axis.record_heartbeat(3)
    rig.armed()
    rig.axis.record_heartbeat(3)
    rig.axis.move_to(400.0, 100.0)
    rig.seconds(0.29)
    assert rig.state() is State.SPEED_STAGE
    tripped(rig, TripCode.HEARTBEAT_LOST, within_s=0.02)


def test_a_drive_without_a_heartbeat_is_not_expected_to_have_one() -> None:
    assert AxisRig().cruising(for_s=2.0).axis.trip is None


def test_a_heartbeat_that_has_never_come_keeps_the_axis_from_being_armed() -> None:
    rig = with_heartbeat().seconds(0.05)
    with pytest.raises(Refused, match="no heartbeat has come from the drive yet") as refused:
        rig.axis.arm()
    assert refused.value.code == "heartbeat_lost"
    rig.axis.record_heartbeat(None)
    rig.axis.arm()


def test_after_the_bus_was_lost_the_heartbeat_has_to_come_again() -> None:
    rig = with_heartbeat().seconds(0.05)
    rig.axis.record_heartbeat(3)
    rig.axis.drive.forget()
    rig.seconds(0.05)
    obstacle = rig.axis.obstacle_to_arming()
    assert obstacle is not None
    assert obstacle[0] == "heartbeat_lost"
    rig.axis.record_heartbeat(4)  # rebooted while nobody could hear it
    assert rig.axis.obstacle_to_arming() is None
    assert not rig.axis.referenced


@pytest.mark.parametrize("armed", [True, False])
def test_a_reboot_loses_the_reference_armed_or_not(*, armed: bool) -> None:
    rig = AxisRig().seconds(0.05)
    rig.axis.record_heartbeat(3)
    if armed:
        rig.cruising(for_s=0.2)
    rig.axis.record_heartbeat(4)
    assert not rig.axis.referenced
    assert (rig.axis.trip is not None) == armed
    assert rig.state() is (State.TRIPPED if armed else State.DISARMED)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_limit_switch_stops_and_lets_only_motion_off_it(direction: float) -> None:
    switch = "positive_limit" if direction > 0.0 else "negative_limit"
    rig = AxisRig().cruising(direction * 400.0)
    rig.inputs[switch] = True
    at = rig.position
    tripped(rig, TripCode.LIMIT_SWITCH)
    assert abs(rig.position - at) < rig.axis.design.stopping_distance(100.0, 4000.0) + 1.0
    rig.axis.reset()
    rig.armed()
    for towards in (lambda: rig.axis.move_by(direction * 10.0, 50.0), lambda: rig.axis.jog(direction * 10.0)):
        with pytest.raises(Refused) as refused:
            towards()
        assert refused.value.code == "limit_switch"
    move = rig.axis.move_by(-direction * 50.0, 50.0)
    rig.seconds(5.0)
    assert (rig.axis.trip, move.outcome) == (None, "reached")


# Limits --------------------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(
    speed=st.floats(20.0, 180.0),
    direction=st.sampled_from([1.0, -1.0]),
    short=st.floats(0.0, 1.0),
    gain=st.floats(0.8, 1.2),
)
def test_the_position_limits_brake_in_time(speed: float, direction: float, short: float, gain: float) -> None:
    """An axis that races towards its limit, for whatever reason, comes to rest before limit and overrun."""
    rig = AxisRig(plant=Plant(180.0 * gain, 14.0))
    rig.position = rig.sample = direction * (2500.0 - 3.0 * speed)
    rig.seconds(0.1)
    rig.armed()
    rig.axis.move_to(direction * 2500.0, speed)
    rig.seconds(2.0 + short * speed / 250.0)
    rig.axis.motion.law.target += direction * 1e4  # a law that has gone astray does not slow down
    rig.axis.motion.nominal.target += direction * 1e4
    rig.seconds(4.0)
    assert rig.state() is State.TRIPPED  # by the position limit, or what notices even earlier that it has gone astray
    assert direction * rig.position < 2520.0


def test_the_following_error_is_the_minimum_or_proportional_to_the_speed() -> None:
    """Under a load that grows by 15 V/s. (One that turns the axis back as a reversed encoder would trips otherwise.)"""

    def deviation_at_trip(velocity: float) -> float:
        rig = rig_with(innovation_gate=1e3, stall_effort=24.0)
        rig.cruising(2000.0, velocity, for_s=2.5)
        for _ in range(400):
            rig.load += 0.15
            rig.tick()
            if rig.axis.trip is not None:
                assert rig.axis.trip.code is TripCode.FOLLOWING_ERROR
                return abs(float(rig.axis.trip.cause.split(" mm is ")[1].split(" ")[0]))
        raise AssertionError("no trip")

    assert deviation_at_trip(10.0) == pytest.approx(10.0, abs=1.0)
    assert deviation_at_trip(100.0) == pytest.approx(20.5, abs=1.5)  # 0.2 s of the largest speed, 102 mm/s


@pytest.mark.parametrize(
    ("first", "referenced"), [(TripCode.COMMANDS_DROPPED, True), (TripCode.FOLLOWING_ERROR, False), (None, False)]
)
def test_an_axis_that_does_not_brake_keeps_its_place_only_where_the_bus_has_been_seen_to_take_no_commands(
    first: TripCode | None, *, referenced: bool
) -> None:
    """They leave the drive at its last effort, and the encoder is right. In any other case it may be wrong."""
    rig = rig_with(innovation_gate=1e3, overspeed=1e6).cruising(2000.0, 100.0, for_s=4.0)
    kept = rig.commands[-1].effort
    if first is None:
        rig.axis.stop()
    else:
        rig.axis.raise_trip(first, "test")
    for _ in range(60):
        rig.load = rig.commands[-1].effort - kept
        rig.tick()
    assert rig.state() is State.TRIPPED
    assert TripCode.MODEL_MISMATCH in rig.axis.trips
    assert rig.axis.referenced is referenced


GENTLE = {"innovation_gate": 1e3, "overspeed": 1e6, "acceleration": 50.0, "quick_stop_deceleration": 50.0}


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize(("deceleration", "way"), [(2000.0, 25.0), (1000.0, 40.0)])
def test_a_drive_that_keeps_its_effort_while_the_axis_should_brake_is_disabled_long_before_the_stop_is_overdue(
    deceleration: float, way: float, *, quick: bool
) -> None:
    """The axis answers to none of the braking: that is another gain. Where only the stop that is overdue told, it went
    88 to 95 mm.
    """
    limits = {"acceleration": deceleration, "quick_stop_deceleration": deceleration}
    rig = rig_with(innovation_gate=1e3, overspeed=1e6, **limits).cruising(2000.0, 100.0, for_s=4.0)
    kept, at = rig.commands[-1].effort, rig.position
    rig.axis.stop(quick=quick)
    while rig.state() is not State.TRIPPED:
        rig.load = rig.commands[-1].effort - kept
        rig.tick()
        assert rig.position - at < way
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.MODEL_MISMATCH


def test_a_braking_that_does_not_work_is_given_up() -> None:
    """A drive that keeps its effort, and a stop that is too gentle for the model to tell that nothing answers."""
    rig = rig_with(**GENTLE).cruising(2000.0, 100.0, for_s=4.0)
    kept = rig.commands[-1].effort
    rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "test")
    for _ in range(600):
        rig.load = rig.commands[-1].effort - kept  # whatever is commanded, the same acts
        rig.tick()
        if rig.state() is State.TRIPPED:
            break
    assert rig.state() is State.TRIPPED
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.FOLLOWING_ERROR
    assert rig.axis.escalation is not None
    assert rig.axis.escalation.code is TripCode.BRAKING_FAILED


@settings(max_examples=30, deadline=None)
@given(
    requests=st.lists(
        st.tuples(
            st.sampled_from(["move", "stop", "quick", "disarm", "arm", "jog", "trip"]),
            st.floats(-2500.0, 2500.0),
            st.floats(1.0, 250.0),
            st.integers(1, 60),
        ),
        min_size=3,
        max_size=12,
    )
)
def test_the_effort_keeps_its_rate_and_its_limit(requests: list[tuple[str, float, float, int]]) -> None:
    rig = AxisRig().armed()
    for what, target, velocity, ticks in requests:
        act: dict[str, Callable[[], object]] = {
            "move": lambda t=target, v=velocity: rig.axis.move_to(t, v),  # type: ignore[misc]
            "stop": rig.axis.stop,
            "quick": lambda: rig.axis.stop(quick=True),
            "disarm": rig.axis.disarm,
            "arm": rig.axis.arm,
            "jog": lambda t=target, v=velocity: rig.axis.jog(math.copysign(v, t)),  # type: ignore[misc]
            "trip": lambda: rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "test"),
        }
        try:
            act[what]()
        except Refused:
            if rig.state() is State.TRIPPED:
                rig.axis.reset()
        for _ in range(ticks):
            rig.tick()
    before = 0.0
    for command, state in zip(rig.commands, rig.states, strict=True):
        assert abs(command.effort) <= 24.0
        if state in DRIVEN:
            assert abs(command.effort - before) <= 10.0 + 1e-9  # 1000 V/s
        else:
            assert command.effort == 0.0
        before = command.effort


# Reactions -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", list(TripCode))
def test_every_code_reacts_as_its_rule_says(code: TripCode) -> None:
    rig = AxisRig().cruising()
    rig.axis.raise_trip(code, "test")
    expected = {
        Reaction.CONTROLLED_STOP: State.TRIPPED_STOPPING,
        Reaction.QUICK_STOP: State.TRIPPED_QUICK_STOP,
        Reaction.DISABLE: State.TRIPPED,
    }
    assert rig.state() is expected[RULES[code].reaction]
    assert rig.axis.referenced is not RULES[code].unreferenced
    rig.seconds(1.0)
    assert rig.state() is State.TRIPPED
    assert rig.axis.move is not None
    assert (rig.axis.move.outcome, rig.axis.move.reason) == ("tripped", "test")
    rig.axis.reset()
    assert (rig.state(), rig.axis.trip, rig.axis.escalation) == (State.DISARMED, None, None)


@pytest.mark.parametrize("first", list(TripCode))
@pytest.mark.parametrize("second", [TripCode.SPEED_UNREACHABLE, TripCode.FOLLOWING_ERROR, TripCode.OVERSPEED])
def test_the_first_cause_stays_and_the_most_severe_reaction_wins(first: TripCode, second: TripCode) -> None:
    rig = AxisRig().cruising()
    rig.axis.raise_trip(first, "first")
    rig.axis.raise_trip(second, "second")
    assert rig.axis.trip is not None
    assert rig.axis.trip.cause == "first"
    more = RULES[second].reaction > RULES[first].reaction
    assert (rig.axis.escalation is not None) == more
    noticed = first is second or RULES[first].reaction < Reaction.DISABLE
    assert [trip.cause for trip in rig.axis.trips.values()] == (
        ["first", "second"] if noticed and first is not second else ["first"]
    )
    severity = max(RULES[first].reaction, RULES[second].reaction)
    assert (rig.state() is State.TRIPPED) == (severity is Reaction.DISABLE)


@pytest.mark.parametrize("quick", [True, False])
def test_a_stop_while_arming_disarms(*, quick: bool) -> None:
    rig = AxisRig(enables=False).seconds(0.05)
    rig.axis.arm()
    rig.tick()
    rig.axis.stop(quick=quick)
    assert rig.state() is State.DISARMED
    assert not rig.tick().enable


def test_a_quick_stop_hardens_the_braking_after_a_trip_and_a_stop_does_not_soften_it() -> None:
    def distance(*requests: bool) -> float:
        rig = AxisRig().cruising(2000.0, 250.0)
        rig.axis.raise_trip(TripCode.SPEED_UNREACHABLE, "test")
        at = rig.position
        for quick in requests:
            rig.tick()
            rig.axis.stop(quick=quick)
        rig.seconds(1.0)
        assert rig.state() is State.TRIPPED
        return rig.position - at

    mild, hard = distance(), distance(True)
    assert hard < 0.8 * mild
    assert distance(True, False) == hard
    assert distance(False) == mild


def test_a_quick_stop_on_request_holds_and_does_not_latch() -> None:
    rig = AxisRig().cruising(2000.0, 250.0)
    at = rig.position
    rig.axis.stop(quick=True)
    assert (rig.state(), rig.axis.cia402_state) == (State.QUICK_STOPPING, "quick stop active")
    rig.seconds(1.0)
    assert (rig.state(), rig.axis.trip) == (State.HOLDING, None)
    # 250^2 / 8000 is 7.8 mm; the effort's rate adds what it takes to swing from cruising to braking.
    assert 5.0 < rig.position - at < rig.axis.design.stopping_distance(250.0, 4000.0)
    move = rig.axis.move_by(10.0, 50.0)
    rig.seconds(3.0)
    assert move.outcome == "reached"


# What a review found -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("quick", [None, False, True])
def test_asking_for_the_stop_again_and_again_does_not_keep_it_from_being_given_up(*, quick: bool | None) -> None:
    """The service disarms on every tick while it ends, and somebody may hold a key down that stops; a drive that keeps
    its effort is disabled all the same.
    """
    rig = rig_with(**GENTLE).cruising(2000.0, 100.0, for_s=4.0)
    kept = rig.commands[-1].effort
    for _ in range(600):
        rig.axis.disarm()
        if quick is not None:
            rig.axis.stop(quick=quick)
        rig.load = rig.commands[-1].effort - kept
        rig.tick()
        if rig.axis.trip is not None:
            break
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.BRAKING_FAILED


def test_a_stop_after_a_trip_that_the_axis_does_not_follow_gives_way_to_a_quick_stop() -> None:
    """A drive that keeps its effort cannot be stopped: the sooner that is known, the sooner it is disabled."""
    rig = rig_with(innovation_gate=1e3, overspeed=1e6, acceleration=50.0).cruising(2000.0, 100.0, for_s=4.0)
    kept = rig.commands[-1].effort
    rig.axis.raise_trip(TripCode.SPEED_UNREACHABLE, "test")
    states: list[State] = []
    for _ in range(800):
        rig.load = rig.commands[-1].effort - kept
        rig.tick()
        if not states or states[-1] is not rig.state():
            states.append(rig.state())
    assert states == [State.TRIPPED_STOPPING, State.TRIPPED_QUICK_STOP, State.TRIPPED]
    follows = rig.axis.trips[TripCode.FOLLOWING_ERROR].tick
    failed = rig.axis.trips[TripCode.BRAKING_FAILED].tick
    tripped = rig.axis.trips[TripCode.SPEED_UNREACHABLE].tick
    # 20 mm behind a ramp of 50 mm/s² are 0.9 s; twice the time of that ramp alone would be 4 s.
    assert 60 <= follows - tripped <= 120
    assert failed - tripped < 250


@pytest.mark.parametrize("again", [False, True])
def test_disarming_does_not_make_a_quick_stop_milder(*, again: bool) -> None:
    def way(*, disarms: bool) -> float:
        rig = rig_with(acceleration=200.0).cruising(2000.0, 200.0, for_s=3.0)
        at = rig.position
        rig.axis.stop(quick=True)
        rig.tick()
        if disarms:
            rig.axis.disarm()
            if again:
                rig.axis.disarm()
        rig.seconds(3.0)
        return rig.position - at

    assert way(disarms=True) == pytest.approx(way(disarms=False), abs=0.3)


def test_an_effort_that_is_no_number_trips_in_its_tick_whatever_it_comes_from() -> None:
    rig = AxisRig().cruising()
    law = rig.axis.law
    assert isinstance(law, TwoStageLaw)
    law._sum = math.nan
    assert rig.tick() == NO_EFFORT
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.NOT_FINITE


@pytest.mark.parametrize("first", [TripCode.STALL, TripCode.POSITION_LIMIT, None])
def test_a_reversed_sign_is_braked_by_the_model_whatever_has_tripped_in_the_same_tick(first: TripCode | None) -> None:
    """A quick stop by an estimate that counts the wrong way would push."""
    rig = AxisRig().cruising(2000.0, 30.0)
    rig.axis.law.observer.velocity = -30.0  # what such an encoder shows
    speed = rig.velocity
    if first is not None:
        rig.axis.raise_trip(first, "test")
    rig.axis.raise_trip(TripCode.SIGN_REVERSED, "test")
    while rig.state() is not State.TRIPPED:
        rig.tick()
        assert -2.5 < rig.velocity < speed + 1e-9  # of the demo, standstill is 2.5 mm/s
        speed = max(rig.velocity, 0.0)


def test_what_is_blind_already_gives_up_its_feedback_once() -> None:
    rig = AxisRig().cruising()
    rig.axis.raise_trip(TripCode.STALE_FEEDBACK, "test")
    assert rig.axis.motion.blind
    given_up: list[None] = []
    rig.axis.motion.ignore_feedback = lambda: given_up.append(None)  # type: ignore[method-assign]
    rig.axis.raise_trip(TripCode.POSITION_JUMP, "test")
    assert given_up == []


@pytest.mark.parametrize("keeps", [False, True])
def test_a_trip_that_says_nothing_against_the_encoder_this_time_keeps_the_reference(keeps: bool) -> None:
    rig = AxisRig().cruising()
    rig.axis._latch.raise_trip(TripCode.MODEL_MISMATCH, "test", keeps_reference=keeps)
    assert rig.axis.referenced is keeps


@pytest.mark.parametrize("moves_after_all", [False, True])
@pytest.mark.parametrize("cannot_stop", [False, True])
def test_a_braking_ends_where_the_axis_moves_after_all_or_cannot_be_stopped(
    monkeypatch: pytest.MonkeyPatch, moves_after_all: bool, cannot_stop: bool
) -> None:
    rig = AxisRig().cruising()
    rig.axis.raise_trip(TripCode.STALE_FEEDBACK, "test")
    monkeypatch.setattr(Motion, "moves_after_all", moves_after_all)
    monkeypatch.setattr(Motion, "cannot_stop", cannot_stop)
    rig.tick()
    assert (rig.state() is State.TRIPPED) is (moves_after_all or cannot_stop)
