"""The drive's encoder: offset, noise and steps between the true position and the measured one."""

from collections.abc import Callable
from math import isfinite
from random import Random

from twostage_servo.simulation.settings import SimulationSettings


class Encoder:
    """An incremental encoder: it counts from where it was switched on.

    At first its zero is that of the true position, so that an axis begins at its ``initial_position``.

    Parameters
    ----------
    settings : SimulationSettings
        Noise, resolution and seed.
    """

    def __init__(self, settings: SimulationSettings) -> None:
        self._noise_std = settings.noise_std
        self._quantum = settings.quantum
        self._noise = Random(settings.seed)  # noqa: S311 - measurement noise, not a secret
        self._zero = 0.0

    def restart(self, position: float) -> None:
        """Count from 0 at this true position, as after being switched off and on."""
        self._zero = position

    def sample(self, position: float, distort: Callable[[float], float] | None) -> float:
        """Measure a true position.

        Parameters
        ----------
        position : float
            True position, axis unit.
        distort : callable or None
            The encoder's fault, see :attr:`DriveFaults.measure`.

        Returns
        -------
        float
            Measured position, axis unit; not finite when the fault says so.
        """
        return self._count(position + self._noise.gauss(0.0, self._noise_std), distort)

    def latch(self, mark: float, distort: Callable[[float], float] | None) -> float:
        """Measure the position of an index mark: like :meth:`sample`, but without noise, as hardware latches it."""
        return self._count(mark, distort)

    def _count(self, position: float, distort: Callable[[float], float] | None) -> float:
        measured = position - self._zero
        if distort is not None:
            measured = distort(measured)
        if self._quantum and isfinite(steps := measured / self._quantum):
            measured = round(steps) * self._quantum
        return measured
