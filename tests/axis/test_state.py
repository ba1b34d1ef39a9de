"""The state machine, over every state and every event, against the rules that it has to keep."""

import re
from pathlib import Path

import pytest

from twostage_servo.axis.state import (
    BRAKING,
    CIA402,
    DRIVEN,
    ENABLED,
    LATCHED,
    Event,
    State,
    next_state,
    transition_table,
)
from twostage_servo.axis.trips import EVENTS, Reaction, trip_table

EVERY = [(state, event) for state in State for event in Event]
SEVERITY = {
    State.TRIPPED_STOPPING: Reaction.CONTROLLED_STOP,
    State.TRIPPED_QUICK_STOP: Reaction.QUICK_STOP,
    State.TRIPPED: Reaction.DISABLE,
}
TRIPS = {event: reaction for reaction, event in EVENTS.items()}


@pytest.mark.parametrize(("state", "event"), EVERY)
def test_the_rules_hold_for_every_state_and_event(state: State, event: Event) -> None:
    after = next_state(state, event)
    if event is Event.TRIP_WHILE_DISABLED:
        assert after is State.TRIPPED  # from everywhere: an axis that is off already latches as well
    elif event in TRIPS:
        trips(state, TRIPS[event], after)
    elif state in LATCHED:
        leaves_a_trip(state, event, after)
    elif state is State.DISARMED:
        assert after in {None, State.DISARMED, State.ARMING}
        assert (after is State.ARMING) == (event is Event.ARM)
    else:
        assert after is None or after not in LATCHED


def trips(state: State, reaction: Reaction, after: State | None) -> None:
    """A trip takes every enabled axis out of operation; the more severe reaction wins and none is taken back."""
    if state in {State.DISARMED, State.TRIPPED}:
        assert after is None
        return
    assert after in LATCHED
    if state is State.ARMING:
        assert after is State.TRIPPED  # no effort acts yet: there is nothing to brake
    else:
        assert SEVERITY[after] == max(reaction, SEVERITY.get(state, Reaction.NONE))


def leaves_a_trip(state: State, event: Event, after: State | None) -> None:
    """Coming to rest ends the braking, which may be asked to be harder; nothing but a reset ends the trip."""
    expected = {
        (State.TRIPPED_STOPPING, Event.AT_REST): State.TRIPPED,
        (State.TRIPPED_QUICK_STOP, Event.AT_REST): State.TRIPPED,
        (State.TRIPPED, Event.RESET): State.DISARMED,
        (State.TRIPPED_STOPPING, Event.STOP): State.TRIPPED_STOPPING,
        (State.TRIPPED_QUICK_STOP, Event.STOP): State.TRIPPED_QUICK_STOP,
        (State.TRIPPED_STOPPING, Event.QUICK_STOP): State.TRIPPED_QUICK_STOP,
        (State.TRIPPED_QUICK_STOP, Event.QUICK_STOP): State.TRIPPED_QUICK_STOP,
        **{(latched, Event.DISARM): latched for latched in LATCHED},
    }
    assert after is expected.get((state, event))


def test_the_operator_may_stop_every_motion_and_disarm_every_axis() -> None:
    for state in State:
        left = next_state(state, Event.DISARM)
        assert left is state if state in LATCHED else left in {State.DISARMED, State.DISARMING}
        if state in DRIVEN - LATCHED - {State.DISARMING}:
            assert next_state(state, Event.STOP) in {State.HOLDING, State.STOPPING, State.QUICK_STOPPING}
            assert next_state(state, Event.QUICK_STOP) in {State.HOLDING, State.QUICK_STOPPING}


def test_every_braking_ends_and_only_a_braking_does() -> None:
    assert {state for state in State if next_state(state, Event.AT_REST)} == BRAKING
    for state in BRAKING:
        after = next_state(state, Event.AT_REST)
        assert after is not None
        assert after not in BRAKING


def test_a_motion_begins_from_holding_alone_or_replaces_one_of_its_kind() -> None:
    for event, own in (
        (Event.JOG, {State.JOGGING}),
        (Event.HOME, set()),
        (Event.MOVE_SPEED, {State.SPEED_STAGE, State.POSITION_STAGE}),
        (Event.MOVE_POSITION, {State.SPEED_STAGE, State.POSITION_STAGE}),
    ):
        assert {state for state in State if next_state(state, event)} == {State.HOLDING, *own}


def test_arming_leads_to_operation_only_by_way_of_the_enabled_drive() -> None:
    into = {(s, e) for s, e in EVERY if next_state(s, e) in DRIVEN and s not in DRIVEN}
    assert into == {(State.ARMING, Event.ENABLED), (State.ARMING, Event.ENABLED_MOVING)}
    assert DRIVEN | {State.ARMING} == ENABLED


def test_the_docs_hold_the_tables_that_the_code_makes() -> None:
    page = (Path(__file__).parents[2] / "docs" / "states.md").read_text(encoding="utf-8")
    assert transition_table() in page, "run python -m tools.write_tables"
    assert trip_table() in page, "run python -m tools.write_tables"
    rows = transition_table().splitlines()[2:]
    assert [row.split("`")[1] for row in rows] == list(State)
    for state, row in zip(State, rows, strict=True):
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert cells[1] == CIA402[state]
        shown = {
            event: way.rpartition("`")[0].rpartition("`")[2]
            for way in "<br>".join(cells[2:]).split("<br>")
            for event in re.findall(r"`(\w+)`", way.partition(" → ")[0])
        }
        assert shown == {str(event): str(after) for event in Event if (after := next_state(state, event))}
