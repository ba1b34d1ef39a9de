"""The noise of an encoder, measured while its axis is at rest."""

from collections import deque
from math import sqrt
from typing import Final

_MEMORY: Final = 0.02
"""Share of a sample in the noise that is measured: some 50 samples."""

_RINGING: Final = 2.0
"""Ratio of what first and second differences at rest make the noise from which it is a motion: theirs is 1 of white
noise, 1.5 of an encoder that changes its step now and then, and 3.6 of a load that rings at 15 Hz on 10 ms."""

_FEWEST: Final = 20
"""Samples at rest before what they show is believed."""


class EncoderNoise:
    """Tells white noise by the second differences of an axis that holds.

    A load that rings moves it as well, and its motion goes on from sample to sample. It is not taken for noise: the
    poles for a noisy encoder would let it ring longer.

    Parameters
    ----------
    least
        Standard deviation as far as it is known beforehand, in axis unit.
    """

    __slots__ = ("_by_first", "_by_second", "_last", "_least", "_samples", "_square")

    def __init__(self, least: float) -> None:
        self._least = least
        self._square = 0.0  # as it is believed
        self._by_first = self._by_second = 0.0  # as the differences have it
        self._last: deque[float] = deque(maxlen=3)
        self._samples = 0

    @property
    def deviation(self) -> float:
        """Standard deviation of a sample, in axis unit: as known beforehand, or as measured where that is more."""
        return max(self._least, sqrt(self._square) if self._samples >= _FEWEST else 0.0)

    def clear(self) -> None:
        """Begin anew at another place: the differences between the two say nothing."""
        self._last.clear()

    def update(self, sample: float | None) -> None:
        """Take a sample (axis unit) of an axis that holds; None where it is lost."""
        last = self._last
        if sample is None:
            last.clear()
            return
        last.append(sample)
        if len(last) < 3:
            return
        first, second = last[2] - last[1], last[2] - 2.0 * last[1] + last[0]
        self._by_first += _MEMORY * (first * first / 2.0 - self._by_first)
        self._by_second += _MEMORY * (second * second / 6.0 - self._by_second)
        if self._by_first <= _RINGING * self._by_second:
            self._square = self._by_second
        self._samples += 1
