"""Figures that are given for a tick of 10 ms, for any other tick: an axis is as well known on 2 ms as on 20 ms."""

import math
from typing import Final

NOMINAL_S: Final = 0.01
"""The tick that such figures are given for, in s."""


def share_in(share: float, period_s: float) -> float:
    """Return what a period (s) takes away if the nominal one takes a share."""
    if period_s == NOMINAL_S:  # to the last bit
        return share
    return 1.0 - kept_in(1.0 - share, period_s)


def kept_in(kept: float, period_s: float) -> float:
    """Return what is left after a period (s) if so much is left after the nominal one."""
    return float(kept ** (period_s / NOMINAL_S))


def samples_in(duration_s: float, period_s: float, least: int) -> int:
    """Return how many samples a time has, rounded up, and no fewer than it takes to tell a single one from them."""
    return max(least, math.ceil(duration_s / period_s - 1e-9))
