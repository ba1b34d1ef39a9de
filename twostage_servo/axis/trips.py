"""Trips: what can latch an axis out of operation, how it reacts, and what the operator should do next."""

import enum
from dataclasses import dataclass


class Reaction(enum.IntEnum):
    """What a trip does to the motion; the more severe one wins."""

    QUICK_STOP = 1
    """Brake with the quick stop deceleration, then disable."""
    DISABLE = 2
    """Effort zero and drive disabled at once."""


class TripCode(enum.StrEnum):
    """Stable names of the trips."""

    STALE_FEEDBACK = "stale_feedback"
    FOLLOWING_ERROR = "following_error"
    POSITION_LIMIT = "position_limit"
    OVERSPEED = "overspeed"
    EFFORT_SATURATED = "effort_saturated"
    MISSED_TICKS = "missed_ticks"
    NOT_FINITE = "not_finite"
    DRIVE_FAULT = "drive_fault"
    DRIVE_DROPPED_OUT = "drive_dropped_out"
    DRIVE_NOT_ENABLED = "drive_not_enabled"
    BUS_FAILED = "bus_failed"
    FOREIGN_COMMAND = "foreign_command"


@dataclass(frozen=True, slots=True)
class TripRule:
    """What belongs to a trip's code."""

    reaction: Reaction
    next_action: str


RULES: dict[TripCode, TripRule] = {
    TripCode.STALE_FEEDBACK: TripRule(
        Reaction.DISABLE,
        "Check the drive's supply, its bus cable and its identifiers, then `reset` and `arm`.",
    ),
    TripCode.FOLLOWING_ERROR: TripRule(
        Reaction.QUICK_STOP,
        "Look for a jam, a load or a wrong plant model ([axis.plant], `design`), then `reset` and `arm`.",
    ),
    TripCode.POSITION_LIMIT: TripRule(
        Reaction.QUICK_STOP,
        "Move the axis back between its position limits by hand, then `reset` and `arm`.",
    ),
    TripCode.OVERSPEED: TripRule(
        Reaction.DISABLE,
        "Check the encoder's sign and scale and the plant model, then `reset` and `arm`.",
    ),
    TripCode.EFFORT_SATURATED: TripRule(
        Reaction.QUICK_STOP,
        "Lower the velocity, look for a jam or a load, or raise axis.limits.effort, then `reset` and `arm`.",
    ),
    TripCode.MISSED_TICKS: TripRule(
        Reaction.QUICK_STOP,
        "Look for what kept the processor from this service (load, swapping, a suspension), then `reset` and `arm`.",
    ),
    TripCode.NOT_FINITE: TripRule(
        Reaction.DISABLE,
        "Report this with the recording of the last ticks (`status --recording`); then `reset` and `arm`.",
    ),
    TripCode.DRIVE_FAULT: TripRule(
        Reaction.DISABLE,
        "Look up the drive's fault code in its manual, remove the cause, then `reset` and `arm`.",
    ),
    TripCode.DRIVE_DROPPED_OUT: TripRule(
        Reaction.DISABLE,
        "The drive disabled itself: check its command time-out, safety inputs and supply, then `reset` and `arm`.",
    ),
    TripCode.DRIVE_NOT_ENABLED: TripRule(
        Reaction.DISABLE,
        "The drive did not follow the enable bit: check its fault code and safety inputs, then `reset` and `arm`.",
    ),
    TripCode.FOREIGN_COMMAND: TripRule(
        Reaction.DISABLE,
        "End the other service or tool that commands this drive, then `reset` and `arm`.",
    ),
    TripCode.BUS_FAILED: TripRule(
        Reaction.DISABLE,
        "Bring the bus back (interface, cable, whatever serves it); when `status` shows it open, `reset` and `arm`.",
    ),
}


@dataclass(frozen=True, slots=True)
class Trip:
    """A latched fault.

    Attributes
    ----------
    code
        Which trip.
    cause
        What happened, with its numbers.
    tick
        Index of the tick at which it was detected.
    """

    code: TripCode
    cause: str
    tick: int

    @property
    def reaction(self) -> Reaction:
        """The reaction that belongs to the code."""
        return RULES[self.code].reaction

    @property
    def next_action(self) -> str:
        """What the operator should do next."""
        return RULES[self.code].next_action
