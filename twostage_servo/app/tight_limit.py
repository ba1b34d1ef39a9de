"""The limit that ends a move even on the plant of the model, and the value of it that would do."""

from dataclasses import dataclass, replace
from typing import Final

from twostage_servo.app.expected_response import Expectation, PlannedMove, respond
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.axis.trips import TripCode


@dataclass(frozen=True, slots=True)
class TightLimit:
    """A limit that the response of the model's own plant breaks.

    Attributes
    ----------
    key, value
        Below ``axis.limits``, and what it is; None for a trip that is about no limit.
    enough
        What would do; None where no larger value of it does.
    move, trip
        The move, and the trip that ends it.
    """

    key: str | None
    value: float | None
    enough: float | None
    move: PlannedMove
    trip: TripCode


_LIMITS: Final[dict[TripCode, str]] = {
    TripCode.OVERSPEED: "overspeed",
    TripCode.FOLLOWING_ERROR: "following_error_minimum",
    TripCode.SPEED_UNREACHABLE: "effort_saturation_ms",
    TripCode.STALL: "stall_effort",
    TripCode.POSITION_LIMIT: "position_overrun",
    TripCode.POSITION_JUMP: "innovation_gate",
}
"""The limit that each of these trips is about."""

_WIDER: Final = (1.05, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0)
"""Multiples of a limit that are tried."""


def tight_limit(design: AxisDesign, traits: DriveTraits, expected: Expectation) -> TightLimit | None:
    """Return the limit that a move breaks even on the plant of the model; None if there is none."""
    trip, limits = expected.nominal.trip, design.settings.limits
    if trip is None:
        return None
    if (key := _LIMITS.get(trip)) is None:
        return TightLimit(None, None, None, expected.move, trip)
    value = float(getattr(limits, key))
    enough = None
    for factor in _WIDER:
        if respond(_with_limit(design, key, factor * value), traits, expected.move).trip is None:
            enough = factor * value
            break
    return TightLimit(key, value, enough, expected.move, trip)


def _with_limit(design: AxisDesign, key: str, value: float) -> AxisDesign:
    limits = design.settings.limits.model_copy(update={key: value})
    return replace(design, settings=design.settings.model_copy(update={"limits": limits}))
