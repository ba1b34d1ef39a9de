"""Trips: what can latch an axis out of operation, how it reacts, and what the operator should do next."""

import enum
from typing import NamedTuple

from twostage_servo.axis.state import Event


class Reaction(enum.IntEnum):
    """What becomes of the motion; the more severe one wins."""

    NONE = 0
    """Tolerated: the model bridges it, and it is counted."""
    HOLD = 1
    """Controlled stop, then hold; nothing latches."""
    CONTROLLED_STOP = 2
    """Brake with the acceleration limit, then disable; latched."""
    QUICK_STOP = 3
    """Brake with the quick stop deceleration, then disable; latched."""
    DISABLE = 4
    """Effort zero and drive disabled at once; latched."""


EVENTS = {
    Reaction.CONTROLLED_STOP: Event.TRIP_STOP,
    Reaction.QUICK_STOP: Event.TRIP_QUICK_STOP,
    Reaction.DISABLE: Event.TRIP_DISABLE,
}
"""The event by which each latching reaction enters the state machine."""


class TripCode(enum.StrEnum):
    """Stable names of the trips."""

    STALE_FEEDBACK = "stale_feedback"
    FEEDBACK_ERRORS = "feedback_errors"
    POSITION_JUMP = "position_jump"
    MODEL_MISMATCH = "model_mismatch"
    SIGN_REVERSED = "sign_reversed"
    STALL = "stall"
    SPEED_UNREACHABLE = "speed_unreachable"
    EFFORT_SATURATED = "effort_saturated"
    FOLLOWING_ERROR = "following_error"
    POSITION_LIMIT = "position_limit"
    LIMIT_SWITCH = "limit_switch"
    OVERSPEED = "overspeed"
    MISSED_TICKS = "missed_ticks"
    NOT_FINITE = "not_finite"
    BRAKING_FAILED = "braking_failed"
    HOMING_FAILED = "homing_failed"
    DRIVE_FAULT = "drive_fault"
    DRIVE_DROPPED_OUT = "drive_dropped_out"
    DRIVE_NOT_ENABLED = "drive_not_enabled"
    DRIVE_NOT_DISABLED = "drive_not_disabled"
    DRIVE_STATE_MISMATCH = "drive_state_mismatch"
    DRIVE_REBOOTED = "drive_rebooted"
    SAFE_TORQUE_OFF = "safe_torque_off"
    HEARTBEAT_LOST = "heartbeat_lost"
    COMMANDS_DROPPED = "commands_dropped"
    FOREIGN_COMMAND = "foreign_command"
    BUS_FAILED = "bus_failed"
    INTERNAL_ERROR = "internal_error"


class TripRule(NamedTuple):
    """What belongs to a trip's code.

    Attributes
    ----------
    reaction
        What becomes of the motion.
    next_action
        What the operator should do.
    blind
        Whether the feedback is no longer believed, so that the model alone has to brake.
    reckoned
        Whether the estimate is in doubt as well, since the feedback has been wrong for some time: the model then brakes
        from what it says of the speed itself.
    position_in_doubt
        Why positions can't be trusted any more until the axis has been homed again; empty if they can.
    while_disabled
        Whether an axis trips by it that is disabled, or has tripped, already.
    """

    reaction: Reaction
    next_action: str
    blind: bool = False
    reckoned: bool = False
    position_in_doubt: str = ""
    while_disabled: bool = False

    @property
    def unreferenced(self) -> bool:
        """Whether the axis loses its reference."""
        return bool(self.position_in_doubt)


_QUICK, _DISABLE = Reaction.QUICK_STOP, Reaction.DISABLE

