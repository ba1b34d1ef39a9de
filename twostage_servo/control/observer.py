"""The Kalman disturbance observer: equations (20)-(28)."""

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from twostage_servo.control.plant import DiscretePlant, Triple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """What the Kalman filter assumes of its disturbance and its noise.

    Attributes
    ----------
    process_variance
        Diagonal of ``G W G'`` of equation (28) for [position, velocity, disturbance], in (axis unit)², (axis unit/s)²
        and (effort unit)²; equation (37) gives 0.1 for each (erratum 8).
    measurement_variance
        R_o of equation (27), in (axis unit)².
    disturbance_memory
        Lower right entry of A_o: 1 for a disturbance that persists (a random walk), 0 as printed in (25) (erratum 5).
    """

    process_variance: Triple = (0.1, 0.1, 0.1)
    measurement_variance: float = 0.01
    disturbance_memory: float = 1.0


@dataclass(frozen=True, slots=True)
class KalmanGain:
    """The steady-state gain: ``current`` is K of equation (27), ``predictor`` is A_o K (erratum 6); each 3 numbers."""

    current: Triple
    predictor: Triple


def extended_model(
    plant: DiscretePlant, disturbance_memory: float
) -> "tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]":
    """Return A_o (3x3), B_o (3x1) and C_o (1x3) of equation (25), with G_o = B as in equation (37)."""
    import numpy as np  # noqa: PLC0415 - see servo_gains

    state = np.array([[1.0, plant.a12, plant.b1], [0.0, plant.a22, plant.b2], [0.0, 0.0, disturbance_memory]])
    effort = np.array([[plant.b1], [plant.b2], [0.0]])
    output = np.array([[1.0, 0.0, 0.0]])
    return state, effort, output


@functools.lru_cache(maxsize=512)
def kalman_gain(plant: DiscretePlant, noise: NoiseModel) -> KalmanGain:
    """Solve the filter's Riccati equation (28), with the ``- X`` that the print lacks (erratum 7).

    Raises
    ------
    ValueError
        If the Riccati equation has no solution in double precision for which the estimate converges.
    """
    import numpy as np  # noqa: PLC0415 - see servo_gains
    from scipy.linalg import solve_discrete_are  # noqa: PLC0415

    state, _, output = extended_model(plant, noise.disturbance_memory)
    measurement = np.array([[noise.measurement_variance]])
    try:
        covariance = solve_discrete_are(state.T, output.T, np.diag(noise.process_variance), measurement)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(
            f"no Kalman gain exists in double precision for the process variances {noise.process_variance} and the "
            f"measurement variance {noise.measurement_variance:g}: {error}"
        ) from error
    current = covariance @ output.T / (output @ covariance @ output.T + measurement)
    predictor = state @ current
    slowest = np.max(np.abs(np.linalg.eigvals(state - predictor @ output)))
    if not slowest < 1.0 - 1e-9:
        raise ValueError(
            f"the process variances {noise.process_variance} leave an estimate that never converges (its slowest "
            f"pole has the magnitude {slowest:.9f}); give the disturbance a larger variance"
        )
    return KalmanGain(
        current=(float(current[0, 0]), float(current[1, 0]), float(current[2, 0])),
        predictor=(float(predictor[0, 0]), float(predictor[1, 0]), float(predictor[2, 0])),
    )


NO_CORRECTION: Final[Triple] = (0.0, 0.0, 0.0)


