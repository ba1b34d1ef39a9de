"""A bus of python-can whose frames are made up, with the faults that an interface may have."""

from collections import deque

import can


class MadeUpBus(can.BusABC):
    """A bus whose frames lie in a queue.

    Attributes
    ----------
    queue
        What is received next.
    taken
        What was received since it was last emptied.
    sent
        The last frame that was sent.
    trouble
        Raised by the next calls, if any.
    sends
        How many were sent.
    refuses_to_open
        Whether the next attempt to open it fails.
    now_s
        The time by which frames are stamped.
    before_s, is_behind
        When the drain before the latest was, and whether it left frames behind.

    Parameters
    ----------
    stamps
        Whether it says so; most interfaces do not, and then the age of a frame is not known.
    """

    def __init__(self, *, stamps: bool) -> None:
        super().__init__(channel="made up")
        self.clock = self._now if stamps else None
        self.queue: deque[can.Message] = deque()
        self.taken: list[can.Message] = []
        self.sent: can.Message | None = None
        self.sends = 0
        self.trouble: Exception | None = None
        self.refuses_to_open = False
        self.now_s = self.before_s = self._drained_s = 0.0
        self.is_behind = False
        self._is_empty = True

    def recv(self, timeout: float | None = None) -> can.Message | None:  # noqa: ARG002 - never waits
        """Return the next frame."""
        if self.now_s != self._drained_s:  # the first of a drain
            self.before_s, self._drained_s = self._drained_s, self.now_s
            self.is_behind, self._is_empty = not self._is_empty, False
        if self.queue:
            message = self.queue.popleft()
            self.taken.append(message)
            return message
        if self.trouble is not None:
            raise self.trouble
        self._is_empty = True
        return None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - never waits
        """Remember what the service sends."""
        if self.trouble is not None:
            raise self.trouble
        self.sent = msg
        self.sends += 1

    def _now(self) -> float:
        return self.now_s

    def reopen(self) -> "MadeUpBus":
        """Open again, for the link."""
        if self.refuses_to_open:
            raise can.CanInitializationError("made up")
        self._drained_s, self._is_empty = self.now_s, True
        return self

    def is_late(self, message: can.Message, period_s: float) -> bool | None:
        """Whether a frame of the latest drain had waited for half a period, or for nobody knows how long.

        None where rounding decides. A date from the future, or from a second before the drain before, is no date.
        """
        if self.is_behind:
            return True
        age_s, waited_s = self.now_s - message.timestamp, self.before_s - message.timestamp
        if self.clock is None or not (age_s >= -1e-6 and waited_s <= 1.0):
            return False
        return None if abs(waited_s - 0.5 * period_s) < 1e-9 else waited_s > 0.5 * period_s
