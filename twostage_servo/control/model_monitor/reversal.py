"""The signs that are wrong, compared over a short window: what an axis that runs away shows before it is far.

Where nothing jumps, as near standstill, a reversed encoder is told by the answer to the effort alone. In the window of
:mod:`twostage_servo.control.model_monitor.hypotheses` that takes long: what a reversed sign did not explain before the
reversal fades with its time constant of 138 ms, while the axis runs away ever faster. In a short window it has faded
when the axis has gone a few millimetres. A load surprises all plants for as long as that, so it takes more there.
"""

from collections.abc import Sequence
from typing import Final

from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.per_time import kept_in

_FORGETTING: Final = 0.8
"""Weight of the short window for each nominal tick of age: a time constant of 45 ms."""

REVERSED_EVIDENCE: Final = 20.0
REVERSED_SURPRISE: Final = 4.0
"""How many times smaller the sum of squares of a reversed sign has to be than that of the best accepted plant, and the
surprise that it takes, as a multiple of the one below which nothing is decided."""

LARGE_EVIDENCE: Final = 8.0
LARGE_SURPRISE: Final = 16.0
"""The same where the surprise is as large as that, with the evidence of the wider window: on 500 healthy axes under
loads of up to four times the stall effort it decided nothing that the first pair had not."""


class ReversalWatch:
    """Compares reversed signs with the accepted plants over a short window; give it each sample once.

    Parameters
    ----------
    reversed_signs
        The observers of reversed signs, which have taken each sample already.
    period_s
        The tick, in s.
    """

    __slots__ = ("_accepted_sum", "_forgetting", "_observers", "_still_sum", "_sums")

    def __init__(self, reversed_signs: Sequence[DisturbanceObserver], period_s: float) -> None:
        self._observers = list(reversed_signs)
        self._forgetting = kept_in(_FORGETTING, period_s)
        self._sums = [0.0] * len(self._observers)
        self._accepted_sum = self._still_sum = 0.0

    def start(self, square: float) -> None:
        """Begin afresh, as if every sample so far had surprised by `square`, in (axis unit)²."""
        self._accepted_sum = square / (1.0 - self._forgetting)
        self._sums = [self._accepted_sum] * len(self._observers)
        self._still_sum = 0.0

    def update(self, least_square: float, still_square: float) -> None:
        """Account for a sample.

        Parameters
        ----------
        least_square
            The smallest squared innovation of the accepted plants, in (axis unit)².
        still_square
            What the sample surprises an encoder by that stands still, in (axis unit)².
        """
        kept, sums = self._forgetting, self._sums
        for index, observer in enumerate(self._observers):
            sums[index] = kept * sums[index] + observer.innovation * observer.innovation
        self._accepted_sum = kept * self._accepted_sum + least_square
        self._still_sum = kept * self._still_sum + still_square

    def is_certain(self, least: float, still_evidence: float) -> bool:
        """Whether a reversed sign explains what neither an accepted plant nor an encoder that stands still does.

        Parameters
        ----------
        least
            The surprise below which nothing is decided, in axis unit.
        still_evidence
            How many times better than the latter it has to be.
        """
        own, accepted = min(self._sums), self._accepted_sum
        surprise = accepted**0.5 / least
        needed = LARGE_EVIDENCE if surprise > LARGE_SURPRISE else REVERSED_EVIDENCE
        return surprise > REVERSED_SURPRISE and accepted > needed * own and self._still_sum > still_evidence * own

    @property
    def likeliest(self) -> int:
        """Which of the reversed signs explains the latest samples best, by its index."""
        return self._sums.index(min(self._sums))
