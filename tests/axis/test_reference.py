"""On what the positions of an axis rest, and what takes that away: an encoder that does not count on."""

from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.axis.reference import NEVER_HOMED, ReferenceSource
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import DRIVEN, State
from twostage_servo.axis.trips import RULES, TripCode

LIMIT_TICKS = 4
"""Ticks without a sample that mean nothing: within 50 ms, the 30 of stale feedback and two missed ticks, one comes."""
SHORT = [1, 2, LIMIT_TICKS]
LONG = [LIMIT_TICKS + 1, 20, 300]
BOOTS = 7


def homed(
    place: float = 300.0,
    *,
    required: bool = True,
    boots: int | None = None,
    period: float = 0.0,
    homing: dict[str, object] | None = None,
) -> AxisRig:
    """Return a disarmed axis that stands at a place which the operator has told, where the encoder counts the same."""
    settings = axis_settings({"required": required} | (homing or {}))
    axis = Axis(design_axis(settings, PERIOD_S), replace(TRAITS, position_period=period))
    rig = AxisRig(axis, position=place, sample=place)
    rig.seconds(0.1)
    if boots is not None:
        axis.record_heartbeat(boots)
    axis.set_position(place)
    rig.tick()
    assert axis.reference.source is ReferenceSource.HOMED
    return rig


def restarts(rig: AxisRig, silent_ticks: int) -> AxisRig:
    """Let the drive be off for some ticks, and its encoder then count from 0."""
    rig.silent = True
    for _ in range(silent_ticks):
        rig.tick()
    rig.silent, rig.enabled, rig.counter = False, False, 0
    zero = rig.position
    rig.sees = lambda position: position - zero
    rig.sample = 0.0
    return rig


def reason(rig: AxisRig) -> str:
    assert rig.axis.referenced is (rig.axis.reference.lost_because == "")
    return rig.axis.reference.lost_because


# On what positions rest -----------------------------------------------------------------------------------------------


def test_without_homing_positions_are_the_encoders_own_until_somebody_says_otherwise() -> None:
    rig = AxisRig().seconds(0.1)
    assert (rig.axis.referenced, rig.axis.reference.source) == (True, ReferenceSource.ENCODER)
    rig.axis.set_position(50.0)
    assert (rig.axis.referenced, rig.axis.reference.source) == (True, ReferenceSource.HOMED)


def test_where_homing_is_required_there_is_no_position_before_it() -> None:
    axis = Axis(design_axis(axis_settings({"required": True}), PERIOD_S), DriveTraits(counter_modulus=16))
    assert (axis.referenced, axis.reference.source, axis.reference.lost_because) == (False, None, NEVER_HOMED)


@pytest.mark.parametrize("code", [code for code in TripCode if RULES[code].unreferenced])
def test_what_a_trip_has_taken_away_is_told_with_its_code(code: TripCode) -> None:
    rig = AxisRig().armed()
    rig.axis.raise_trip(code, "a test")
    assert reason(rig) == f"{code}: {RULES[code].position_in_doubt}"


def test_the_first_reason_stays_until_the_axis_is_homed() -> None:
    rig = homed()
    rig.axis.reference.lose("one")
    rig.axis.reference.lose("another")
    assert reason(rig) == "one"
    rig.axis.set_position(10.0)
    assert reason(rig) == ""
    rig.axis.reference.lose("another")
    assert reason(rig) == "another"


def test_a_refused_set_point_says_why_the_position_is_not_known() -> None:
    rig = homed()
    rig.axis.reference.lose("the drive has rebooted")
    rig.armed()
    with pytest.raises(Refused, match=r"does not know its position \(the drive has rebooted\): `home`") as refused:
        rig.axis.move_to(10.0, 10.0)
    assert refused.value.code == "not_homed"


# A drive that was switched off and on ---------------------------------------------------------------------------------


