"""Histogram of times in constant memory."""

import itertools
import math
from bisect import bisect_left

_BINS_PER_DECADE = 40
_LOWEST_US = 0.1
_DECADES = 8
_MERGED = 4
"""Bins that are shown as one."""
_COARSE_EDGES = range(_MERGED, _BINS_PER_DECADE * _DECADES + 1, _MERGED)
_EDGES_US = {index: float(f"{_LOWEST_US * 10.0 ** (index / _BINS_PER_DECADE):.3g}") for index in (0, *_COARSE_EDGES)}

_UPPER_EDGES_US = [_LOWEST_US * 10.0 ** (index / _BINS_PER_DECADE) for index in range(_BINS_PER_DECADE * _DECADES + 1)]


class TimeHistogram:
    """Histogram of times with logarithmic bins from 0.1 µs to 10 s: 40 a decade, so a percentile is within 6 %."""

    __slots__ = ("_bins", "count", "largest_us")

    def __init__(self) -> None:
        self._bins = [0] * (_BINS_PER_DECADE * _DECADES + 1)
        self.count = 0
        self.largest_us = 0.0

    def add(self, time_s: float) -> None:
        """Count one time in s; a negative one counts as 0."""
        time_us = 1e6 * time_s
        self.count += 1
        if time_us <= _LOWEST_US:
            self._bins[0] += 1
            return
        self.largest_us = max(self.largest_us, time_us)
        bin_index = math.ceil(_BINS_PER_DECADE * math.log10(time_us / _LOWEST_US))
        self._bins[min(bin_index, len(self._bins) - 1)] += 1

    @property
    def _used(self) -> int:
        """The number of bins up to that of the longest time; those above are empty."""
        if self.largest_us <= _LOWEST_US:
            return 1
        return min(math.ceil(_BINS_PER_DECADE * math.log10(self.largest_us / _LOWEST_US)) + 1, len(self._bins))

    def percentiles_us(self, *percents: float) -> list[float]:
        """Return the upper edge in µs of the bin that holds each percentile; 0 where nothing was counted or lasted."""
        seen = list(itertools.accumulate(self._bins[: self._used]))
        count, largest_us, bins = self.count, self.largest_us, len(seen)
        edges = []
        for percent in percents:
            index = bisect_left(seen, max(1.0, percent / 100.0 * count))
            edges.append(min(largest_us, _UPPER_EDGES_US[index]) if 0 < index < bins else 0.0)
        return edges

    def summary(self) -> dict[str, float]:
        """Return p50, p90, p99 and max, in µs."""
        p50, p90, p99 = self.percentiles_us(50.0, 90.0, 99.0)
        return {"p50": round(p50, 1), "p90": round(p90, 1), "p99": round(p99, 1), "max": round(self.largest_us, 1)}

    def histogram(self) -> list[tuple[float, int]]:
        """Return upper edge in µs and count of the bins that are not empty, 10 a decade: for a client to draw."""
        bins = self._bins
        merged = [(0, bins[0])]
        used = _COARSE_EDGES[: math.ceil((self._used - 1) / _MERGED)]
        merged += [(index, sum(bins[index - _MERGED + 1 : index + 1])) for index in used]
        return [(_EDGES_US[index], count) for index, count in merged if count]
