"""Simulated time on a host whose clock moves on while a program looks at it."""

import itertools
from typing import TYPE_CHECKING

from twostage_servo.timing.virtual_clock import VirtualClockLoop

if TYPE_CHECKING:
    from collections.abc import Iterator


class HostLoop(VirtualClockLoop):
    """Simulated time on a host that wakes up late, and whose clock moves on by 100 ns each time it is read."""

    def __init__(self) -> None:
        super().__init__()
        self.latencies_s: Iterator[float] = itertools.repeat(0.0)

    def time(self) -> float:
        self._now_s += 1e-7
        return self._now_s

    def work(self, seconds: float) -> None:
        """Let time pass as a computation does."""
        self._now_s += seconds

    def _jump_to_next_timer(self) -> None:
        super()._jump_to_next_timer()
        self._now_s += next(self.latencies_s)
