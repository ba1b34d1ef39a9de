"""How old a request is: since when it may have been waiting to be read."""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from typing import Final

_LONGEST_S: Final = 1.0
_LONGEST_TICKS: Final = 10
_PASSES: Final = 3
"""Ticks after which whatever could be read when the first of them ended has been noticed: between two ticks the loop
looks at all of its descriptors at least once, and what it finds may have to wait for one tick to be told."""


def no_time_asleep() -> float:
    """Return 0 s: in simulated time nobody sleeps."""
    return 0.0


def time_asleep_s() -> float:
    """Return how long the machine has been suspended since it started, s, which its monotonic clock does not count."""
    awake_s = time.clock_gettime(time.CLOCK_MONOTONIC)  # read first: the difference is never too small
    return time.clock_gettime(time.CLOCK_BOOTTIME) - awake_s


class RequestAge:
    """Judges how old requests are, on the loop's clock and whatever the machine has slept besides.

    When bytes came the kernel does not say. But it is known since when they can have been there at the earliest: from
    the last moment at which there was nothing to be read. The age is counted from there, so it is never too small. In
    a service whose loop runs that is a few ticks more than the truth. In one that stood still as a whole
    (SIGSTOP, a machine that was suspended) it is the whole of that time, for whatever came meanwhile.

    Parameters
    ----------
    period_s
        Period of the ticks, s.
    asleep_s
        Tells how long the machine has slept, s.

    Attributes
    ----------
    longest_s
        The age at which a command expires.
    """

    def __init__(self, period_s: float, asleep_s: Callable[[], float] = no_time_asleep) -> None:
        self.longest_s = max(_LONGEST_S, _LONGEST_TICKS * period_s)
        self._asleep_s = asleep_s
        self._passes: deque[float] = deque(maxlen=_PASSES)

    def tick(self) -> None:
        """Record that the loop has begun another tick."""
        self._passes.append(self.now_s())

    def now_s(self) -> float:
        """Return the time, s."""
        return asyncio.get_running_loop().time() + self._asleep_s()

    def was_empty_until_s(self, watched_since_s: float) -> float | None:
        """Return until when a descriptor that shows only now had nothing to be read; None if that is not known.

        Parameters
        ----------
        watched_since_s
            Since when the loop has watched it.
        """
        earliest = self._passes[0] if len(self._passes) == _PASSES else None
        return earliest if earliest is not None and watched_since_s <= earliest else None
