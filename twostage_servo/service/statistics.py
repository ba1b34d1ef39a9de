"""Tick statistics in constant memory."""

import math

_BINS_PER_DECADE = 40
_LOWEST_US = 0.1
_DECADES = 8


class LatenessHistogram:
    """Histogram of lateness with logarithmic bins from 0.1 µs to 10 s: 40 a decade, so a percentile is within 6 %."""

    __slots__ = ("_bins", "count", "largest_us")

    def __init__(self) -> None:
        self._bins = [0] * (_BINS_PER_DECADE * _DECADES + 1)
        self.count = 0
        self.largest_us = 0.0

    def add(self, lateness_s: float) -> None:
        """Count one lateness in s, not negative."""
        lateness_us = 1e6 * lateness_s
        self.count += 1
        self.largest_us = max(self.largest_us, lateness_us)
        if lateness_us <= _LOWEST_US:
            self._bins[0] += 1
        else:
            bin_index = math.ceil(_BINS_PER_DECADE * math.log10(lateness_us / _LOWEST_US))
            self._bins[min(bin_index, len(self._bins) - 1)] += 1

    def percentile_us(self, percent: float) -> float:
        """Return the upper edge in µs of the bin that holds the percentile; 0 if nothing was counted or was late."""
        needed = percent / 100.0 * self.count
        seen = 0
        for index, count in enumerate(self._bins):
            seen += count
            if count and seen >= needed:
                return min(self.largest_us, _LOWEST_US * 10.0 ** (index / _BINS_PER_DECADE)) if index else 0.0
        return 0.0

    def summary(self) -> dict[str, float]:
        """Return p50, p99 and max, in µs."""
        return {
            "p50": round(self.percentile_us(50.0), 1),
            "p99": round(self.percentile_us(99.0), 1),
            "max": round(self.largest_us, 1),
        }
