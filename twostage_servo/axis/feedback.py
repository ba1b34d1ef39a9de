"""Which feedback is new, and how good it has been: alive counters, lost and repeated frames, and their age.

In the manner of AUTOSAR's end-to-end protection: a counter and a checksum in each frame say what happened to it on the
way, and a window over the last ticks says whether the channel as a whole is still to be relied on.
"""

from collections import deque

WINDOW_TICKS = 100
"""Ticks over which the errors of the channel are counted."""

_PAST_TICKS = WINDOW_TICKS - 1
"""Those of them that are over."""


class FeedbackMonitor:
    """Follows the drive's alive counter, and counts what goes wrong on the way.

    Parameters
    ----------
    counter_modulus
        Number of values of the counter.

    Attributes
    ----------
    lost, doubled, reordered, rejected
        Frames missed, repeated and overtaken so far by the counter, and those that could not be used at all.
    late, late_since_fresh
        Frames that were new and whole, but had waited unread for too long: in all, and since the last fresh one.
    implausible
        Samples that were new and whole, but not believed.
    ticks_since_fresh
        Ticks since the last fresh feedback, 0 in a tick that had one; None before the first.
    ticks_between_fresh
        How many ticks it came after the one before it.
    """

    __slots__ = (
        "_counter", "_errors", "_errors_now", "_modulus", "_rejected_since", "_window", "doubled",
        "implausible", "late", "late_since_fresh", "lost", "rejected", "reordered", "ticks_between_fresh",
        "ticks_since_fresh",
    )  # fmt: skip

    def __init__(self, counter_modulus: int) -> None:
        self._modulus = counter_modulus
        self._counter: int | None = None
        self.lost = self.doubled = self.reordered = self.rejected = self.implausible = 0
        self.late = self.late_since_fresh = 0
        self.ticks_since_fresh: int | None = None
        self.ticks_between_fresh = 0
        self._window: deque[int] = deque([0] * _PAST_TICKS, _PAST_TICKS)
        self._errors = 0
        self._errors_now = 0
        self._rejected_since = 0

    def begin_tick(self, missed: int) -> None:
        """Let the age of the last feedback grow by this tick and those missed before it."""
        if self.ticks_since_fresh is not None:
            self.ticks_since_fresh += 1 + missed
        self._errors += self._errors_now - self._window[0]
        self._window.append(self._errors_now)
        self._errors_now = 0

    @property
    def recent_errors(self) -> int:
        """Frames lost, repeated, overtaken, rejected or not believed in the last :data:`WINDOW_TICKS` ticks and now."""
        return self._errors + self._errors_now

    def accept(self, counter: int | None, *, late: bool = False) -> bool:
        """Compare a frame's counter with those before; return whether the frame is newer than all of them.

        A drive without a counter gives None, and each of its frames is taken for a new one. A late frame is counted
        as such, and is not fresh.
        """
        if counter is not None and self._counter is not None:
            step = (counter - self._counter) % self._modulus
            if step == 0:  # also after a silence: a drive that repeats itself must never look fresh
                self.doubled += 1
                self._errors_now += 1
                return False
            # After a silence of half the modulus old and new are ambiguous, and any other counter starts afresh.
            silent = self.ticks_since_fresh is None or self.ticks_since_fresh > self._modulus // 2
            if not silent:
                if step > self._modulus // 2:
                    self.reordered += 1
                    self._errors_now += 1
                    return False
                self.lost += step - 1
                # Those that were rejected on the way have been counted as errors already.
                self._errors_now += max(0, step - 1 - self._rejected_since)
        self._counter = counter
        self._rejected_since = 0
        if late:
            self.late += 1
            self.late_since_fresh += 1
        else:
            self.ticks_between_fresh = self.ticks_since_fresh or 0
            self.ticks_since_fresh = self.late_since_fresh = 0
        return True

    def reject(self) -> None:
        """Count a frame that could not be used: a wrong checksum or length, or a reserved value."""
        self.rejected += 1
        self._rejected_since += 1
        self._errors_now += 1

    def doubt(self) -> None:
        """Count a sample that was new and whole, but not to be believed."""
        self.implausible += 1
        self._errors_now += 1

    def forget(self) -> None:
        """Start afresh, as after the bus was reopened."""
        self._counter = None
        self.ticks_since_fresh = None
        self.ticks_between_fresh = 0
        self.late_since_fresh = 0
        self._window.extend([0] * _PAST_TICKS)
        self._errors = self._errors_now = 0