class DisturbanceObserver:
    """Estimates position, velocity and disturbance from sampled position: the predictor form of equation (26).

    Each call of :meth:`update` takes the sample that belongs to the effort's own instant, ``y(k-1)`` and ``u(k-1)``,
    and leaves the estimate for one period later, ``x_o(k)``. A drive that samples when it takes a command, and whose
    answer is read at the next tick, is met exactly: one period of transport is in the design (erratum 6).

    Parameters
    ----------
    plant
        The sampled plant model.
    gain
        A_o K, 3 numbers; :data:`NO_CORRECTION` makes the observer a free-running model of the plant.
    disturbance_memory
        As in :class:`NoiseModel`.

    Attributes
    ----------
    plant
        The plant model, as given.
    position, velocity, disturbance
        The estimate, in axis unit, axis unit/s and effort unit.
    innovation
        The last sample minus its prediction, in axis unit.
    """

    __slots__ = (
        "_a12", "_a22", "_b1", "_b2", "_gain1", "_gain2", "_gain3", "_memory",
        "disturbance", "innovation", "plant", "position", "velocity",
    )  # fmt: skip

    def __init__(self, plant: DiscretePlant, gain: Triple, disturbance_memory: float = 1.0) -> None:
        self.plant = plant
        self._a12, self._a22, self._b1, self._b2 = plant.a12, plant.a22, plant.b1, plant.b2
        self._gain1, self._gain2, self._gain3 = gain
        self._memory = disturbance_memory
        self.reset(0.0)

    @property
    def gain(self) -> Triple:
        """The predictor gain."""
        return self._gain1, self._gain2, self._gain3

    def reset(self, position: float) -> None:
        """Start afresh at a measured position (axis unit), at rest and undisturbed."""
        self.position = position
        self.velocity = 0.0
        self.disturbance = 0.0
        self.innovation = 0.0

    def start_moving(self, before: float, sample: float, periods: int) -> None:
        """Start afresh from two samples (axis unit) some periods apart, undisturbed and without effort, at their speed.

        In n periods the plant goes ``a12 v0 (1 + a22 + ... + a22^(n-1))`` and keeps ``a22^n v0``; from there the model
        gives position and velocity a period after the second sample.
        """
        kept = self._a22**periods
        velocity = kept * (sample - before) * (1.0 - self._a22) / (self._a12 * (1.0 - kept))
        self.reset(sample + self._a12 * velocity)
        self.velocity = self._a22 * velocity

    def update(self, sample: float, effort: float) -> None:
        """Advance the estimate to tick k with ``y(k-1)`` in axis unit and ``u(k-1)`` in effort unit."""
        position, velocity, disturbance = self.position, self.velocity, self.disturbance
        innovation = sample - position
        total = effort + disturbance
        self.position = position + self._a12 * velocity + self._b1 * total + self._gain1 * innovation
        self.velocity = self._a22 * velocity + self._b2 * total + self._gain2 * innovation
        self.disturbance = self._memory * disturbance + self._gain3 * innovation
        self.innovation = innovation

    def predict(self, effort: float) -> None:
        """Advance one period without a sample: ``x_o(k) = A_o x_o(k-1) + B_o u(k-1)``."""
        self.update(self.position, effort)

    def correct(self, velocity: float, disturbance: float) -> None:
        """Go on from another velocity and disturbance, in axis unit/s and effort unit, at the same position."""
        self.velocity, self.disturbance = velocity, disturbance

    def go_on_from(self, position: float, velocity: float, disturbance: float) -> None:
        """Go on from another estimate: axis unit, axis unit/s and effort unit."""
        self.position, self.velocity, self.disturbance = position, velocity, disturbance

    def place(self, position: float) -> None:
        """Go on from another position, in axis unit, at the same velocity and disturbance."""
        self.position = position

    def adopt(self, plant: DiscretePlant, gain: Triple) -> None:
        """Go on with another model of the plant and another gain, from the same estimate."""
        self.plant = plant
        self._a12, self._a22, self._b1, self._b2 = plant.a12, plant.a22, plant.b1, plant.b2
        self._gain1, self._gain2, self._gain3 = gain

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self.position += distance

    def continue_from(self, other: "DisturbanceObserver") -> None:
        """Copy another observer's estimate."""
        self.position, self.velocity, self.disturbance = other.position, other.velocity, other.disturbance
        self.innovation = 0.0
