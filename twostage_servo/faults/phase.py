"""The phases of a motion in which the fault campaign lets its faults begin."""

import enum


class Phase(enum.StrEnum):
    """What the axis does when the fault begins."""

    IDLE = "idle"
    ACCELERATING = "accelerating"
    CRUISING = "cruising"
    CHANGEOVER = "change-over"
    SETTLING = "settling"
    HOLDING = "holding"
    HOMING = "homing"
    """It looks for its reference, at the velocity of the search."""
    JOGGING = "jogging"
    """It moves for as long as the operator asks for it."""
    STOPPING = "stopping"
    """It brakes since the operator's `stop` in a cruise."""
    QUICK_STOPPING = "quick stopping"
    """It brakes since the operator's `stop --quick` in a cruise."""


MOVING = (Phase.ACCELERATING, Phase.CRUISING, Phase.CHANGEOVER, Phase.SETTLING)
ARMED = (*MOVING, Phase.HOLDING)
ALL = (Phase.IDLE, *ARMED)
"""The phases of a move."""
SEARCHING = (Phase.HOMING, Phase.JOGGING)
"""Motion without a set-point: the severe faults begin in it as well."""
EVERYWHERE = (*ALL, *SEARCHING)
BRAKED = (Phase.STOPPING, Phase.QUICK_STOPPING)
"""An operator's stop: an encoder that fails in it takes away what brakes the axis."""
