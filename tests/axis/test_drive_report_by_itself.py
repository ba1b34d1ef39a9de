"""What is known of a drive, frame by frame: its ages in ticks, its state within a tick, its revolutions, its origin."""

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, axis_settings
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.messages import DriveTraits, Feedback, Reception
from twostage_servo.axis.trips import TripCode

SETTINGS = axis_settings()
"""Stale after 30 ms, a heartbeat each 300 ms, overspeed 320 mm/s, 5040 mm from end to end with the overruns."""


def report(period: float = 0.0, *, heartbeat: bool = False) -> DriveReport:
    return DriveReport(
        SETTINGS, PERIOD_S, DriveTraits(counter_modulus=16, position_period=period, has_heartbeat=heartbeat)
    )


def seen(drive: DriveReport, position: float, counter: int | None = None, **signals: bool) -> bool:
    drive.begin_tick(0)
    return drive.accept_feedback(Feedback(position, counter, **signals))


def codes(drive: DriveReport, *, arming: bool = False) -> set[TripCode]:
    return {code for code, _ in drive.troubles(arming=arming)}


def first_tick_of(drive: DriveReport, holds: Callable[[], bool], missed: int = 0) -> int:
    for tick in range(1, 200):
        drive.begin_tick(missed)
        if holds():
            return tick
    return 0


@pytest.mark.parametrize(("missed", "tick"), [(0, 3), (2, 1)])
def test_feedback_is_stale_after_30_ms_missed_ticks_included(missed: int, tick: int) -> None:
    drive = report()
    assert [drive.is_stale] == [True]
    seen(drive, 1.0)
    assert [drive.is_stale] == [False]
    assert first_tick_of(drive, lambda: drive.is_stale, missed) == tick
    assert codes(drive) == {TripCode.STALE_FEEDBACK}


@pytest.mark.parametrize(("missed", "tick"), [(0, 30), (2, 10)])
def test_a_heartbeat_is_lost_after_300_ms_from_the_last_or_from_the_start(missed: int, tick: int) -> None:
    drive = report(heartbeat=True)
    lost = TripCode.HEARTBEAT_LOST
    assert first_tick_of(drive, lambda: lost in codes(drive), missed) == tick
    drive.record_heartbeat(1)
    assert lost not in codes(drive)
    assert first_tick_of(drive, lambda: lost in codes(drive), missed) == tick
    without = report()
    assert first_tick_of(without, lambda: lost in codes(without)) == 0


def test_arming_waits_for_the_first_heartbeat_and_again_after_the_bus_was_lost() -> None:
    drive = report(heartbeat=True)
    for counter in (1, 2):
        seen(drive, 0.0, counter, enabled=False)
        obstacle = drive.obstacle_to_arming()
        assert obstacle is not None
        assert obstacle[0] == "heartbeat_lost"
        drive.record_heartbeat(None)
        assert drive.obstacle_to_arming() is None
        drive.forget()
    without = report()
    seen(without, 0.0, enabled=False)
    assert without.obstacle_to_arming() is None


@pytest.mark.parametrize("missed", [0, 4])
def test_a_foreign_command_keeps_from_arming_for_as_long_as_arming_may_take(missed: int) -> None:
    """500 ms are 50 ticks."""
    drive = report()
    drive.foreign.record("0x201", enables=True)
    for tick in range(1, 50 // (1 + missed) + 1):
        drive.begin_tick(missed)
        drive.accept_feedback(Feedback(0.0, None, enabled=False))
        obstacle = drive.obstacle_to_arming()
        if tick * (1 + missed) < 50:
            assert obstacle is not None
            ago = f"{10 * tick * (1 + missed)} ms ago"
            text = f"another node on the bus commands this drive: 0x201 (frame 1, {ago}). End the other service"
            assert obstacle == ("foreign_command", f"{text} or tool first.")
        else:
            assert obstacle is None


def test_a_drive_that_still_says_it_is_enabled_cannot_be_armed_and_one_that_does_not_tell_can() -> None:
    for enabled, expected in ((True, "still_enabled"), (False, None), (None, None)):
        drive = report()
        drive.begin_tick(0)
        drive.accept_feedback(Feedback(0.0, enabled=enabled))
        obstacle = drive.obstacle_to_arming()
        assert (None if obstacle is None else obstacle[0]) == expected


def test_troubles_of_the_drive_are_told_by_code() -> None:
    drive = report()
    seen(drive, 0.0, enabled=False)
    assert codes(drive) == {TripCode.DRIVE_DROPPED_OUT}
    assert codes(drive, arming=True) == set()
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(0.0, enabled=True, fault=True, fault_code=0, safe_torque_off=True))
    assert codes(drive) == {TripCode.DRIVE_FAULT, TripCode.SAFE_TORQUE_OFF}


