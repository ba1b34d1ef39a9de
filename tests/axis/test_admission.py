"""Which requests are refused, exactly at their limits, and with which code."""

import math
from collections.abc import Callable
from functools import partial

import pytest

from tests.axis.rig import PERIOD_S, AxisRig, axis_settings
from twostage_servo.axis.admission import Admission
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.messages import IN_TIME, NO_EFFORT, Command, DriveTraits, Feedback, Reception
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import Event, State, next_state
from twostage_servo.axis.trips import Reaction, Trip, TripCode

SETTINGS = axis_settings(position_minimum=-100.0, position_maximum=250.0, position_overrun=20.0)
DESIGN = design_axis(SETTINGS, PERIOD_S)


def admission_at(position: float | None, **inputs: bool) -> Admission:
    drive = DriveReport(SETTINGS, PERIOD_S, DriveTraits(counter_modulus=16))
    if position is not None:
        drive.begin_tick(0)
        drive.accept_feedback(Feedback(position, 1, enabled=False, **inputs))
    return Admission(DESIGN, drive)


HERE = admission_at(0.0)


def code(check: Callable[[], None]) -> str | None:
    try:
        check()
    except Refused as refused:
        return refused.code
    return None


@pytest.mark.parametrize(
    ("position", "overrun", "inside"),
    [
        (-100.0, 0.0, True), (-100.1, 0.0, False), (250.0, 0.0, True), (250.1, 0.0, False),
        (-120.0, 20.0, True), (-120.1, 20.0, False), (270.0, 20.0, True), (270.1, 20.0, False),
    ],
)  # fmt: skip
def test_the_limits_themselves_are_inside(position: float, overrun: float, inside: bool) -> None:
    assert HERE.is_inside(position, overrun) is inside
    if not overrun:
        assert HERE.is_inside(position) is inside


@pytest.mark.parametrize(
    ("position", "refused"), [(-120.0, False), (-120.1, True), (270.0, False), (270.1, True), (0.0, False)]
)
def test_an_axis_may_be_armed_as_far_outside_as_its_overrun(position: float, refused: bool) -> None:
    admission = admission_at(position)
    obstacle = admission.obstacle_to_arming(referenced=True)
    assert (obstacle is not None and obstacle[0] == "position_limit") is refused
    # Where it does not know its position, none is wrong.
    assert admission.obstacle_to_arming(referenced=False) is None


def test_what_keeps_the_drive_from_arming_comes_first() -> None:
    for referenced in (True, False):
        obstacle = admission_at(None).obstacle_to_arming(referenced=referenced)
        assert obstacle is not None
        assert obstacle[0] == "no_feedback"


@pytest.mark.parametrize(
    ("velocity", "refused"),
    [(50.0, False), (50.1, True), (1e-9, False), (0.0, True), (-1.0, True), (math.nan, True), (math.inf, True)],
)
def test_a_speed_is_positive_and_up_to_the_largest(velocity: float, refused: bool) -> None:
    assert code(lambda: HERE.check_velocity(velocity, 50.0)) == ("velocity_limit" if refused else None)
    if velocity == math.inf:
        assert code(lambda: HERE.check_velocity(velocity, math.inf)) == "velocity_limit"


@pytest.mark.parametrize(
    ("target", "refused"),
    [(-100.0, False), (-100.1, True), (250.0, False), (250.1, True), (math.nan, True), (-math.inf, True)],
)
def test_a_set_point_lies_inside_the_limits_of_an_axis_that_knows_its_position(target: float, refused: bool) -> None:
    assert code(lambda: HERE.check_target(target, referenced=True)) == ("position_limit" if refused else None)
    assert code(lambda: HERE.check_target(target, referenced=False)) == ("position_limit" if refused else "not_homed")


@pytest.mark.parametrize(
    ("position", "velocity", "refused"),
    [
        (0.0, 0.0, None), (250.0, 0.0, None), (-100.0, 0.0, None), (269.0, 0.0, None), (-119.0, 0.0, None),
        (270.0, 0.0, "position_limit"), (-120.0, 0.0, "position_limit"), (1e9, 0.0, "position_limit"),
        (math.nan, 0.0, "position_limit"), (math.inf, 0.0, "position_limit"),
        (0.0, 2.5, None), (0.0, -2.5, None), (0.0, 2.6, "busy"), (0.0, -2.6, "busy"),
    ],
)  # fmt: skip
def test_a_place_is_set_at_rest_and_where_the_axis_would_not_trip(
    position: float, velocity: float, refused: str | None
) -> None:
    assert code(lambda: HERE.check_place(position, velocity, 2.5)) == refused


def test_a_place_is_not_set_on_an_axis_that_is_not_seen() -> None:
    assert code(lambda: admission_at(None).check_place(0.0, 0.0, 2.5)) == "no_feedback"
    drive = DriveReport(SETTINGS, PERIOD_S, DriveTraits(counter_modulus=16))
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(0.0, 1, enabled=False))
    for expected in (None, "busy"):
        drive.begin_tick(0)
        assert code(lambda: Admission(DESIGN, drive).check_place(0.0, 0.0, 2.5)) == expected
    drive.begin_tick(0)  # the limit is 30 ms
    assert code(lambda: Admission(DESIGN, drive).check_place(0.0, 0.0, 2.5)) == "no_feedback"
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(0.0, 2, enabled=False))
    drive.position = None
    assert code(lambda: Admission(DESIGN, drive).check_place(0.0, 0.0, 2.5)) == "no_feedback"


