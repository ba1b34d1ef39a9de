"""What the limit and the rate limit of an effort leave of it; the same for every law."""

from math import copysign, isfinite
from typing import NamedTuple


class LimitedEffort(NamedTuple):
    """An effort within its limits.

    Attributes
    ----------
    effort
        In effort unit.
    saturated
        Whether the limit has cut it, whatever the rate has left.
    """

    effort: float
    saturated: bool


def limited_effort(effort: float, before: float, limit: float, largest_step: float) -> LimitedEffort:
    """Hold an effort within its limit and its rate; what is no number stays none, for others to see.

    Parameters
    ----------
    effort, before
        What is wanted, and the effort of the period before, in effort unit.
    limit
        Largest magnitude, in effort unit.
    largest_step
        Largest change in a period, in effort unit.
    """
    if not isfinite(effort):
        return LimitedEffort(effort, saturated=False)
    saturated = not -limit <= effort <= limit
    if saturated:
        effort = copysign(limit, effort)
    step = effort - before
    if abs(step) > largest_step:
        effort = before + copysign(largest_step, step)
    return LimitedEffort(effort, saturated)
