"""The move in which faults begin: how far it goes, and how near its set-point each of its phases is."""

from twostage_servo.axis.design import AxisDesign

CRUISE_S, LONG_CRUISE_S = 1.5, 4.0
"""How long a move cruises, where the limits leave room for it."""

_SHORTEST = 0.9
"""The least share of the full length: moves differ, so that no fault always meets the same place."""

_EARLY_TICKS = 4.0
"""Ticks of cruise that a first move may change over before the distance of a plant that is known."""


def plan_target(design: AxisDesign, start: float, velocity: float, share: float, cruise_s: float = CRUISE_S) -> float:
    """Return the set-point of a move with a cruise, within the limits, to the side where there is more room.

    Parameters
    ----------
    design
        The axis.
    start
        Where it begins, in axis unit.
    velocity
        Its cruise velocity, in axis unit/s.
    share
        From 0 to 1: which of the lengths that come into question.
    cruise_s
        How long it shall cruise, in s.
    """
    limits = design.settings.limits
    up, down = limits.position_maximum - start, start - limits.position_minimum
    length = min(
        velocity * (cruise_s + velocity / limits.acceleration) + 1.5 * design.changeover_distance(velocity),
        0.9 * max(up, down),
    )
    length *= _SHORTEST + (1.0 - _SHORTEST) * share
    return start + (length if up >= down else -length)


def cruise_end(design: AxisDesign, velocity: float) -> float:
    """Return the distance from the set-point, in axis unit, at which the cruise is about to end.

    A law that does not know its plant yet may change over some ticks before its design's distance.
    """
    distance = design.changeover_distance(velocity)
    return max(1.3 * distance, distance + _EARLY_TICKS * velocity * design.period_s)


def settling_begin(design: AxisDesign, velocity: float) -> float:
    """Return the distance from the set-point, in axis unit, from which on the axis only settles."""
    return 0.1 * design.changeover_distance(velocity)
