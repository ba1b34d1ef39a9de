"""What is sent to a drive, and heard from it, before it can be used: a sequence of steps, advanced by the tick."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from twostage_servo.drives.frame import ReceivedFrame, SentFrame


@dataclass(frozen=True, slots=True)
class StartUpStep:
    """One row of the sequence.

    Attributes
    ----------
    send
        Frames that are sent as it begins, and again with each retry.
    expect
        Whether a frame is the answer; None where nothing is waited for.
    timeout_s
        How long the answer may take, in s.
    retries
        How often it is tried again.
    on_failure
        For the operator: what has failed then, and what to do. The sequence begins anew.
    """

    send: Sequence[SentFrame]
    expect: Callable[[ReceivedFrame], bool] | None
    timeout_s: float
    retries: int
    on_failure: str


class StartUp:
    """Runs the sequence of a drive. Meanwhile the drive gets commands without effort, and the axis hears nothing of it.

    It never waits, so that the commands go on in every tick: a drive's own time-out must not end its start-up.

    Parameters
    ----------
    steps
        The sequence; an empty one is done from the start.
    period_s
        Length of a tick in s.

    Attributes
    ----------
    is_done
        Whether the drive can be used.
    failure
        What failed last, for the operator; empty where nothing has.
    """

    def __init__(self, steps: Sequence[StartUpStep], period_s: float) -> None:
        self._steps = steps
        self._period_s = period_s
        self.failure = ""
        self.restart()

    def restart(self) -> None:
        """Begin anew, as after the bus was lost."""
        self._index = self._tries = 0
        self._ticks_left = 0
        self._sent = False
        self.is_done = not self._steps

    def accept(self, frame: ReceivedFrame) -> None:
        """Accept a frame of the drive, which may be the expected answer."""
        if self.is_done or not self._sent:
            return
        expect = self._steps[self._index].expect
        if expect is not None and expect(frame):
            self._advance()

    def frames(self, missed: int) -> Sequence[SentFrame]:
        """Return what has to be sent in this tick, before which so many were missed."""
        if self.is_done:
            return ()
        step = self._steps[self._index]
        if self._sent:
            self._ticks_left -= 1 + missed
            if self._ticks_left > 0:
                return ()
            if self._tries > step.retries:
                self.failure = step.on_failure
                self.restart()
                step = self._steps[0]
        self._sent, self._tries = True, self._tries + 1
        self._ticks_left = math.ceil(step.timeout_s / self._period_s)
        if step.expect is None:
            self._advance()
        return step.send

    def _advance(self) -> None:
        self._index += 1
        self._sent, self._tries = False, 0
        self.is_done = self._index == len(self._steps)
