"""Refusals: why a request is not carried out. Every code that any answer of the service may have stands here."""

import enum

from twostage_servo.portable_error import PortableError


class RefusalCode(enum.StrEnum):
    """Stable names of the refusals; ``docs/control-socket.md`` says what each of them means to a client.

    Some are codes of trips as well: what would trip an armed axis keeps a disarmed one from being armed or reset.
    """

    # Of the request itself, or of when it came
    BAD_REQUEST = "bad_request"
    EXPIRED = "expired"
    TOO_MANY_CLIENTS = "too_many_clients"
    AUTHORITY_HELD = "authority_held"
    WHICH_AXIS = "which_axis"
    # Of what the axis does
    BUSY = "busy"
    STOPPED = "stopped"
    DISARMED = "disarmed"
    ALREADY_ARMED = "already_armed"
    ARMED = "armed"
    TRIPPED = "tripped"
    NOT_TRIPPED = "not_tripped"
    LEARNS_NOTHING = "learns_nothing"
    NOT_ERASED = "not_erased"
    # Of its limits and its reference
    POSITION_LIMIT = "position_limit"
    VELOCITY_LIMIT = "velocity_limit"
    LIMIT_SWITCH = "limit_switch"
    NOT_HOMED = "not_homed"
    # Of its drive and its bus
    NO_FEEDBACK = "no_feedback"
    BUS_CLOSED = "bus_closed"
    STILL_ENABLED = "still_enabled"
    SAFE_TORQUE_OFF = "safe_torque_off"
    DRIVE_FAULT = "drive_fault"
    HEARTBEAT_LOST = "heartbeat_lost"
    FEEDBACK_ERRORS = "feedback_errors"
    FOREIGN_COMMAND = "foreign_command"
    DRIVE_NOT_DISABLED = "drive_not_disabled"
    DRIVE_STATE_MISMATCH = "drive_state_mismatch"
    # Of the service
    CONFIG = "config"
    NO_CONFIGURATION = "no_configuration"
    RELOAD_FAILED = "reload_failed"
    ENDING = "ending"
    INTERNAL_ERROR = "internal_error"


Obstacle = tuple[RefusalCode, str]
"""Code and text of a refusal."""


class Refused(PortableError):  # noqa: N818 - not a fault of the program: the answer to a request
    """A request that is not carried out.

    Parameters
    ----------
    code
        Why, in a word that stays the same.
    text
        The same for the operator, with the numbers and what to do instead.
    """

    def __init__(self, code: RefusalCode, text: str) -> None:
        super().__init__(text)
        self.code = code