RULES: dict[TripCode, TripRule] = {
    TripCode.STALE_FEEDBACK: TripRule(
        _QUICK,
        "Check the drive's supply, its bus cable and its identifiers; if the cause mentions late frames, find the "
        "node that floods the bus; a simulated drive is a program, and late on a busy host. Then `reset` and `arm`, "
        "and `home` if `status` says that the position is not known.",
        blind=True,
    ),
    TripCode.FEEDBACK_ERRORS: TripRule(
        _QUICK,
        "If `frames` in `status` counts `implausible` samples, check the encoder and axis.limits.innovation_gate; "
        "otherwise look for a bad cable, a missing termination or a second node with this identifier. Then `reset` and "
        "`arm`.",
        blind=True,
    ),
    TripCode.POSITION_JUMP: TripRule(
        _QUICK,
        "Check encoder and coupling, and whether the axis has hit something or a load pulls it; then `reset`, `arm` "
        "and `home`: the position is no longer known.",
        blind=True,
        position_in_doubt="the encoder may have lost or gained counts",
    ),
    TripCode.MODEL_MISMATCH: TripRule(
        _QUICK,
        "Check the encoder's scale, the drive's gain and the plant model ([axis.plant], `design`); then `reset`, `arm` "
        "and `home`: a position counted at a wrong scale is wrong.",
        reckoned=True,
        position_in_doubt="the encoder may count at another scale",
    ),
    TripCode.SIGN_REVERSED: TripRule(
        _QUICK,
        "Reverse the sign of the encoder or of the effort (protocol.feedback.position_scale, axis.plant.gain, the "
        "wiring); then `reset`, `arm` and `home`: a position counted the wrong way is wrong.",
        reckoned=True,
        position_in_doubt="the encoder may count the wrong way",
    ),
    TripCode.STALL: TripRule(
        _QUICK,
        "Find what blocks the axis, or why the encoder is frozen; then `reset`, `arm` and `home`: the axis may have "
        "moved undetected.",
        reckoned=True,
        position_in_doubt="a frozen encoder looks like an axis at standstill",
    ),
    TripCode.SPEED_UNREACHABLE: TripRule(
        Reaction.CONTROLLED_STOP,
        "Lower the velocity, look for a load, or raise axis.limits.effort, then `reset` and `arm`.",
    ),
    TripCode.EFFORT_SATURATED: TripRule(
        _QUICK,
        "Look for what pushes the axis away, or raise axis.limits.effort, then `reset` and `arm`.",
    ),
    TripCode.FOLLOWING_ERROR: TripRule(
        _QUICK,
        "Look for an obstacle, a load or a wrong plant model ([axis.plant], `design`), then `reset` and `arm`.",
    ),
    TripCode.POSITION_LIMIT: TripRule(
        _QUICK,
        "Find out why the axis approached its limit at that speed, then `reset`, `arm` and move it back.",
    ),
    TripCode.LIMIT_SWITCH: TripRule(
        _QUICK,
        "`reset`, `arm` and move off the switch: only motion away from it is accepted.",
    ),
    TripCode.OVERSPEED: TripRule(
        _DISABLE,
        "Check the encoder's sign and scale and the plant model; then `reset`, `arm`, and `home`: either the axis was "
        "too fast, or its encoder is wrong.",
        position_in_doubt="the excessive speed may be an error of the encoder",
    ),
    TripCode.MISSED_TICKS: TripRule(
        _QUICK,
        "Find what kept this service from running (load, swapping, a suspended host), then `reset` and `arm`.",
    ),
    TripCode.NOT_FINITE: TripRule(
        _DISABLE,
        "Report this with the recording of the last ticks (`status --recording`); then `reset` and `arm`.",
    ),
    TripCode.BRAKING_FAILED: TripRule(
        _DISABLE,
        "The axis did not slow down as its model predicts: check that the drive follows the effort, then `reset` and "
        "`arm`.",
    ),
    TripCode.HOMING_FAILED: TripRule(
        _QUICK,
        "Check the reference that [axis.homing] names, and homing.travel, then `reset`, `arm` and `home`.",
    ),
    TripCode.DRIVE_FAULT: TripRule(
        _DISABLE,
        "Look up the drive's fault code in its manual, remove the cause, then `reset` and `arm`.",
    ),
    TripCode.DRIVE_DROPPED_OUT: TripRule(
        _DISABLE,
        "The drive disabled itself: check its command time-out, safety inputs and supply, then `reset` and `arm`.",
    ),
    TripCode.DRIVE_NOT_ENABLED: TripRule(
        _DISABLE,
        "If the drive did not follow the enable bit, check its fault code and safety inputs; if samples were missing, "
        "check its bus, and the host with `twostage-servo doctor`. Then `reset` and `arm`.",
    ),
    TripCode.DRIVE_NOT_DISABLED: TripRule(
        _DISABLE,
        "The drive does not obey: switch off its power, or activate safe torque off. Look for another controller, and "
        "check the drive's enable input, mode and fault; `reset` when it reports that it is disabled.",
        while_disabled=True,
    ),
    TripCode.DRIVE_STATE_MISMATCH: TripRule(
        _DISABLE,
        "Treat the drive as enabled until you know. Compare the signals that [protocol] names with its manual; if its "
        "heartbeat's state has another meaning, set protocol.heartbeat.state to false. Then `reset` and `arm`.",
        while_disabled=True,
    ),
    TripCode.DRIVE_REBOOTED: TripRule(
        _DISABLE,
        "Check the drive's supply; then `reset`, `arm`, and `home`: the drive has lost its position.",
        position_in_doubt="the encoder restarts its count",
    ),
    TripCode.SAFE_TORQUE_OFF: TripRule(
        _DISABLE,
        "Find what activated it (emergency stop, door, light curtain), release it, then `reset` and `arm`.",
    ),
    TripCode.HEARTBEAT_LOST: TripRule(
        _DISABLE,
        "The drive's firmware may hang: check its state, switch it off and on, then `reset` and `arm`, and `home` "
        "if `status` says that the position is not known.",
    ),
    TripCode.COMMANDS_DROPPED: TripRule(
        _QUICK,
        "The bus does not accept frames: look for a babbling node or a missing termination, then `reset` and `arm`.",
    ),
    TripCode.FOREIGN_COMMAND: TripRule(
        _DISABLE,
        "Keep away from the axis: another controller can move it. End the other service or tool that commands this "
        "drive. After a trip, `reset` and `arm`.",
        while_disabled=True,
    ),
    TripCode.BUS_FAILED: TripRule(
        _DISABLE,
        "Restore the bus (interface, cable, its server); when `status` shows it open, `reset` and `arm`, "
        "and `home` if it says that the position is not known.",
    ),
    TripCode.INTERNAL_ERROR: TripRule(
        _QUICK,
        "Report this with the traceback in the log. The service ends and has to be started again.",
    ),
}


