"""The state machine of an axis in the terms of CiA 402: a pure table from state and event to the next state."""

import enum
from collections.abc import Iterable
from types import MappingProxyType


class State(enum.StrEnum):
    """States of an axis. :data:`CIA402` names the state of CiA 402 (IEC 61800-7-201) that each one refines."""

    DISARMED = "disarmed"
    """Effort zero, drive told to be disabled."""
    ARMING = "arming"
    """The drive is told to enable, effort zero, until it reports that it is enabled."""
    HOLDING = "holding"
    """The position stage holds the place."""
    SPEED_STAGE = "moving_speed_stage"
    """Cruising towards the set-point."""
    POSITION_STAGE = "moving_position_stage"
    """Closing in on the set-point."""
    JOGGING = "jogging"
    """Moving for as long as the operator asks for it."""
    HOMING = "homing"
    """Looking for the place from which positions are counted."""
    STOPPING = "stopping"
    """Controlled stop: braking with the acceleration limit, to hold where the axis comes to rest."""
    QUICK_STOPPING = "quick_stopping"
    """The operator's quick stop: braking with the quick stop deceleration, then to hold."""
    DISARMING = "disarming"
    """Controlled stop, to be disarmed at rest."""
    TRIPPED_STOPPING = "tripped_stopping"
    """A trip has latched: controlled stop, then disabled."""
    TRIPPED_QUICK_STOP = "tripped_quick_stop"
    """A trip has latched: quick stop, then disabled."""
    TRIPPED = "tripped"
    """A trip has latched: effort zero, drive told to be disabled, until reset."""


class Event(enum.StrEnum):
    """What can happen to an axis."""

    ARM = "arm"
    ENABLED = "enabled"
    ENABLED_MOVING = "enabled_moving"
    DISARM = "disarm"
    MOVE_SPEED = "move_speed_stage"
    MOVE_POSITION = "move_position_stage"
    JOG = "jog"
    HOME = "home"
    CHANGEOVER = "changeover"
    REACHED = "reached"
    STOP = "stop"
    QUICK_STOP = "quick_stop"
    AT_REST = "at_rest"
    TRIP_STOP = "trip_stop"
    TRIP_QUICK_STOP = "trip_quick_stop"
    TRIP_DISABLE = "trip_disable"
    TRIP_WHILE_DISABLED = "trip_while_disabled"
    RESET = "reset"


_S, _E = State, Event
_TRIPS = (_E.TRIP_STOP, _E.TRIP_QUICK_STOP, _E.TRIP_DISABLE, _E.TRIP_WHILE_DISABLED)
_SET_POINT = (_S.HOLDING, _S.SPEED_STAGE, _S.POSITION_STAGE)
_COMMANDED = (_S.SPEED_STAGE, _S.POSITION_STAGE, _S.JOGGING, _S.HOMING)
_OPERATING = (_S.HOLDING, *_COMMANDED, _S.STOPPING, _S.QUICK_STOPPING, _S.DISARMING)