@pytest.mark.parametrize(
    ("state", "tripped", "refused"),
    [
        (State.HOLDING, False, None),
        (State.DISARMED, False, "disarmed"),
        (State.HOMING, False, "busy"),
        (State.TRIPPED, True, "tripped"),
        (State.DISARMED, True, "tripped"),
    ],
)
def test_what_the_state_does_not_admit_is_refused_with_its_reason(
    state: State, tripped: bool, refused: str | None
) -> None:
    trip = Trip(TripCode.STALL, "it stands still.", 7) if tripped else None
    assert code(lambda: HERE.check_state(state, Event.HOME, trip)) == refused


def test_motion_towards_an_active_limit_switch_is_refused_and_away_from_it_is_not() -> None:
    positive, negative = admission_at(0.0, positive_limit=True), admission_at(0.0, negative_limit=True)
    assert [code(partial(positive.check_switches, d)) for d in (1.0, -1.0, 0.0)] == ["limit_switch", None, None]
    assert [code(partial(negative.check_switches, d)) for d in (1.0, -1.0, 0.0)] == [None, "limit_switch", None]


def test_a_refusal_says_its_text() -> None:
    refused = Refused(RefusalCode.BUSY, "the axis moves.")
    assert (refused.code, str(refused)) == ("busy", "the axis moves.")


def test_a_place_beyond_the_limits_is_refused_with_the_numbers() -> None:
    with pytest.raises(
        Refused, match=r"cannot stand at 3000 mm.* -100 to 250 mm .* 20 mm .* from -119.84 to 269.84 mm"
    ):
        HERE.check_place(3000.0, 0.0, 2.5)


def test_no_effort_is_none_and_a_frame_is_asked_for_unless_it_says_otherwise() -> None:
    assert Command(0.0, enable=False) == NO_EFFORT
    assert Reception() == IN_TIME
    assert IN_TIME.unasked is False


def test_reactions_are_five_and_each_is_more_severe_than_the_one_before() -> None:
    names = ["NONE", "HOLD", "CONTROLLED_STOP", "QUICK_STOP", "DISABLE"]
    assert [reaction.name for reaction in sorted(Reaction)] == names


@pytest.mark.parametrize("event", list(Event))
def test_a_disarmed_axis_has_nothing_to_stop_and_is_armed_for_all_else(event: Event) -> None:
    if next_state(State.DISARMED, event) is not None:
        return
    with pytest.raises(Refused) as refused:
        HERE.check_state(State.DISARMED, event, None)
    assert refused.value.code == "disarmed"
    assert ("nothing to stop" in str(refused.value)) is (event in {Event.STOP, Event.QUICK_STOP})
    assert ("`arm` it first" in str(refused.value)) is (event not in {Event.STOP, Event.QUICK_STOP})


@pytest.mark.parametrize(("because", "said"), [("", ""), ("the drive has rebooted", " (the drive has rebooted)")])
def test_why_the_position_is_not_known_is_said_where_there_is_a_reason(because: str, said: str) -> None:
    with pytest.raises(Refused) as refused:
        HERE.check_target(0.0, referenced=False, lost_because=because)
    assert str(refused.value).startswith(f"the axis does not know its position{said}: `home` it first")


@pytest.mark.parametrize("percent", [0.0, 200.0, -0.1, 200.1, math.nan])
def test_an_override_is_from_0_to_200_percent(percent: float) -> None:
    rig = AxisRig().armed()
    if 0.0 <= percent <= 200.0:
        rig.axis.set_override(percent)
        assert rig.axis.override_percent == percent
        return
    with pytest.raises(Refused, match="must be from 0, which holds the axis, to 200 %"):
        rig.axis.set_override(percent)
    assert rig.axis.override_percent == 100.0


def test_without_room_to_stop_in_the_overrun_no_place_outside_the_limits_may_be_told() -> None:
    """From the speed that counts as rest an axis goes farther than 0.01 mm."""
    narrow = design_axis(
        axis_settings(position_minimum=-100.0, position_maximum=250.0, position_overrun=0.01), PERIOD_S
    )
    drive = DriveReport(narrow.settings, PERIOD_S, DriveTraits(counter_modulus=16))
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(0.0, 1, enabled=False))
    admission = Admission(narrow, drive)
    assert code(lambda: admission.check_place(250.0, 0.0, 2.5)) is None
    assert code(lambda: admission.check_place(250.001, 0.0, 2.5)) == "position_limit"


def test_no_place_may_be_told_from_which_an_axis_that_just_counts_as_at_rest_would_run_out_of_its_overrun() -> None:
    """2.5 mm/s, for a tick and for a quick stop."""
    farthest = 270.0 - DESIGN.certain_stopping_distance(2.5, SETTINGS.limits.quick_stop_deceleration) - 2.5 * PERIOD_S
    assert code(lambda: HERE.check_place(farthest - 1e-6, 0.0, 2.5)) is None
    assert code(lambda: HERE.check_place(farthest + 1e-6, 0.0, 2.5)) == "position_limit"


def test_no_speed_is_told_from_one_that_is_too_small() -> None:
    with pytest.raises(Refused, match="must be greater than 0 and at most 50 mm/s"):
        HERE.check_velocity(0.0, 50.0)
