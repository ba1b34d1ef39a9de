"""The second-order plant of equation (35), and its zero-order-hold discretisation."""

import math
from dataclasses import dataclass

Triple = tuple[float, float, float]
"""Three numbers, one per state."""


MODEL_ERROR = 0.3
"""Share by which the true plant may differ from its model: what an axis has to be good for."""


@dataclass(frozen=True, slots=True)
class Plant:
    """A velocity lag and an integrator, ``G(s) = gain / (s (s + pole))``, from effort to position.

    Parameters
    ----------
    gain
        Acceleration per effort at standstill, in axis unit/s² per effort unit; not zero, and negative for a drive that
        is mounted the other way round.
    pole
        Reciprocal of the velocity's time constant, in 1/s, greater than 0.

    Raises
    ------
    ValueError
        If a parameter is outside these ranges or not finite.
    """

    gain: float
    pole: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.gain) or self.gain == 0.0:
            raise ValueError(f"the plant's gain is {self.gain!r}: a finite number other than 0 is needed")
        if not (math.isfinite(self.pole) and self.pole > 0.0):
            raise ValueError(f"the plant's pole is {self.pole!r}: a finite number greater than 0 is needed, in 1/s")

    def discretise(self, period_s: float) -> "DiscretePlant":
        """Return the exact model for an effort that is constant over each period (zero-order hold).

        With x = [position, velocity]: ``x(k+1) = [[1, a12], [0, a22]] x(k) + [b1, b2] u(k)``, equation (1).

        Parameters
        ----------
        period_s
            Sampling period T_s in s, greater than 0.

        Raises
        ------
        ValueError
            If the period is not a finite number greater than 0.
        """
        if not (math.isfinite(period_s) and period_s > 0.0):
            raise ValueError(f"the sampling period is {period_s!r}: a finite number greater than 0 is needed, in s")
        decay = -math.expm1(-self.pole * period_s)  # 1 - exp(-pole T_s), without cancellation
        a12 = decay / self.pole
        return DiscretePlant(
            period_s=period_s,
            a12=a12,
            a22=1.0 - decay,
            b1=self.gain / self.pole * (period_s - a12),
            b2=self.gain * a12,
        )

    def cruise_effort(self, velocity: float) -> float:
        """Return the effort that holds a constant velocity (axis unit/s) when there is no disturbance."""
        return velocity * self.pole / self.gain


@dataclass(frozen=True, slots=True)
class DiscretePlant:
    """The entries of A (2x2) and B (2x1) of equation (1) that are not 0 or 1, for a sampling period in s."""

    period_s: float
    a12: float
    a22: float
    b1: float
    b2: float