class TripFile:
    """What becomes of the file of one trip.

    Attributes
    ----------
    path
        Where it is, as soon as it is whole; None before.
    error
        Why it could not be written, or None.
    """

    __slots__ = ("error", "path")

    def __init__(self) -> None:
        self.path: str | None = None
        self.error: str | None = None

    def complete(self, path: str) -> None:
        """Tell where it is: it is whole."""
        self.path = path

    def fail(self, error: str) -> None:
        """Tell why it could not be written."""
        self.error = error


class Trip:
    """A latched fault, which is not changed. An operator's command reads its codes: data classes import too much.

    Attributes
    ----------
    code
        Which trip.
    cause
        What happened, with its numbers.
    tick
        Index of the tick at which it was detected.
    file
        Its file, which tells what the service saw before it.
    """

    __slots__ = ("cause", "code", "file", "tick")

    def __init__(self, code: TripCode, cause: str, tick: int) -> None:
        self.code = code
        self.cause = cause
        self.tick = tick
        self.file = TripFile()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trip):
            return NotImplemented
        return (self.code, self.cause, self.tick) == (other.code, other.cause, other.tick)

    def __hash__(self) -> int:
        return hash((self.code, self.cause, self.tick))

    def __repr__(self) -> str:
        return f"Trip(code={self.code!r}, cause={self.cause!r}, tick={self.tick!r})"

    @property
    def reaction(self) -> Reaction:
        """The reaction that belongs to the code."""
        return RULES[self.code].reaction

    @property
    def next_action(self) -> str:
        """What the operator should do next."""
        return RULES[self.code].next_action


def trip_table() -> str:
    """Return the trips as Markdown, as they stand in the docs."""
    lines = ["| trip | reaction | what to do next |", "|---|---|---|"]
    for code, rule in RULES.items():
        how = rule.reaction.name.lower().replace("_", " ")
        how += ", on the model alone" if rule.blind else ""
        how += ", on the model alone, from the speed that it computes" if rule.reckoned else ""
        how += f"; the reference is lost: {rule.position_in_doubt}" if rule.unreferenced else ""
        how += "; also while disabled" if rule.while_disabled else ""
        lines.append(f"| `{code}` | {how} | {rule.next_action} |")
    return "\n".join(lines)
