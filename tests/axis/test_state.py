"""The state machine, over every state and every event."""

import itertools

import pytest

from twostage_servo.axis.state import DRIVEN, ENABLED, MOVING, TRANSITIONS, Event, State, next_state

S, E = State, Event

# Written down by hand, a row a state, so that a changed transition has to be changed here as well.
EXPECTED: dict[State, dict[Event, State]] = {
    S.DISARMED: {E.ARM: S.ARMING, E.DISARM: S.DISARMED, E.RESET: S.DISARMED},
    S.ARMING: {
        E.ENABLED: S.HOLDING,
        E.ENABLED_MOVING: S.STOPPING,
        E.DISARM: S.DISARMED,
        E.TRIP_QUICK_STOP: S.TRIPPED,
        E.TRIP_DISABLE: S.TRIPPED,
    },
    S.HOLDING: {
        E.DISARM: S.DISARMED,
        E.MOVE_SPEED: S.SPEED_STAGE,
        E.MOVE_POSITION: S.POSITION_STAGE,
        E.STOP: S.HOLDING,
        E.TRIP_QUICK_STOP: S.QUICK_STOP,
        E.TRIP_DISABLE: S.TRIPPED,
    },
    S.SPEED_STAGE: {
        E.DISARM: S.DISARMING,
        E.MOVE_SPEED: S.SPEED_STAGE,
        E.MOVE_POSITION: S.POSITION_STAGE,
        E.CHANGEOVER: S.POSITION_STAGE,
        E.STOP: S.STOPPING,
        E.TRIP_QUICK_STOP: S.QUICK_STOP,
        E.TRIP_DISABLE: S.TRIPPED,
    },
    S.POSITION_STAGE: {
        E.DISARM: S.DISARMING,
        E.MOVE_SPEED: S.SPEED_STAGE,
        E.MOVE_POSITION: S.POSITION_STAGE,
        E.REACHED: S.HOLDING,
        E.STOP: S.STOPPING,
        E.TRIP_QUICK_STOP: S.QUICK_STOP,
        E.TRIP_DISABLE: S.TRIPPED,
    },
    S.STOPPING: {
        E.DISARM: S.DISARMING,
        E.STOP: S.STOPPING,
        E.AT_REST: S.HOLDING,
        E.TRIP_QUICK_STOP: S.QUICK_STOP,
        E.TRIP_DISABLE: S.TRIPPED,
    },
    S.DISARMING: {
        E.DISARM: S.DISARMING,
        E.AT_REST: S.DISARMED,
        E.TRIP_QUICK_STOP: S.QUICK_STOP,
        E.TRIP_DISABLE: S.TRIPPED,
    },
    S.QUICK_STOP: {E.AT_REST: S.TRIPPED, E.TRIP_DISABLE: S.TRIPPED},
    S.TRIPPED: {E.RESET: S.DISARMED},
}


@pytest.mark.parametrize(("state", "event"), list(itertools.product(State, Event)))
def test_every_state_and_event(state: State, event: Event) -> None:
    assert next_state(state, event) is EXPECTED[state].get(event)


def test_no_event_but_arming_leads_from_rest_to_an_enabled_drive() -> None:
    """Safety rule 1: nothing but `arm` enables the drive, and after a trip nothing but `reset` leads out."""
    for (state, event), after in TRANSITIONS.items():
        if state not in ENABLED and after in ENABLED:
            assert (state, event) == (S.DISARMED, E.ARM)
        if state is S.TRIPPED:
            assert (event, after) == (E.RESET, S.DISARMED)
        if state is S.QUICK_STOP:
            assert after is S.TRIPPED


def test_every_driven_state_can_trip_and_end() -> None:
    for state in DRIVEN:
        assert next_state(state, E.TRIP_DISABLE) is S.TRIPPED
    assert DRIVEN >= MOVING
    assert {S.ARMING} == ENABLED - DRIVEN
