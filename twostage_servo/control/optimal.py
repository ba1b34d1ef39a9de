"""Optimal servo gains by the discrete Riccati equation, and the change-over distance: equations (7)-(13) and (19)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from twostage_servo.control.plant import DiscretePlant, Triple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class ServoGains:
    """The gains of equation (13), acting as ``u = -f11 x1 - f12 x2 + f22 sum(e)`` (erratum 2).

    Attributes
    ----------
    f11
        Effort per position, effort unit/axis unit.
    f12
        Effort per velocity, effort unit s/axis unit.
    f22
        Effort per summed error: effort unit/axis unit in the position stage. In the speed stage the same number acts on
        the summed velocity error, effort unit s/axis unit (erratum 10).
    """

    f11: float
    f12: float
    f22: float

    def changeover_time_s(self, period_s: float) -> float:
        """Return ``f11 T_s / f22`` in s: the change-over distance per velocity, equation (19).

        At constant velocity v and at a distance of v times this time, the position stage asks for no change of effort:
        that is what makes the change-over continuous in its slope as well.
        """
        return self.f11 * period_s / self.f22


WEIGHTS: Final[Triple] = (1.0, 0.0, 1.0)
"""Diagonal of Q / q over ``[dx1, dx2, e]``: the reading that reproduces every printed digit of (36) (erratum 3)."""


def servo_gains(plant: DiscretePlant, ratio: float, weights: Triple = WEIGHTS) -> ServoGains:
    """Solve for the gains that minimise the sum of ``x_p' Q x_p + R du^2``, equation (11), read as in erratum 1.

    ``x_p = [dx1, dx2, e(k-1)]`` is incremental already, ``Q = q diag(weights)`` and R = 1.

    Parameters
    ----------
    plant
        The sampled plant.
    ratio
        Performance index ratio q/R, greater than 0: larger is quicker.
    weights
        Diagonal of Q / q, not negative, the last greater than 0.

    Raises
    ------
    ValueError
        If the ratio is out of range, or the Riccati equation has no stabilising solution in double precision.
    """
    if not ratio > 0.0:
        raise ValueError(f"the performance index ratio Q/R is {ratio!r}: a number greater than 0 is needed")
    import numpy as np  # noqa: PLC0415 - numpy and scipy cost the command line half a second, here alone they are needed
    from scipy.linalg import solve_discrete_are  # noqa: PLC0415

    state, effort = incremental_model(plant)
    try:
        cost = solve_discrete_are(state, effort, ratio * np.diag(weights), np.eye(1))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(
            f"no optimal gains exist in double precision for the performance index ratio {ratio:g} and this plant "
            f"(b2 = {plant.b2:g}): {error}"
        ) from error
    feedback = (effort.T @ cost @ state) / (1.0 + effort.T @ cost @ effort)
    return ServoGains(f11=float(feedback[0, 0]), f12=float(feedback[0, 1]), f22=-float(feedback[0, 2]))


def incremental_model(plant: DiscretePlant) -> "tuple[NDArray[np.float64], NDArray[np.float64]]":
    """Return A_p (3x3) and B_p (3x1) of equation (10), for the state ``[dx1, dx2, e(k-1)]``."""
    import numpy as np  # noqa: PLC0415

    state = np.array([[1.0, plant.a12, 0.0], [0.0, plant.a22, 0.0], [-1.0, 0.0, 1.0]])
    effort = np.array([[plant.b1], [plant.b2], [0.0]])
    return state, effort
