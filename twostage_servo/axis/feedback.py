"""Which feedback is new: alive counters, lost and doubled frames, and how long ago the last fresh one came."""


class FeedbackMonitor:
    """Follows the drive's alive counter.

    Parameters
    ----------
    counter_modulus
        Number of values of the counter.

    Attributes
    ----------
    lost, doubled, reordered
        Frames missed, repeated and overtaken so far, by the counter.
    ticks_since_fresh
        Ticks since the last fresh feedback, 0 in a tick that had one; None before the first.
    """

    __slots__ = ("_counter", "_modulus", "doubled", "lost", "reordered", "ticks_since_fresh")

    def __init__(self, counter_modulus: int) -> None:
        self._modulus = counter_modulus
        self._counter: int | None = None
        self.lost = self.doubled = self.reordered = 0
        self.ticks_since_fresh: int | None = None

    def begin_tick(self, missed: int) -> None:
        """Let the age of the last feedback grow by this tick and those missed before it."""
        if self.ticks_since_fresh is not None:
            self.ticks_since_fresh += 1 + missed

    def accept(self, counter: int | None) -> bool:
        """Take a frame's counter; return whether the frame is newer than all before it.

        A drive without a counter gives None, and each of its frames is taken for a new one.
        """
        if counter is not None and self._counter is not None:
            step = (counter - self._counter) % self._modulus
            # After half a round of silence old and new can't be told apart any more, and any frame starts afresh.
            silent = self.ticks_since_fresh is None or self.ticks_since_fresh > self._modulus // 2
            if not silent:
                if step == 0:
                    self.doubled += 1
                    return False
                if step > self._modulus // 2:
                    self.reordered += 1
                    return False
                self.lost += step - 1
        self._counter = counter
        self.ticks_since_fresh = 0
        return True

    def forget(self) -> None:
        """Start afresh, as after the bus was reopened."""
        self._counter = None
        self.ticks_since_fresh = None
