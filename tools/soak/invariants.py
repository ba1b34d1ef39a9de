"""What must hold at every tick of a soak, whatever was asked and whatever failed."""

import resource

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.messages import Command
from twostage_servo.axis.state import DRIVEN, LATCHED, State
from twostage_servo.control.plant import MODEL_ERROR


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
        Largest distance beyond a position limit so far, as a share of what is allowed.
    """

    __slots__ = (
        "_axis", "_effort_limit", "_farthest_allowed", "_fastest", "_high", "_largest_step", "_last_effort", "_low",
        "_position", "_tripped", "_unseen_s", "farthest", "ticks",
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
        self._fastest = 0.0
        self._position: float | None = None
        self._unseen_s = limits.stale_feedback_ms / 1e3 + (limits.missed_ticks + 3) * axis.design.period_s
        self.ticks = 0
        self.farthest = 0.0

    def check(self, command: Command, position: float, *, place_known: bool = True) -> None:
        """Look at what goes to the drive, and at the true position in axis unit.

        Parameters
        ----------
        command
            What goes to the drive.
        position
            The true position in axis unit.
        place_known
            Whether the axis can know its place; else its position limits say nothing.

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
        if not place_known:
            return
        self._check_belief(state, position)
        beyond = max(position - self._high, self._low - position)
        self.farthest = max(self.farthest, beyond / self._farthest_allowed)
        if beyond > self._farthest_allowed:
            raise BrokenInvariantError(
                f"the axis is {beyond:.4g} beyond its limits, {self._farthest_allowed:.4g} is the most"
            )

    def _check_belief(self, state: State, position: float) -> None:
        """Compare where an axis that moves as it was asked to takes itself to be with where it is.

        What it may be off: two innovation gates, for one that was passed and one that was bridged, and what it goes
        while feedback may be missing.
        """
        axis = self._axis
        speed = 0.0 if self._position is None else abs(position - self._position) / axis.design.period_s
        self._position = position
        self._fastest = max(0.999 * self._fastest, speed)
        if not axis.referenced or state not in DRIVEN or state in LATCHED:
            return
        estimate, limits = axis.estimate, axis.settings.limits
        gate = limits.innovation_gate + 1e-3 * limits.innovation_time_ms * self._fastest
        allowed = 2.0 * gate + self._fastest * self._unseen_s + axis.settings.window.position
        error = abs(estimate.position - position)
        if error > allowed:
            raise BrokenInvariantError(
                f"the axis is {state} and takes itself to be at {estimate.position:.6g}, and is at {position:.6g}: "
                f"{error:.4g} off, {allowed:.4g} is the most"
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