def test_errors_of_the_channel_trip_at_their_number() -> None:
    drive = report()
    seen(drive, 0.0)
    for _ in range(24):
        drive.monitor.reject()
    assert codes(drive) == set()
    drive.monitor.reject()
    assert codes(drive) == {TripCode.FEEDBACK_ERRORS}


def test_in_a_tick_what_is_bad_stays_and_in_the_next_it_is_new() -> None:
    drive = report()
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(0.0, 1, enabled=False, fault_code=7, safe_torque_off=True, home_switch=True))
    drive.accept_feedback(Feedback(1.0, 2, enabled=True, safe_torque_off=False, positive_limit=True))
    assert (drive.enabled, drive.fault_code, drive.safe_torque_off) == (False, 7, True)
    assert (drive.positive_limit, drive.home_switch) == (True, True)
    drive.begin_tick(0)
    assert [drive.fresh] == [False]
    drive.accept_feedback(Feedback(1.0, 3, enabled=True))
    assert [drive.fresh] == [True]
    assert (drive.enabled, drive.fault_code) == (True, None)
    assert not any((drive.safe_torque_off, drive.positive_limit, drive.home_switch))


def test_a_newer_fault_in_a_tick_is_taken_where_there_was_none() -> None:
    drive = report()
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(0.0, 1, enabled=True))
    drive.accept_feedback(Feedback(0.0, 2, enabled=False, fault_code=3))
    assert (drive.enabled, drive.fault_code) == (False, 3)


def test_what_a_drive_sends_unasked_after_its_answer_does_not_replace_the_sample() -> None:
    drive = report()
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(1.0, 1), Reception(0.001))
    drive.accept_feedback(Feedback(2.0, 2), Reception(0.002, unasked=True))
    assert (drive.position, drive.age_s) == (1.0, 0.001)
    drive.accept_feedback(Feedback(3.0, 3), Reception(0.003))
    assert (drive.position, drive.age_s) == (3.0, 0.003)
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(4.0, 4), Reception(0.004, unasked=True))
    assert (drive.position, drive.age_s) == (4.0, 0.004)


def test_a_drive_that_has_lost_its_encoder_tells_why_and_no_position() -> None:
    drive = report()
    seen(drive, 5.0, 1)
    drive.begin_tick(0)
    assert drive.accept_feedback(Feedback(math.nan, 2, fault_code=9))
    assert (drive.position, drive.fresh, drive.fault_code, drive.monitor.rejected) == (5.0, False, 9, 1)


def test_a_frame_that_is_not_new_tells_nothing() -> None:
    drive = report()
    seen(drive, 5.0, 1)
    drive.begin_tick(0)
    assert drive.accept_feedback(Feedback(6.0, 1, fault_code=9))
    assert (drive.position, drive.fresh, drive.fault_code) == (5.0, False, None)


@pytest.mark.parametrize(("period", "last_sure"), [(1000.0, 156), (10_079.0, 1574), (10_081.0, 0), (0.0, 0)])
def test_which_round_it_is_stays_sure_until_the_axis_may_have_gone_half_of_one(period: float, last_sure: int) -> None:
    """At 320 mm/s half of 1000 mm takes 1.5625 s; where both ends are nearer than that, it never matters."""
    for ticks, sure in ((last_sure or 5000, True), (last_sure + 1 if last_sure else 50_000, not last_sure)):
        drive = report(period)
        assert seen(drive, 100.0)
        drive.begin_tick(ticks - 1)
        assert drive.accept_feedback(Feedback(100.0)) is sure
        drive.begin_tick(0)
        assert drive.accept_feedback(Feedback(100.0))


