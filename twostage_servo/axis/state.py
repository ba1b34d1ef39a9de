"""The state machine of an axis: a pure table from state and event to the next state."""

import enum
from types import MappingProxyType


class State(enum.StrEnum):
    """States of an axis, with the CiA 402 state each corresponds to."""

    DISARMED = "disarmed"
    """Ready to switch on: effort zero, drive disabled."""
    ARMING = "arming"
    """Switched on: the drive is told to enable, effort zero, until it reports that it is enabled."""
    HOLDING = "holding"
    """Operation enabled, target reached: the position stage holds the set-point."""
    SPEED_STAGE = "moving_speed_stage"
    """Operation enabled: cruising towards the set-point."""
    POSITION_STAGE = "moving_position_stage"
    """Operation enabled: closing in on the set-point."""
    STOPPING = "stopping"
    """Operation enabled, halt: braking, to hold where the axis comes to rest."""
    DISARMING = "disarming"
    """Braking, to be disarmed when the axis is at rest."""
    QUICK_STOP = "tripped_quick_stop"
    """Quick stop active: a trip has latched, braking."""
    TRIPPED = "tripped"
    """Fault: a trip has latched, effort zero, drive disabled, until reset."""


class Event(enum.StrEnum):
    """What can happen to an axis."""

    ARM = "arm"
    ENABLED = "enabled"
    ENABLED_MOVING = "enabled_moving"
    DISARM = "disarm"
    MOVE_SPEED = "move_speed_stage"
    MOVE_POSITION = "move_position_stage"
    CHANGEOVER = "changeover"
    REACHED = "reached"
    STOP = "stop"
    AT_REST = "at_rest"
    TRIP_QUICK_STOP = "trip_quick_stop"
    TRIP_DISABLE = "trip_disable"
    RESET = "reset"


_S, _E = State, Event
_OPERATING = (_S.HOLDING, _S.SPEED_STAGE, _S.POSITION_STAGE, _S.STOPPING)
_MOVABLE = (_S.HOLDING, _S.SPEED_STAGE, _S.POSITION_STAGE)

TRANSITIONS: MappingProxyType[tuple[State, Event], State] = MappingProxyType(
    {
        (_S.DISARMED, _E.ARM): _S.ARMING,
        (_S.ARMING, _E.ENABLED): _S.HOLDING,
        (_S.ARMING, _E.ENABLED_MOVING): _S.STOPPING,
        (_S.ARMING, _E.DISARM): _S.DISARMED,
        (_S.DISARMED, _E.DISARM): _S.DISARMED,
        (_S.HOLDING, _E.DISARM): _S.DISARMED,
        (_S.SPEED_STAGE, _E.DISARM): _S.DISARMING,
        (_S.POSITION_STAGE, _E.DISARM): _S.DISARMING,
        (_S.STOPPING, _E.DISARM): _S.DISARMING,
        (_S.DISARMING, _E.DISARM): _S.DISARMING,
        (_S.DISARMING, _E.AT_REST): _S.DISARMED,
        **{(state, _E.MOVE_SPEED): _S.SPEED_STAGE for state in _MOVABLE},
        **{(state, _E.MOVE_POSITION): _S.POSITION_STAGE for state in _MOVABLE},
        (_S.SPEED_STAGE, _E.CHANGEOVER): _S.POSITION_STAGE,
        (_S.POSITION_STAGE, _E.REACHED): _S.HOLDING,
        (_S.SPEED_STAGE, _E.STOP): _S.STOPPING,
        (_S.POSITION_STAGE, _E.STOP): _S.STOPPING,
        (_S.STOPPING, _E.STOP): _S.STOPPING,
        (_S.HOLDING, _E.STOP): _S.HOLDING,
        (_S.STOPPING, _E.AT_REST): _S.HOLDING,
        **{(state, _E.TRIP_QUICK_STOP): _S.QUICK_STOP for state in (*_OPERATING, _S.DISARMING)},
        (_S.ARMING, _E.TRIP_QUICK_STOP): _S.TRIPPED,
        **{(state, _E.TRIP_DISABLE): _S.TRIPPED for state in (_S.ARMING, *_OPERATING, _S.DISARMING, _S.QUICK_STOP)},
        (_S.QUICK_STOP, _E.AT_REST): _S.TRIPPED,
        (_S.TRIPPED, _E.RESET): _S.DISARMED,
        (_S.DISARMED, _E.RESET): _S.DISARMED,
    }
)

DRIVEN = frozenset({*_OPERATING, _S.DISARMING, _S.QUICK_STOP})
"""States in which the law runs and the effort may be other than zero."""

ENABLED = DRIVEN | {_S.ARMING}
"""States in which the drive is told to be enabled."""

MOVING = frozenset({_S.SPEED_STAGE, _S.POSITION_STAGE})
"""States in which a move is under way."""


def next_state(state: State, event: Event) -> State | None:
    """Return the state that follows, or None where the event is not admitted in this state."""
    return TRANSITIONS.get((state, event))
