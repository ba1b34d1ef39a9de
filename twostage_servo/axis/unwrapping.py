"""From what the encoder counts to a position: the wraps are counted, from the axis' own origin."""

import math
from dataclasses import dataclass

from twostage_servo.axis.settings import LimitSettings


@dataclass(slots=True)
class Unwrapped:
    """What is known of the encoder's revolution.

    Attributes
    ----------
    near
        Where the axis is taken to be, in axis unit, to choose among the encoder's revolutions; None before it was seen.
    origin
        Position where the encoder counts 0, in axis unit.
    ticks_unseen
        Ticks since the axis was last seen.
    """

    near: float | None = None
    origin: float = 0.0
    ticks_unseen: int = 0


class Unwrapping:
    """Counts the wraps of an encoder.

    Parameters
    ----------
    limits
        Of the axis.
    period_s
        Length of a tick in s.
    position_period
        Width in axis unit of the range in which the encoder counts before it wraps; 0 if it does not.

    Attributes
    ----------
    state
        What is known of the revolution.
    """

    __slots__ = ("_period", "_period_ms", "_unseen_limit_s", "state")

    def __init__(self, limits: LimitSettings, period_s: float, position_period: float) -> None:
        self.state = Unwrapped()
        self._period = position_period
        self._period_ms = 1e3 * period_s
        travel = limits.position_maximum - limits.position_minimum + 2.0 * limits.position_overrun
        # Where the axis can't be half a revolution from where it was last seen, the nearest is always the right one.
        one_only = position_period == 0.0 or travel < 0.5 * position_period
        self._unseen_limit_s = math.inf if one_only else 0.5 * position_period / limits.overspeed

    def begin_tick(self, missed: int, expected: float | None) -> None:
        """Open a tick, before which so many were missed; `expected` is where the axis is taken to be, if anywhere."""
        if expected is not None:
            self.state.near = expected
        self.state.ticks_unseen += 1 + missed

    def unwrap(self, counted: float) -> tuple[float, bool]:
        """Unwrap what the encoder counts in a fresh sample, in axis unit.

        Returns
        -------
        tuple
            The position in axis unit; and whether it is sure: not where the axis has not been seen for so long that it
            may have gone half a revolution, so that nobody knows which one this is.
        """
        state = self.state
        sure = state.near is None or 1e-3 * self._period_ms * state.ticks_unseen < self._unseen_limit_s
        state.ticks_unseen = 0
        position = self.position(counted)
        if state.near is None:
            state.near = position
        return position, sure

    def position(self, counted: float) -> float:
        """Return the position for what the encoder counts: of all its revolutions the one nearest to the estimate."""
        position, period, near = counted + self.state.origin, self._period, self.state.near
        if period and near is not None:
            position += period * round((near - position) / period)
        return position

    def step(self, before: float, now: float) -> float:
        """Return how far it is from one position to the next that was seen, in axis unit: at most half a revolution."""
        distance, period = now - before, self._period
        return distance - period * round(distance / period) if period else distance

    def continue_from(self, former: "Unwrapping") -> None:
        """Know what a former one of the same drive knew."""
        self.state = former.state

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self.state.origin += distance
        if self.state.near is not None:
            self.state.near += distance