@pytest.mark.parametrize(("counted", "position"), [(90.0, 90.0), (10.0, 110.0), (40.0, 140.0), (60.0, 60.0)])
def test_of_all_rounds_the_nearest_is_taken(counted: float, position: float) -> None:
    drive = report(100.0)
    assert seen(drive, 95.0)
    assert seen(drive, counted)
    assert drive.position == pytest.approx(position)


def test_rounds_are_counted_from_where_the_estimate_is() -> None:
    drive = report(100.0)
    seen(drive, 95.0)
    drive.begin_tick(0, expected=720.0)
    drive.accept_feedback(Feedback(5.0))
    assert drive.position == pytest.approx(705.0)
    drive.record_index(30.0)
    assert drive.index == pytest.approx(730.0)
    drive.forget_index()
    assert drive.index is None
    drive.record_index(math.nan)
    assert drive.index is None


def test_after_the_bus_was_lost_rounds_go_on_from_where_the_axis_was_last_seen() -> None:
    drive = report(100.0)
    seen(drive, 95.0)
    seen(drive, 15.0)
    drive.forget()
    assert (drive.position, drive.enabled, drive.fault_code, drive.age_s) == (None, None, None, None)
    assert drive.is_stale
    seen(drive, 20.0)
    assert drive.position == pytest.approx(120.0)


def test_another_origin_moves_what_is_known_and_what_comes() -> None:
    drive = report(100.0)
    drive.shift(3.0)
    seen(drive, 95.0)
    assert drive.position == pytest.approx(98.0)
    drive.shift(-8.0)
    assert drive.position == pytest.approx(90.0)
    seen(drive, 5.0)
    assert drive.position == pytest.approx(100.0)


def test_a_step_is_at_most_half_a_round() -> None:
    assert report(100.0).encoder.step(95.0, 5.0) == pytest.approx(10.0)
    assert report(100.0).encoder.step(5.0, 95.0) == pytest.approx(-10.0)
    assert report(100.0).encoder.step(5.0, 45.0) == pytest.approx(40.0)
    assert report().encoder.step(95.0, 5.0) == -90.0


def test_boots_are_counted_by_their_counter() -> None:
    drive = report(heartbeat=True)
    assert [drive.record_heartbeat(counter) for counter in (4, 4, 5, None, 6, 7, 6)] == [
        False, False, True, False, False, True, True,
    ]  # fmt: skip
    assert drive.heartbeat.state.boots == 3


@pytest.mark.parametrize(
    ("direction", "names"), [(1.0, ("positive", None)), (-1.0, (None, "negative")), (0.0, (None, None))]
)
def test_a_switch_forbids_the_way_towards_it(direction: float, names: tuple[str | None, str | None]) -> None:
    for signal, name in zip(("positive_limit", "negative_limit"), names, strict=True):
        drive = report()
        seen(drive, 0.0, **{signal: True})
        assert drive.blocks(direction) == name


def test_a_new_report_of_the_same_drive_knows_what_the_former_one_did() -> None:
    former = report(100.0, heartbeat=True)
    former.record_heartbeat(3)
    former.foreign.record("0x201", enables=True)
    seen(former, 95.0, 1, home_switch=True)
    seen(former, 5.0, 2, enabled=False)
    former.shift(7.0)
    drive = report(100.0, heartbeat=True)
    drive.continue_from(former)
    assert drive.monitor is former.monitor
    assert (drive.position, drive.enabled) == (former.position, False)
    assert drive.position == pytest.approx(112.0)
    assert drive.record_heartbeat(4)
    seen(drive, 10.0, 3, enabled=False)
    assert drive.position == pytest.approx(117.0)
    obstacle = drive.obstacle_to_arming()
    assert obstacle is not None
    assert obstacle[0] == "foreign_command"


