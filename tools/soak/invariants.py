"""What must hold at every tick of a soak, whatever was asked and whatever failed."""

import resource

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import MODEL_ERROR
from twostage_servo.axis.messages import Command
from twostage_servo.axis.state import DRIVEN, State


class BrokenInvariantError(AssertionError):
    """What did not hold, with its numbers."""


class Invariants:
    """Looks at an axis after each tick.

    Parameters
    ----------
    axis
        The axis.

    Attributes
    ----------
    ticks
        Ticks looked at.
    farthest
        Largest distance beyond a position limit so far, in axis unit.
    """

    __slots__ = (
        "_axis", "_effort_limit", "_farthest_allowed", "_high", "_largest_step", "_last_effort", "_low", "_tripped",
        "farthest",
        "ticks",
    )  # fmt: skip

    def __init__(self, axis: Axis) -> None:
        limits = axis.settings.limits
        self._axis = axis
        self._effort_limit = limits.effort
        self._largest_step = limits.effort_rate * axis.design.period_s
        self._low, self._high = limits.position_minimum, limits.position_maximum
        self._farthest_allowed = allowed_overrun(axis)
        self._last_effort = 0.0
        self._tripped = False
        self.ticks = 0
        self.farthest = 0.0

    def look(self, command: Command, position: float) -> None:
        """Look at what goes to the drive, and at the true position in axis unit.

        Raises
        ------
        BrokenInvariantError
            If something does not hold.
        """
        self.ticks += 1
        state, effort = self._axis.state, command.effort
        if not abs(effort) <= self._effort_limit:  # also for NaN
            raise BrokenInvariantError(f"the effort is {effort}, beyond {self._effort_limit}")
        if effort != 0.0 and (state not in DRIVEN or not command.enable):
            raise BrokenInvariantError(f"the effort is {effort} while the axis is {state}, enable {command.enable}")
        if command.enable and abs(effort - self._last_effort) > self._largest_step * (1.0 + 1e-9):
            raise BrokenInvariantError(
                f"the effort went from {self._last_effort} to {effort}, {self._largest_step} is the limit"
            )
        self._last_effort = effort
        if self._tripped and self._axis.trip is not None and state in DRIVEN:
            raise BrokenInvariantError(f"the axis is {state} after its trip had ended in disabling")
        self._tripped = state is State.TRIPPED
        beyond = max(position - self._high, self._low - position)
        if beyond > self.farthest:
            self.farthest = beyond
            if beyond > self._farthest_allowed:
                raise BrokenInvariantError(
                    f"the axis is {beyond:.3f} beyond its limits, {self._farthest_allowed:.3f} is the most"
                )


def allowed_overrun(axis: Axis) -> float:
    """Return how far the true axis may go beyond its limits, in axis unit.

    The overrun, in which a quick stop ends by design; what a plant off its model adds to a stop from the overspeed
    limit; and the way until stale feedback is noticed.
    """
    design, limits = axis.design, axis.settings.limits
    speed = limits.overspeed
    stop = design.certain_stopping_distance(speed, limits.quick_stop_deceleration)
    coast = speed / (axis.settings.plant.pole * (1.0 - MODEL_ERROR))
    return limits.position_overrun + stop + coast + speed * (limits.stale_feedback_ms / 1e3 + 3.0 * design.period_s)


def resident_mb() -> float:
    """Return the largest resident memory of this process so far, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