@pytest.mark.parametrize("silent_ticks", [*SHORT, *LONG])
@pytest.mark.parametrize("place", [300.0, -40.0, 25.0])
def test_a_drive_without_boot_counter_that_counts_anew(place: float, silent_ticks: int) -> None:
    rig = restarts(homed(place), silent_ticks).seconds(0.1)
    assert reason(rig)
    assert rig.state() is State.DISARMED


@pytest.mark.parametrize("silent_ticks", [*SHORT, *LONG])
@pytest.mark.parametrize("place", [300.0, -40.0, 25.0])
def test_a_drive_that_shows_its_old_boot_counter_and_counts_anew(place: float, silent_ticks: int) -> None:
    rig = restarts(homed(place, boots=BOOTS), silent_ticks)
    rig.axis.record_heartbeat(BOOTS)
    rig.seconds(0.1)
    rig.axis.record_heartbeat(BOOTS)
    rig.seconds(0.1)
    assert f"moved by {-place:+.4g} mm" in reason(rig)


@pytest.mark.parametrize("silent_ticks", LONG)
@pytest.mark.parametrize("count", [0.0, 0.3])
def test_near_the_old_count_only_a_boot_counter_proves_anything(silent_ticks: int, count: float) -> None:
    """What the count shows is the same whether the drive was off or its cable was loose."""
    without = restarts(homed(count), silent_ticks).seconds(0.1)
    assert "has no boot counter" in reason(without)
    assert f"{10 * (LIMIT_TICKS + 2)} ms" in reason(without)
    the_same = restarts(homed(count, boots=BOOTS), silent_ticks)
    the_same.seconds(0.02)
    the_same.axis.record_heartbeat(BOOTS)
    assert not reason(the_same.seconds(0.1))
    another = restarts(homed(count, boots=BOOTS), silent_ticks)
    another.axis.record_heartbeat(BOOTS + 1)
    assert reason(another.seconds(0.1)) == "the drive has rebooted, and its encoder has restarted its count"


def test_until_the_heartbeat_has_come_the_axis_cannot_be_armed() -> None:
    rig = restarts(homed(0.0, boots=BOOTS), 20)
    rig.axis.record_heartbeat(BOOTS)  # before the feedback: it says nothing of what came after
    rig.seconds(0.05)
    with pytest.raises(Refused, match="to show whether it rebooted") as refused:
        rig.axis.arm()
    assert refused.value.code == "heartbeat_lost"
    rig.axis.record_heartbeat(BOOTS, late=True)
    assert rig.axis.obstacle_to_arming() is not None
    rig.axis.record_heartbeat(BOOTS)
    assert rig.axis.obstacle_to_arming() is None


def test_a_heartbeat_without_a_count_proves_nothing() -> None:
    rig = restarts(homed(0.0, boots=BOOTS), 20)
    rig.seconds(0.05)
    rig.axis.record_heartbeat(None)
    obstacle = rig.axis.obstacle_to_arming()
    assert obstacle is not None
    assert obstacle[0] == "heartbeat_lost"


@pytest.mark.parametrize("silent_ticks", SHORT)
def test_a_glitch_of_the_cable_costs_nothing(silent_ticks: int) -> None:
    rig = homed()
    rig.silent = True
    for _ in range(silent_ticks):
        rig.tick()
    rig.silent = False
    assert not reason(rig.seconds(0.2))


@pytest.mark.parametrize("silent_ticks", LONG)
def test_a_long_silence_costs_nothing_where_nobody_has_homed_the_axis(silent_ticks: int) -> None:
    rig = AxisRig(position=300.0, sample=300.0).seconds(0.1)
    rig.silent = True
    for _ in range(silent_ticks):
        rig.tick()
    rig.position += 2.5 * silent_ticks * PERIOD_S  # a hand
    rig.silent, rig.sample = False, rig.position
    assert not reason(rig.seconds(0.2))


@pytest.mark.parametrize("missed", [LIMIT_TICKS, LIMIT_TICKS + 1, 300])
def test_a_service_that_has_not_looked_knows_no_more_than_after_a_silence(missed: int) -> None:
    rig = homed()
    rig.tick(missed)
    assert bool(reason(rig.seconds(0.1))) is (missed > LIMIT_TICKS)