TRANSITIONS: MappingProxyType[tuple[State, Event], State] = MappingProxyType(
    {
        (_S.DISARMED, _E.ARM): _S.ARMING,
        (_S.ARMING, _E.ENABLED): _S.HOLDING,
        (_S.ARMING, _E.ENABLED_MOVING): _S.STOPPING,
        # What the operator asks for
        **{(state, _E.MOVE_SPEED): _S.SPEED_STAGE for state in _SET_POINT},
        **{(state, _E.MOVE_POSITION): _S.POSITION_STAGE for state in _SET_POINT},
        **{(state, _E.JOG): _S.JOGGING for state in (_S.HOLDING, _S.JOGGING)},
        (_S.HOLDING, _E.HOME): _S.HOMING,
        **{(_S.ARMING, event): _S.DISARMED for event in (_E.STOP, _E.QUICK_STOP)},
        (_S.HOLDING, _E.STOP): _S.HOLDING,
        **{(state, _E.STOP): _S.STOPPING for state in (*_COMMANDED, _S.STOPPING)},
        (_S.QUICK_STOPPING, _E.STOP): _S.QUICK_STOPPING,
        **{(_S.DISARMING, event): _S.DISARMING for event in (_E.STOP, _E.QUICK_STOP)},
        (_S.HOLDING, _E.QUICK_STOP): _S.HOLDING,
        **{(state, _E.QUICK_STOP): _S.QUICK_STOPPING for state in (*_COMMANDED, _S.STOPPING, _S.QUICK_STOPPING)},
        **{(state, _E.STOP): state for state in (_S.TRIPPED_STOPPING, _S.TRIPPED_QUICK_STOP)},
        **{(state, _E.QUICK_STOP): _S.TRIPPED_QUICK_STOP for state in (_S.TRIPPED_STOPPING, _S.TRIPPED_QUICK_STOP)},
        **{(state, _E.DISARM): _S.DISARMED for state in (_S.DISARMED, _S.ARMING, _S.HOLDING)},
        **{(state, _E.DISARM): _S.DISARMING for state in (*_COMMANDED, _S.STOPPING, _S.QUICK_STOPPING, _S.DISARMING)},
        # A tripped axis is off, or brakes to be: that is all that it is asked for, and what it does
        **{(state, _E.DISARM): state for state in (_S.TRIPPED_STOPPING, _S.TRIPPED_QUICK_STOP, _S.TRIPPED)},
        (_S.TRIPPED, _E.RESET): _S.DISARMED,
        (_S.DISARMED, _E.RESET): _S.DISARMED,
        # What the motion comes to
        (_S.SPEED_STAGE, _E.CHANGEOVER): _S.POSITION_STAGE,
        (_S.POSITION_STAGE, _E.CHANGEOVER): _S.POSITION_STAGE,
        (_S.JOGGING, _E.CHANGEOVER): _S.JOGGING,
        (_S.HOMING, _E.CHANGEOVER): _S.HOMING,
        **{(state, _E.REACHED): _S.HOLDING for state in (_S.POSITION_STAGE, _S.JOGGING, _S.HOMING)},
        (_S.STOPPING, _E.AT_REST): _S.HOLDING,
        (_S.QUICK_STOPPING, _E.AT_REST): _S.HOLDING,
        (_S.DISARMING, _E.AT_REST): _S.DISARMED,
        (_S.TRIPPED_STOPPING, _E.AT_REST): _S.TRIPPED,
        (_S.TRIPPED_QUICK_STOP, _E.AT_REST): _S.TRIPPED,
        # Trips: the most severe reaction wins, and none of them is taken back
        **{(state, _E.TRIP_STOP): _S.TRIPPED_STOPPING for state in (*_OPERATING, _S.TRIPPED_STOPPING)},
        (_S.TRIPPED_QUICK_STOP, _E.TRIP_STOP): _S.TRIPPED_QUICK_STOP,
        **{
            (state, _E.TRIP_QUICK_STOP): _S.TRIPPED_QUICK_STOP
            for state in (*_OPERATING, _S.TRIPPED_STOPPING, _S.TRIPPED_QUICK_STOP)
        },
        (_S.ARMING, _E.TRIP_STOP): _S.TRIPPED,
        (_S.ARMING, _E.TRIP_QUICK_STOP): _S.TRIPPED,
        **{
            (state, _E.TRIP_DISABLE): _S.TRIPPED
            for state in (_S.ARMING, *_OPERATING, _S.TRIPPED_STOPPING, _S.TRIPPED_QUICK_STOP)
        },
        # What is wrong with a drive that should be off latches an axis that is disabled as well
        **{(state, _E.TRIP_WHILE_DISABLED): _S.TRIPPED for state in State},
    }
)

CIA402: MappingProxyType[State, str] = MappingProxyType(
    {
        _S.DISARMED: "ready to switch on",
        _S.ARMING: "switched on",
        **dict.fromkeys(_SET_POINT, "operation enabled"),
        **dict.fromkeys((_S.JOGGING, _S.HOMING, _S.STOPPING, _S.DISARMING), "operation enabled"),
        _S.QUICK_STOPPING: "quick stop active",
        _S.TRIPPED_STOPPING: "fault reaction active",
        _S.TRIPPED_QUICK_STOP: "fault reaction active",
        _S.TRIPPED: "fault",
    }
)
"""The state of CiA 402 that each state refines; a disarmed axis that may not be armed is `switch on disabled`."""

DRIVEN = frozenset({*_OPERATING, _S.TRIPPED_STOPPING, _S.TRIPPED_QUICK_STOP})
"""States in which the law runs and the effort may be other than zero."""

ENABLED = DRIVEN | {_S.ARMING}
"""States in which the drive is told to be enabled."""

MOVING = frozenset({_S.SPEED_STAGE, _S.POSITION_STAGE})
"""States in which a move to a set-point is under way."""

COMMANDED = frozenset(_COMMANDED)
"""States in which the axis moves because somebody asked for it."""

BRAKING = frozenset({_S.STOPPING, _S.QUICK_STOPPING, _S.DISARMING, _S.TRIPPED_STOPPING, _S.TRIPPED_QUICK_STOP})
"""States in which the axis is being brought to rest."""

OVERRIDABLE = COMMANDED | {State.HOLDING, State.STOPPING, State.QUICK_STOPPING}
"""States of an axis that is armed and stays so: it takes a speed override, if only for its next motion."""

LATCHED = frozenset({_S.TRIPPED_STOPPING, _S.TRIPPED_QUICK_STOP, _S.TRIPPED})
"""States of an axis that has tripped."""


def next_state(state: State, event: Event) -> State | None:
    """Return the state that follows, or None where the event is not admitted in this state."""
    return TRANSITIONS.get((state, event))


def transition_table() -> str:
    """Return the whole table as Markdown, a row a state: each event that it admits, and the state that follows."""
    lines = ["| state | CiA 402 | event → next state | trip → next state |", "|---|---|---|---|"]
    for state in State:
        events = [event for event in Event if event not in _TRIPS]
        lines.append(f"| `{state}` | {CIA402[state]} | {_ways(state, events)} | {_ways(state, _TRIPS)} |")
    return "\n".join(lines)


def _ways(state: State, events: Iterable[Event]) -> str:
    """Return a cell of the table: which of the events a state admits, those with the same next state in one line."""
    ways: dict[State, list[str]] = {}
    for event in events:
        if (after := next_state(state, event)) is not None:
            ways.setdefault(after, []).append(f"`{event}`")
    return "<br>".join(f"{', '.join(names)} → `{after}`" for after, names in ways.items())