def test_a_report_begins_with_nothing_known() -> None:
    drive = DriveReport(SETTINGS, PERIOD_S, DriveTraits(counter_modulus=16))
    known = (drive.position, drive.age_s, drive.enabled, drive.fault_code, drive.index)
    inputs = (drive.safe_torque_off, drive.positive_limit, drive.negative_limit, drive.home_switch)
    assert (*known, *inputs) == (None,) * 9
    assert (drive.fresh, drive.heartbeat.state.boots, drive.is_stale) == (False, 0, True)
    drive.accept_feedback(Feedback(0.0, 1, enabled=True, home_switch=False))
    assert (drive.enabled, drive.fresh) == (True, True)
    drive.forget()
    assert drive.home_switch is drive.safe_torque_off is drive.positive_limit is drive.negative_limit is None


def test_within_a_tick_enabled_and_open_inputs_stay_so() -> None:
    drive = report()
    drive.begin_tick(0)
    for counter in (1, 2):
        drive.accept_feedback(Feedback(0.0, counter, enabled=True, safe_torque_off=False, home_switch=False))
    assert (drive.enabled, drive.safe_torque_off, drive.home_switch) == (True, False, False)


@pytest.mark.parametrize(("fault_code", "code"), [(5, "drive_fault"), (None, None)])
def test_trouble_keeps_from_arming_by_its_code(fault_code: int | None, code: str | None) -> None:
    drive = report()
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(0.0, 1, enabled=False, fault_code=fault_code))
    obstacle = drive.obstacle_to_arming()
    assert (None if obstacle is None else obstacle[0]) == code
    drive.position = None
    obstacle = drive.obstacle_to_arming()
    assert obstacle is not None
    assert obstacle[0] == "no_feedback"


def test_feedback_that_is_stale_keeps_from_arming() -> None:
    drive = report()
    seen(drive, 0.0, 1)
    drive.begin_tick(3)
    obstacle = drive.obstacle_to_arming()
    assert obstacle is not None
    assert obstacle[0] == "no_feedback"


def test_after_the_bus_was_lost_the_heartbeat_has_its_whole_time_again() -> None:
    drive = report(heartbeat=True)
    drive.begin_tick(25)
    drive.forget()
    assert first_tick_of(drive, lambda: TripCode.HEARTBEAT_LOST in codes(drive)) == 30


def test_the_first_round_holds_within_its_tick_and_moves_with_the_origin() -> None:
    drive = report(100.0)
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(95.0, 1))
    drive.accept_feedback(Feedback(5.0, 2))
    assert drive.position == pytest.approx(105.0)
    drive.shift(200.0)
    drive.accept_feedback(Feedback(7.0, 3))
    assert drive.position == pytest.approx(307.0)


def test_ticks_without_sight_add_up_and_a_first_position_is_always_sure() -> None:
    """Half of 1000 mm at 320 mm/s takes 156.25 ticks."""
    drive = report(1000.0)
    drive.begin_tick(1000)
    assert drive.accept_feedback(Feedback(100.0))
    for _ in range(157):
        drive.begin_tick(0)
    assert not drive.accept_feedback(Feedback(100.0))


def test_without_a_round_what_the_encoder_counts_is_the_position() -> None:
    drive = DriveReport(SETTINGS, PERIOD_S, DriveTraits(counter_modulus=16))
    for position in (0.0, 0.9, 7.4):
        seen(drive, position)
        assert drive.position == position


def test_rounds_are_counted_on_from_the_last_position_or_the_estimate_also_before_a_position() -> None:
    drive = report(100.0)
    for counted in (95.0, 30.0, 60.0):
        seen(drive, counted)
    assert drive.position == pytest.approx(160.0)
    drive.forget()
    drive.begin_tick(0, expected=720.0)
    drive.accept_feedback(Feedback(5.0))
    assert drive.position == pytest.approx(705.0)


@pytest.mark.parametrize("name", ["safe_torque_off", "positive_limit", "negative_limit", "home_switch"])
@pytest.mark.parametrize(
    ("frames", "seen_as"),
    [
        ([True, False], True),
        ([False, True], True),
        ([False, False], False),
        ([True, None], True),
        ([None, True], True),
        ([None, None], None),
    ],
)
def test_an_input_that_one_frame_of_a_tick_shows_is_active_for_that_tick(
    name: str, frames: list[bool | None], seen_as: bool | None
) -> None:
    drive = report()
    drive.begin_tick(0)
    for counter, active in enumerate(frames):
        drive.accept_feedback(Feedback(0.0, counter, enabled=True, **{name: active}))
    assert getattr(drive, name) is seen_as
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(0.0, 5, enabled=True, **{name: False}))
    assert getattr(drive, name) is False


