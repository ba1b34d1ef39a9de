"""What a row of numbers comes to."""

import math
from collections.abc import Sequence
from typing import Any

Figures = dict[str, Any]
"""The figures of one contender, ready for JSON."""


def percentile(ordered: Sequence[float], share: float) -> float:
    """Return the smallest value that at least this share of the values does not exceed (the nearest rank)."""
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def summarise(values: Sequence[float]) -> Figures:
    """Return p50, p90, p99, max and count of at least one value."""
    ordered = sorted(values)
    figures = {f"p{rank}": round(percentile(ordered, rank / 100), 3) for rank in (50, 90, 99)}
    return figures | {"max": round(ordered[-1], 3), "count": len(ordered)}


def summarise_histogram(counts: dict[int, int]) -> Figures:
    """Return the same of a histogram: how often each value occurred."""
    return summarise([float(value) for value, count in counts.items() for _ in range(count)])
