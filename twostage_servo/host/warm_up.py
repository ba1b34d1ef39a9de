"""Runs a step often enough before it matters that its first time is behind it."""

import time
from collections.abc import Callable
from typing import Final, NamedTuple

ROUNDS: Final = 200


class WarmUp(NamedTuple):
    """How long a step took the first time, and at last; s."""

    first_s: float
    settled_s: float


def warm_up(step: Callable[[], object], rounds: int = ROUNDS, clock: Callable[[], float] = time.perf_counter) -> WarmUp:
    """Run a step until its page faults, look-ups and the specialisation of its bytecode are behind it.

    CPython specialises the bytecode of a function that has run a few times (PEP 659), for all objects that use it
    later. So the step has to be one of objects that are thrown away: nothing of what it does may be seen from outside.

    Parameters
    ----------
    step
        One pass of what the loop does, on objects of its own.
    rounds
        How often; at least 2.
    clock
        A clock, s.

    Returns
    -------
    WarmUp
        The duration of the first step, and the shortest of all.
    """
    durations = []
    for _ in range(max(2, rounds)):
        begun_s = clock()
        step()
        durations.append(clock() - begun_s)
    return WarmUp(durations[0], min(durations))