@pytest.mark.parametrize("late", [0, 2])
def test_frames_that_came_too_late_are_told_where_there_were_any(late: int) -> None:
    drive = report()
    seen(drive, 0.0, 1)
    for counter in range(2, 2 + late):
        drive.begin_tick(0)
        drive.accept_feedback(Feedback(0.0, counter), Reception(late=True))
    for _ in range(5):
        drive.begin_tick(0)
    ((_, cause),) = drive.troubles(arming=False)
    assert cause.endswith("; 2 feedback frames arrived too late to count" if late else "stale_feedback_ms is 30")


# Whether the drive has a fault ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "code", "seen", "faulted"),
    [
        (True, 4, 4, True),
        (True, None, 0, True),
        (None, 4, 4, True),
        (None, 0, None, False),
        (None, None, None, None),
        (False, 4, None, False),  # a code that has not been cleared yet
        (False, None, None, False),
    ],
)
def test_a_drive_has_a_fault_if_it_says_so_or_where_it_has_no_bit_for_that_by_its_code(
    fault: bool | None, code: int | None, seen: int | None, faulted: bool | None
) -> None:
    drive = report()
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(12.5, 7, enabled=True, fault=fault, fault_code=code))
    assert (drive.fault_code, drive.faulted) == (seen, faulted)
    assert (drive.position, drive.enabled) == (12.5, True)


@pytest.mark.parametrize(
    ("driven", "fault", "code", "seen", "faulted"),
    [
        (True, False, None, 0, None),
        (True, False, 1, 1, None),
        (False, False, None, None, None),  # where no command is needed
        (False, True, None, 0, True),
    ],
)
def test_a_time_out_of_commands_is_a_fault_of_an_axis_that_is_driven_alone(
    *, driven: bool, fault: bool, code: int | None, seen: int | None, faulted: bool | None
) -> None:
    drive = report()
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(12.5, 7, fault=fault, fault_code=code, command_timeout=True), driven=driven)
    assert (drive.fault_code, drive.faulted) == (seen, faulted)


@pytest.mark.parametrize("at_once", [True, False])
def test_each_input_of_a_drive_is_that_input_of_the_report(*, at_once: bool) -> None:
    names = ("safe_torque_off", "positive_limit", "negative_limit", "home_switch")
    for name in names:
        drive, given = report(), dict.fromkeys(names, not at_once) | {name: at_once}
        drive.begin_tick(0)
        drive.accept_feedback(Feedback(12.5, 7, None, None, None, None, **given))
        assert {one: getattr(drive, one) for one in names} == given


SIGNALS = ("safe_torque_off", "positive_limit", "negative_limit", "home_switch")


@given(
    st.lists(
        st.fixed_dictionaries(
            {
                "enabled": st.booleans(),
                "fault": st.booleans(),
                "fault_code": st.sampled_from([None, 0, 3, 5]),
                **dict.fromkeys(SIGNALS, st.booleans()),
            }
        ),
        min_size=1,
        max_size=4,
    )
)
def test_of_several_frames_in_a_tick_whatever_is_wrong_in_any_of_them_counts(frames: list[dict[str, Any]]) -> None:
    drive = report()
    seen(drive, 0.0, 0, enabled=True, fault=True, home_switch=True)  # of the tick before, which counts no more
    drive.begin_tick(0)
    for counter, frame in enumerate(frames, 1):
        drive.accept_feedback(Feedback(1.0, counter, **frame))
    assert drive.enabled is all(frame["enabled"] for frame in frames)
    assert drive.faulted is any(frame["fault"] for frame in frames)
    told = [frame["fault_code"] or 0 for frame in frames if frame["fault"]]
    assert drive.fault_code == (told[0] if told else None)
    for name in SIGNALS:
        assert getattr(drive, name) is any(frame[name] for frame in frames)
