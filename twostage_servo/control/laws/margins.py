"""Poles and stability margins of a sampled loop: a plant, and a controller from its position to its effort.

The loop is broken at the effort. The controller is ``z(k+1) = A_c z(k) + B_c y(k)`` and ``u(k) = C_c z(k)``; the plant
closes it.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from twostage_servo.control.laws.law import Controller, Loop
from twostage_servo.control.plant import DiscretePlant

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Matrix = NDArray[np.float64]

FREQUENCIES = 20_000
"""Points at which a frequency response is looked at."""

LEAST_MODULUS_MARGIN = 0.4
"""Smallest distance of a loop from -1 that is taken: a sensitivity peak of 2.5. Up to 2 is usual (K. J. Astrom, R. M.
Murray, *Feedback Systems*, section 12.3); the paper's second example has 1.8."""

_REST_SHARE = 0.01
"""What is left of an error when it counts as gone."""

_LEAST_RADIUS = 1e-9
"""Magnitude that a slowest pole is taken to have at least: one of 0 has no logarithm."""


@dataclass(frozen=True, slots=True)
class Margins:
    """Margins of one stage's loop.

    Attributes
    ----------
    gain_margin
        Factor by which the loop gain may grow before it becomes unstable; infinity if none does.
    gain_reduction_margin
        Factor (below 1) down to which the loop gain may fall before it becomes unstable; 0 if none does.
    phase_margin_deg
        Smallest phase in degrees that makes the loop unstable; infinity where the gain never passes 1.
    delay_margin_s
        Additional delay in s that makes the loop unstable; infinity where the gain never passes 1.
    modulus_margin
        Smallest distance of the loop's frequency response from -1, at most 1 for most loops.
    spectral_radius
        Largest magnitude of the closed loop's poles, apart from the position in the speed stage, which is not fed back.
    """

    gain_margin: float
    gain_reduction_margin: float
    phase_margin_deg: float
    delay_margin_s: float
    modulus_margin: float
    spectral_radius: float

    @property
    def stable(self) -> bool:
        """Whether every closed-loop pole lies inside the unit circle."""
        return self.spectral_radius < 1.0


class Control(NamedTuple):
    """A stage's controller for a set-point of zero.

    Attributes
    ----------
    a, b, c
        A_c, B_c and C_c.
    feeds_position
        Whether the position is fed back. Where it is not, one pole at exactly 1 is left out: moving axis and estimate
        together changes nothing.
    """

    a: "Matrix"
    b: "Matrix"
    c: "Matrix"
    feeds_position: bool

    def in_numbers(self, set_point: tuple[float, ...] = (), follows: str = "") -> Controller:
        """Return it in plain numbers, with the column by which a set-point enters, and what follows that."""
        a, b, c = (tuple(tuple(map(float, row)) for row in matrix) for matrix in (self.a, self.b, self.c))
        return Controller(a, b, c, tuple((entry,) for entry in set_point), follows)


def poles_of(control: Control, plant: DiscretePlant) -> list[complex]:
    """Return the poles of the closed loop."""
    import numpy as np  # noqa: PLC0415 - see servo_gains

    a_p, b_p, c_p = _plant_matrices(plant)
    poles = np.linalg.eigvals(np.block([[a_p, b_p @ control.c], [control.b @ c_p, control.a]]))
    if not control.feeds_position:
        poles = np.delete(poles, np.argmin(np.abs(poles - 1.0)))
    return [complex(pole) for pole in poles]


def settling_time_s(radius: float, period_s: float) -> float:
    """Return how long the slowest pole, of a magnitude `radius` below 1, takes to die down to a hundredth, in s.

    Parameters
    ----------
    radius
        Of the pole in z.
    period_s
        The tick, in s.
    """
    return period_s * math.log(_REST_SHARE) / math.log(max(radius, _LEAST_RADIUS))


