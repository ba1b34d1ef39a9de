"""The loop that really runs, as python-control sees it: margins, frequency response, step response.

For the engineer's verbs and the paper's report. What the service needs of margins is in
:mod:`twostage_servo.control.laws.paper_margins`, which loads in a tenth of the time; a test holds the two equal. So
nothing that the service imports may import this module.
"""

from dataclasses import dataclass
from math import log
from typing import TYPE_CHECKING, Any, Final

import control
import numpy as np

from twostage_servo.control.laws.law import Controller
from twostage_servo.control.plant import DiscretePlant

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Matrix = NDArray[np.float64]

_FREQUENCIES: Final = 2000
"""Points from 1e-5 rad a sample to the Nyquist frequency; the margins between them are interpolated."""

_DIED_DOWN: Final = 1e-4
"""Share of itself to which the slowest part of an answer to a load step has died down when it is looked at no more."""

_FEWEST_TICKS: Final = 50
_MOST_TICKS: Final = 100_000
"""Ticks of such an answer that are looked at, at least and at most."""


@dataclass(frozen=True, slots=True)
class StabilityMargins:
    """Margins of a loop.

    Attributes
    ----------
    gain_margin, gain_reduction_margin
        Factors by which the loop gain may grow, and to which it may fall; infinity and 0 where nothing limits them.
    phase_margin_deg, delay_margin_s
        Phase in degrees, and delay in s, that would make the loop unstable; infinity where the gain never passes 1.
    modulus_margin
        Smallest distance of the loop's frequency response from -1.
    """

    gain_margin: float
    gain_reduction_margin: float
    phase_margin_deg: float
    delay_margin_s: float
    modulus_margin: float


class LoopAnalysis:
    """A law's stage and the plant that closes its loop.

    Parameters
    ----------
    plant
        The sampled plant.
    law
        The stage of the law.

    Attributes
    ----------
    law : Controller
        As given.
    """

    def __init__(self, plant: DiscretePlant, law: Controller) -> None:
        self.law = law
        self._period_s = plant.period_s
        self._plant = (np.array([[1.0, plant.a12], [0.0, plant.a22]]), np.array([[plant.b1], [plant.b2]]))
        self._output = np.array([[1.0, 0.0]])

    def open_loop(self) -> Any:
        """Return the loop broken at the effort, as a :class:`control.StateSpace` whose -1 is the critical point."""
        law = control.ss(self.law.a, self.law.b, self.law.c, 0.0, self._period_s)
        return -(control.ss(*self._plant, self._output, 0.0, self._period_s) * law)

    def response(self) -> "tuple[Matrix, NDArray[np.complex128]]":
        """Return angular frequencies in rad/s up to the Nyquist frequency, and the open loop's response at them."""
        angles = np.geomspace(1e-5, np.pi, _FREQUENCIES)
        return angles / self._period_s, np.asarray(self.open_loop()(np.exp(1j * angles)))

    def margins(self) -> StabilityMargins:
        """Return the margins.

        From the frequency response: python-control's own way for a sampled model, the roots of polynomials, takes the
        poles at 1 that cancel in the speed stage for crossings.
        """
        frequencies, response = self.response()
        model = control.frd(response, frequencies)
        gains, phases, moduli, _, crossovers, _ = control.stability_margins(model, returnall=True)
        delays = [np.radians(phase % 360.0) / at for phase, at in zip(phases, crossovers, strict=True)]
        return StabilityMargins(
            gain_margin=float(min((gain for gain in gains if gain > 1.0), default=np.inf)),
            gain_reduction_margin=float(max((gain for gain in gains if gain < 1.0), default=0.0)),
            phase_margin_deg=float(min(abs(phases), default=np.inf)),
            delay_margin_s=float(min(delays, default=np.inf)),
            # python-control finds what is smallest between the frequencies, and not at either end of them.
            modulus_margin=float(min((*moduli, np.min(np.abs(1.0 + response))))),
        )

    def load_step_peak(self) -> float:
        """Return the largest deviation at a sample after a load step of 1, in axis unit; infinity if unstable."""
        a_p, b_p = self._plant
        a_c, b_c, c_c = (np.array(matrix) for matrix in (self.law.a, self.law.b, self.law.c))
        closed = np.block([[a_p, b_p @ c_c], [b_c @ self._output, a_c]])
        slowest = float(np.max(np.abs(np.linalg.eigvals(closed))))
        if slowest >= 1.0:
            return float("inf")
        enters = np.vstack([-b_p, np.zeros((len(a_c), 1))])
        seen = np.zeros((1, len(closed)))
        seen[0, 0] = 1.0
        ticks = round(log(_DIED_DOWN) / log(max(slowest, _DIED_DOWN)))
        times = np.arange(min(max(ticks, _FEWEST_TICKS), _MOST_TICKS) + 1) * self._period_s
        answer = control.step_response(control.ss(closed, enters, seen, 0.0, self._period_s), times)
        return float(np.max(np.abs(answer.outputs)))

    def step_response(self, duration_s: float) -> "tuple[Matrix, Matrix]":
        """Return times in s, and how what follows the set-point answers a unit step of it, without any limit.

        Raises
        ------
        ValueError
            For a stage without a set-point, such as a stop.
        """
        if not self.law.follows:
            raise ValueError("this stage has no set-point to step")
        a_p, b_p = self._plant
        a_c, b_c, c_c = (np.array(matrix) for matrix in (self.law.a, self.law.b, self.law.c))
        closed = np.block([[a_p, b_p @ c_c], [b_c @ self._output, a_c]])
        enters = np.vstack([np.zeros((2, 1)), np.array(self.law.set_point)])
        seen = np.zeros((1, len(closed)))
        seen[0, 0 if self.law.follows == "position" else 1] = 1.0
        times = np.arange(round(duration_s / self._period_s) + 1, dtype=np.float64) * self._period_s
        answer = control.step_response(control.ss(closed, enters, seen, 0.0, self._period_s), times)
        return times, np.asarray(answer.outputs)
