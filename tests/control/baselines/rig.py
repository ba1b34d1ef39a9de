"""A plant of the tests' own, which every law is driven on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from twostage_servo.control.baselines.compared_law import ComparedLaw
from twostage_servo.control.optimal import servo_gains
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01
MODEL = Plant(180.0, 14.0)
SAMPLED = MODEL.discretise(PERIOD_S)
SLOW, QUICK = servo_gains(SAMPLED, 5e-5), servo_gains(SAMPLED, 5e-3)


@dataclass
class Axis:
    """A plant of the tests' own, sampled by the matrix exponential; a load opposes the effort.

    All baselines are driven with it.
    """

    plant: Plant = MODEL
    load: float = 0.0
    position: float = 0.0
    velocity: float = 0.0
    sample: float = 0.0

    def __post_init__(self) -> None:
        continuous = np.array([[0.0, 1.0, 0.0], [0.0, -self.plant.pole, self.plant.gain], [0.0, 0.0, 0.0]])
        (_, self._a12, self._b1), (_, self._a22, self._b2), _ = expm(continuous * PERIOD_S).tolist()

    def drive(self, law: ComparedLaw, ticks: int, noise: Sequence[float] | None = None) -> NDArray[np.float64]:
        """Close the loop; return position and velocity before each effort, and that effort, in three rows."""
        rows = []
        for k in range(ticks):
            before, self.sample = self.sample, self.position + (noise[k] if noise is not None else 0.0)
            effort = law.step(before if law.sample_age else self.sample)
            rows.append((self.position, self.velocity, effort))
            total = effort - self.load
            self.position += self._a12 * self.velocity + self._b1 * total
            self.velocity = self._a22 * self.velocity + self._b2 * total
        return np.array(rows).T
