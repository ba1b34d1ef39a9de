"""How far the estimate may have gone wrong while there were no samples: what the innovation gate allows after a gap."""

import math

from twostage_servo.axis.design import AxisDesign
from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.plant import MODEL_ERROR

_CLOSED_SHARE = 1e-3
"""Share of the innovation gate at standstill, below which an error that is left over from a gap counts as none."""


class SampleGap:
    """Follows the largest error of the estimate that a gap in the samples may cause.

    The error obeys the observer's own dynamics. A tick without a sample adds to it what a plant that is off its model
    does otherwise, and a sample takes away from it what it takes away from any error of the estimate. So the gate
    narrows again as fast as the observer settles. Without a gap the allowance is 0.

    Parameters
    ----------
    design
        The axis.

    Attributes
    ----------
    allowance
        How much farther than the innovation gate a sample may lie from its prediction now, in axis unit.
    """

    __slots__ = ("_a12", "_error", "_gain", "_gain1", "_hidden_velocity", "_least", "_open", "_pole", "allowance")

    def __init__(self, design: AxisDesign) -> None:
        predictor = design.kalman.predictor
        self._error = DisturbanceObserver(design.plant, predictor, design.noise.disturbance_memory)
        self._a12 = design.plant.a12
        self._gain1 = predictor[0]
        self._gain = design.settings.plant.gain
        self._pole = design.settings.plant.pole
        self._least = _CLOSED_SHARE * design.settings.limits.innovation_gate
        self._hidden_velocity = 0.0  # by how much the estimate may have been off before the gap, in axis unit/s
        self.close()

    @property
    def surprise(self) -> float:
        """By how much the next sample may still surprise because of the gap, in axis unit."""
        return max(self.allowance, abs(self._error.velocity) * self._a12) if self._open else 0.0

    def close(self) -> None:
        """Forget the gap: the estimate begins afresh."""
        self._open = False
        self.allowance = 0.0

    def miss(self, observer: DisturbanceObserver, effort: float) -> None:
        """Account for a tick without a sample, before the observer predicts it.

        Parameters
        ----------
        observer
            The estimate before that tick; its innovation is that of the last sample, or 0 within the gap.
        effort
            What acts in that tick, in effort unit.
        """
        error = self._error
        if not self._open:
            # A steady innovation hides a wrong velocity: each sample makes up for what that misses in a tick.
            self._begin(abs(self._gain1 * observer.innovation) / self._a12)
        driven = abs(effort + observer.disturbance)
        braked = abs(observer.velocity * self._pole / self._gain)
        error.predict(math.copysign(MODEL_ERROR * (driven + braked), self._gain))
        self.allowance = abs(error.position)

    def reopen(self, periods: int, observer: DisturbanceObserver, effort: float) -> None:
        """Account for a sample that is some periods old: what went wrong before it is known, what did since is not."""
        self._begin(self._hidden_velocity)
        for _ in range(periods):
            self.miss(observer, effort)

    def doubt(self) -> None:
        """Account for a sample that was not believed: the error goes on, and nothing is added to it."""
        if self._open:
            self._error.predict(0.0)
            self.allowance = abs(self._error.position)

    def accept(self) -> None:
        """Account for a sample that the observer has taken."""
        if not self._open:
            return
        error = self._error
        error.update(0.0, 0.0)
        self.allowance = abs(error.position)
        if self.surprise <= self._least:
            self.close()

    def _begin(self, hidden_velocity: float) -> None:
        self._hidden_velocity = hidden_velocity
        self._error.reset(0.0)
        self._error.correct(hidden_velocity, 0.0)
        self._open = True