def margins_of(control: Control, plant: DiscretePlant, frequencies: int = FREQUENCIES) -> Margins:
    """Compute poles and margins of a stage's loop.

    Parameters
    ----------
    control
        The stage.
    plant
        What closes the loop.
    frequencies
        Points at which the frequency response is looked at; a tenth of the default is within 1 %.
    """
    import numpy as np  # noqa: PLC0415 - see servo_gains

    a_p, b_p, c_p = _plant_matrices(plant)
    angles = np.geomspace(1e-5, np.pi, frequencies)
    response = -_frequency_response(a_p, b_p, c_p, angles)
    response = response * _frequency_response(control.a, control.b, control.c, angles)
    magnitude, phase = np.abs(response), np.unwrap(np.angle(response))
    upper, lower = _gain_margins(magnitude, phase)
    phase_margin, delay = _phase_margins(magnitude, phase, angles)
    return Margins(
        gain_margin=upper,
        gain_reduction_margin=lower,
        phase_margin_deg=float(np.degrees(phase_margin)),
        delay_margin_s=float(delay * plant.period_s),
        modulus_margin=float(np.min(np.abs(1.0 + response))),
        spectral_radius=max(abs(pole) for pole in poles_of(control, plant)),
    )


def loop_of(control: Control, plant: DiscretePlant, controller: Controller) -> Loop:
    """Return how stable a stage's loop is, with the controller as it is to be shown."""
    margins = margins_of(control, plant)
    return Loop(
        margins.gain_margin,
        margins.gain_reduction_margin,
        margins.phase_margin_deg,
        margins.delay_margin_s,
        margins.modulus_margin,
        tuple(sorted(poles_of(control, plant), key=abs, reverse=True)),
        controller,
    )


def _plant_matrices(plant: DiscretePlant) -> "tuple[Matrix, Matrix, Matrix]":
    import numpy as np  # noqa: PLC0415 - see servo_gains

    a_p = np.array([[1.0, plant.a12], [0.0, plant.a22]])
    return a_p, np.array([[plant.b1], [plant.b2]]), np.array([[1.0, 0.0]])


def _frequency_response(a: "Matrix", b: "Matrix", c: "Matrix", angles: "Matrix") -> "NDArray[np.complex128]":
    import numpy as np  # noqa: PLC0415 - see servo_gains

    points = np.exp(1j * angles)[:, None, None]
    solved = np.linalg.solve(points * np.eye(len(a)) - a, np.broadcast_to(b, (len(angles), *b.shape)))
    return np.asarray((c @ solved)[:, 0, 0])


def _gain_margins(magnitude: "Matrix", phase: "Matrix") -> tuple[float, float]:
    import numpy as np  # noqa: PLC0415 - see servo_gains

    turns = (phase - np.pi) / (2.0 * np.pi)  # a whole number where the response is real and negative
    crossings = np.nonzero(np.floor(turns[:-1]) != np.floor(turns[1:]))[0]
    factors = []
    for index in crossings:
        level = max(np.floor(turns[index]), np.floor(turns[index + 1]))
        share = (level - turns[index]) / (turns[index + 1] - turns[index])
        factors.append(1.0 / float(magnitude[index] ** (1.0 - share) * magnitude[index + 1] ** share))
    return min((f for f in factors if f > 1.0), default=np.inf), max((f for f in factors if f < 1.0), default=0.0)


def _phase_margins(magnitude: "Matrix", phase: "Matrix", angles: "Matrix") -> tuple[float, float]:
    import numpy as np  # noqa: PLC0415 - see servo_gains

    logarithm = np.log(magnitude)
    crossings = np.nonzero(np.sign(logarithm[:-1]) != np.sign(logarithm[1:]))[0]
    margin, delay = np.inf, np.inf
    for index in crossings:
        share = -logarithm[index] / (logarithm[index + 1] - logarithm[index])
        angle = angles[index] + share * (angles[index + 1] - angles[index])
        at_crossing = phase[index] + share * (phase[index + 1] - phase[index])
        lag = (at_crossing - np.pi) % (2.0 * np.pi)  # how far the phase may fall before it meets -180 degrees
        margin = min(margin, lag, 2.0 * np.pi - lag)
        delay = min(delay, lag / angle)
    return float(margin), float(delay)