@pytest.mark.parametrize("silent_ticks", [1, 10, 100])
@pytest.mark.parametrize("required", [True, False])
def test_a_drive_that_restarts_in_mid_move_never_ends_in_a_move_to_a_wrong_place(
    silent_ticks: int, *, required: bool
) -> None:
    rig = homed(required=required).armed()
    rig.axis.move_to(700.0, 100.0)
    rig.seconds(1.5)
    restarts(rig, silent_ticks).seconds(1.0)
    assert rig.state() is State.TRIPPED
    assert reason(rig)
    rig.axis.reset()
    rig.armed()
    with pytest.raises(Refused, match="`home` it first"):
        rig.axis.move_to(300.0, 50.0)


# What is no restart ---------------------------------------------------------------------------------------------------


def test_a_spike_while_disarmed_is_none() -> None:
    rig = homed()
    rig.sample = 500.0
    rig.tick()
    assert not reason(rig.seconds(0.1))


@pytest.mark.parametrize("armed", [True, False])
@pytest.mark.parametrize("height", [0.8, -30.0, 200.0])
def test_a_spike_is_not_taken_for_where_the_axis_stands(height: float, *, armed: bool) -> None:
    rig = homed()
    if armed:
        rig.armed()
    rig.sample += height
    rig.tick()
    with pytest.raises(Refused, match="try again") as refused:
        rig.axis.set_position(0.0)
    assert refused.value.code == "busy"
    rig.tick()
    rig.axis.set_position(0.0)
    assert rig.axis.drive.position == 0.0
    assert not reason(rig.seconds(0.1))
    assert rig.axis.drive.position == pytest.approx(0.0, abs=0.01)


def test_nor_is_one_as_the_axis_is_armed() -> None:
    """It begins to hold a tick later, from a sample that is believed."""
    rig = homed()
    rig.seconds(0.05)
    rig.axis.arm()
    rig.tick()
    rig.sample += 30.0
    rig.tick()
    assert rig.state() is State.ARMING
    with pytest.raises(Refused):
        rig.axis.set_position(0.0)
    rig.tick()
    assert rig.state() is State.HOLDING
    rig.axis.set_position(0.0)
    assert not reason(rig.seconds(0.1))
    assert rig.axis.drive.position == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("armed", [True, False])
def test_the_place_of_an_axis_that_is_not_seen_now_cannot_be_told(*, armed: bool) -> None:
    """Its last sample is not stale yet; a load may have moved it since."""
    rig = homed()
    if armed:
        rig.armed()
    rig.silent = True
    rig.tick()
    rig.axis.set_position(0.0)
    rig.tick()
    with pytest.raises(Refused, match="a sample of the axis is missing just now: try again") as refused:
        rig.axis.set_position(1.0)
    assert refused.value.code == "busy"
    rig.silent = False
    rig.tick()
    rig.axis.set_position(1.0)
    assert rig.axis.drive.position == 1.0


def test_the_place_can_be_told_in_any_tick_of_a_drive_that_sends_in_every_third() -> None:
    rig = AxisRig(Axis(design_axis(axis_settings(stale_feedback_ms=100.0), PERIOD_S), TRAITS))
    rig.seconds(0.1)
    for tick in range(12):
        rig.silent = tick % 3 != 0
        rig.tick()
        if tick > 3:
            rig.axis.set_position(float(tick))
    rig.tick()
    with pytest.raises(Refused, match="a sample of the axis is missing just now"):
        rig.axis.set_position(0.0)


def test_after_a_jump_the_place_can_be_told() -> None:
    rig = homed().cruising(target=700.0)
    rig.sees = lambda position: position + 30.0
    rig.seconds(1.0)
    assert rig.state() is State.TRIPPED
    rig.axis.reset()
    rig.axis.set_position(10.0)
    assert not reason(rig.seconds(0.1))


def test_a_spike_at_the_edge_of_the_switch_is_not_taken_for_its_place() -> None:
    homing = {"method": "switch", "direction": "positive", "velocity": 40.0, "slow_velocity": 10.0, "travel": 400.0}
    rig = AxisRig(Axis(design_axis(axis_settings(homing), PERIOD_S), TRAITS)).seconds(0.1)
    rig.inputs["home_switch"] = False
    rig.armed().axis.home()
    was_active = spiked = False
    while rig.state() is State.HOMING:
        active = rig.position >= 50.0
        if was_active and not active and not spiked:
            spiked = True
            rig.sample += 20.0
        was_active = rig.inputs["home_switch"] = active
        rig.tick()
    assert spiked
    assert (rig.state(), rig.axis.reference.source) == (State.HOLDING, ReferenceSource.HOMED)
    assert rig.axis.drive.position is not None
    assert rig.sample - rig.axis.drive.position == pytest.approx(50.0, abs=0.5)


@pytest.mark.parametrize("armed", [True, False])
def test_a_jump_is_told_armed_or_not(*, armed: bool) -> None:
    rig = homed(required=False)
    if armed:
        rig.armed()
    rig.sees = lambda position: position + 30.0
    rig.seconds(0.1)
    assert reason(rig)
    assert (rig.axis.trip is not None) is armed


@settings(max_examples=60, deadline=None)
@given(
    speed=st.floats(-300.0, 300.0), losses=st.lists(st.integers(0, LIMIT_TICKS), max_size=10),
    place=st.floats(-500.0, 500.0),
)  # fmt: skip
def test_a_hand_that_pushes_costs_nothing_while_it_is_seen(speed: float, losses: list[int], place: float) -> None:
    rig = homed(place)

    def carried() -> None:
        rig.velocity = 0.0
        rig.position += speed * PERIOD_S
        rig.sample = rig.sees(rig.position)
        rig.tick()

    for lost in losses:
        rig.silent = True
        for _ in range(lost):
            carried()
        rig.silent = False
        carried()
    assert not reason(rig)
    assert rig.axis.drive.position == pytest.approx(rig.position, abs=1e-6)


@pytest.mark.parametrize("silent_s", [0.06, 0.3, 2.0])
def test_an_axis_that_coasts_through_a_silence_is_where_it_should_be(silent_s: float) -> None:
    """The bus is lost in mid-move: the drive goes on for its time-out, and coasts."""
    rig = homed(boots=BOOTS).armed()
    rig.axis.move_to(700.0, 100.0)
    rig.seconds(1.5)
    rig.silent = True
    effort = rig.commands[-1].effort
    for tick in range(round(silent_s / PERIOD_S)):
        rig.enabled = False
        rig.tick()
        rig.enabled = False
        if tick < 10:  # its own time-out
            rig.move(effort)
    rig.silent = False
    rig.sample = rig.position
    rig.seconds(0.1)
    rig.axis.record_heartbeat(BOOTS)
    rig.seconds(1.0)
    assert rig.axis.trip is not None
    assert not reason(rig)


@pytest.mark.parametrize("silent_ticks", LONG)
def test_pushed_out_of_sight_a_homed_axis_has_to_be_homed_again(silent_ticks: int) -> None:
    rig = homed(boots=BOOTS)
    rig.silent = True
    for _ in range(silent_ticks):
        rig.tick()
    rig.position += 10.0
    rig.silent, rig.sample = False, rig.position
    rig.seconds(0.1)
    rig.axis.record_heartbeat(BOOTS)
    assert "or the axis was moved unobserved" in reason(rig)


# Counters that wrap, settings that are read again, searches -----------------------------------------------------------


@pytest.mark.parametrize("period", [65.536, 65.536 * 65_536.0])
@pytest.mark.parametrize("silent_ticks", [*SHORT, *LONG])
@pytest.mark.parametrize("place", [300.0, 32.0])
def test_a_counter_that_wraps_and_counts_anew(period: float, silent_ticks: int, place: float) -> None:
    """Within a silence of no doubt, an error that is left over is what the axis could have gone meanwhile."""
    rig = homed(place, period=period)
    rig.sees = lambda position: (position + period / 2.0) % period - period / 2.0
    rig.sample = rig.sees(rig.position)
    rig.seconds(0.1)
    restarts(rig, silent_ticks).seconds(0.1)
    error = abs((rig.axis.drive.position or 0.0) - rig.position)
    allowed = 0.502 + 320.0 * (silent_ticks + 2) * PERIOD_S
    assert reason(rig) or (error <= min(allowed, period / 2.0) and silent_ticks <= LIMIT_TICKS)


def other_settings(rig: AxisRig, change: Callable[[Axis], None] = lambda _: None) -> AxisRig:
    axis = Axis(design_axis(axis_settings({"required": True}, effort=23.0), PERIOD_S), TRAITS)
    axis.continue_from(rig.axis)
    change(axis)
    rig.axis = axis
    return rig


@pytest.mark.parametrize("silent_ticks", LONG)
@pytest.mark.parametrize("boots", [None, BOOTS])
def test_a_restart_is_told_across_a_reload_too(silent_ticks: int, boots: int | None) -> None:
    rig = homed(boots=boots)
    rig.silent = True
    rig.seconds(0.05)
    restarts(other_settings(rig), silent_ticks).seconds(0.1)
    assert reason(rig)


def test_what_was_lost_stays_lost_across_a_reload_with_its_reason() -> None:
    rig = homed()
    rig.axis.reference.lose("one")
    assert reason(other_settings(rig)) == "one"


def test_after_a_reload_with_another_homing_it_says_so() -> None:
    former = homed(required=False)
    assert reason(other_settings(former)) == "[axis.homing] has changed"


@pytest.mark.parametrize(
    ("before", "change", "is_lost"),
    [
        ({}, {"position": 3.0}, True),
        ({}, {"method": "hard_stop"}, True),
        ({"method": "index"}, {"method": "index", "direction": "positive"}, True),
        ({"position": 3.0}, {"position": 3.0}, False),
    ],
)
@pytest.mark.parametrize("required", [True, False])
def test_a_place_that_was_found_by_other_rules_does_not_count_after_a_reload(
    before: dict[str, object], change: dict[str, object], required: bool, is_lost: bool
) -> None:
    """Its number was that of the former settings: "homed" at 1 mm, where the file says 3 by now."""
    wants = {"required": required}
    rig = homed(homing=before | wants)
    axis = Axis(design_axis(axis_settings(change | wants), PERIOD_S), TRAITS)
    axis.continue_from(rig.axis)
    assert axis.reference.lost_because == ("[axis.homing] has changed" if is_lost else "")
    assert axis.referenced is not is_lost


def test_an_axis_that_nobody_has_homed_loses_nothing_by_another_homing() -> None:
    rig = AxisRig(Axis(design_axis(axis_settings(), PERIOD_S), TRAITS))
    axis = Axis(design_axis(axis_settings({"position": 3.0}), PERIOD_S), TRAITS)
    axis.continue_from(rig.axis)
    assert axis.reference.source is ReferenceSource.ENCODER


@pytest.mark.parametrize("silent_ticks", [1, 10])
def test_a_restart_within_a_search_finds_nothing(silent_ticks: int) -> None:
    homing = {"required": True, "method": "index", "direction": "positive", "slow_velocity": 20.0}
    rig = AxisRig(
        Axis(design_axis(axis_settings(homing), PERIOD_S), TRAITS),
        position=200.0,
        sample=200.0,
    )
    rig.armed()
    rig.axis.home()
    rig.seconds(0.5)
    restarts(rig, silent_ticks)
    rig.axis.drive.record_index(3.0)
    rig.seconds(1.0)
    assert rig.state() not in DRIVEN
    assert rig.axis.reference.source is None
