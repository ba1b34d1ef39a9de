"""What is checked of each frame that comes in: it is used, rejected, or left as a repetition, and counted as that."""

import functools
import math
from collections import Counter
from collections.abc import Iterator, Mapping

import can

from tools.fuzz.drives import Kind
from tools.fuzz.made_up_bus import MadeUpBus
from tools.fuzz.outcome import Failed
from twostage_servo.axis.messages import ForeignCommand
from twostage_servo.drives.drive import Decoder, Report
from twostage_servo.drives.frame import ReceivedFrame
from twostage_servo.service.axis_loop import AxisLoop


class FrameCheck:
    """Follows the frames of a made-up bus through the service's counters.

    Parameters
    ----------
    bus
        Where they come from.
    axis_loop
        The axis that they are for.
    kinds
        The kinds of frames of its drive, by name.
    period_s
        Length of a tick in s.

    Attributes
    ----------
    decoded
        How many frames of each kind were used.
    discarded
        Frames that were read in a drain that then found the bus gone.
    """

    def __init__(self, bus: MadeUpBus, axis_loop: AxisLoop, kinds: Mapping[str, Kind], period_s: float) -> None:
        self.decoded: Counter[str] = Counter()
        self.discarded = 0
        self._bus = bus
        self._axis_loop = axis_loop
        self._period_s = period_s
        self._command_number = axis_loop.drive.command_id.identifier
        self._feedback_number = axis_loop.drive.feedback_id.identifier
        self._listened = {identifier.identifier for identifier in axis_loop.drive.decoders}
        self._decoded = 0
        self._seen = (0, 0, 0, 0)
        self._last: can.Message | None = None
        self._arrivals: Iterator[can.Message] = iter(())
        self._was_late = 0
        self._was_fresh = False
        self._counts = (0, 0)
        receivers = axis_loop.bus._receivers  # noqa: SLF001 - counts what they decode
        for name, kind in kinds.items():
            decode = self._counted(name, axis_loop.drive.decoders[kind.identifier])
            receivers[kind.identifier.identifier] = functools.partial(axis_loop._deliver, decode)  # noqa: SLF001 - likewise

    def _counted(self, name: str, decode: Decoder) -> Decoder:
        decoded = self.decoded

        def counted(message: ReceivedFrame) -> Report | None:
            record = decode(message)
            if not isinstance(record, ForeignCommand) or record.command is not None:
                decoded[name] += 1
                self._decoded += 1
            return record

        return counted

    def observe(self, _: int, direction: str, number: int, __: bytes) -> None:
        """Look, as a frame is about to be taken, at what became of the one before."""
        if direction == "received":
            if self._last is None:
                self._arrivals = iter([message for message in self._bus.taken if self._is_ours(message)])
            else:
                self._check(self._last)
            self._last = next(self._arrivals)
            if self._last.arbitration_id != number:
                raise Failed(f"{self._last} came in, and 0x{number:X} is taken")

    def end_tick(self) -> None:
        """Check that each frame that came in was counted, and each rejected one by its reason; begin the next tick."""
        self._check_counts()
        counters, monitor = self._axis_loop.bus.link.counters, self._axis_loop.axis.drive.monitor
        self._counts = counters.received, counters.errors
        self._last = None
        self._was_late, self._was_fresh = monitor.late, False
        self._seen = counters.rejected, self._decoded, monitor.doubled + monitor.reordered, monitor.rejected

    def _is_ours(self, message: can.Message) -> bool:
        return message.arbitration_id in self._listened and not message.is_error_frame

    def _check(self, message: can.Message) -> None:
        """Check that a frame that came in was used, rejected, or left as a repetition: exactly one of the three."""
        rejected = self._axis_loop.bus.link.counters.rejected
        drive = self._axis_loop.axis.drive
        monitor = drive.monitor
        left = monitor.doubled + monitor.reordered
        was_rejected, was_decoded, was_left, was_refused = self._seen
        number = message.arbitration_id
        refused = rejected - was_rejected
        decoded = self._decoded - was_decoded
        # Somebody else's command is told of, whether it can be read or not.
        if refused + decoded not in ({0, 1} if number == self._command_number else {1}):
            raise Failed(f"a frame 0x{number:X} was {decoded} times used and {refused} times counted as rejected")
        if number == self._feedback_number:
            if decoded and left - was_left not in {0, 1}:
                raise Failed(f"a feedback was {left - was_left} times counted as repeated or overtaken")
            if decoded and left == was_left and monitor.rejected == was_refused:
                self._check_freshness(message)
            if refused and monitor.rejected != was_refused + 1:
                raise Failed("a rejected feedback is not among the errors of the channel")
        position = drive.position
        if position is not None and not math.isfinite(position):
            raise Failed(f"the measured position is {position}")
        self._seen = rejected, self._decoded, left, monitor.rejected
        self._was_late, self._was_fresh = monitor.late, drive.fresh

    def _check_freshness(self, message: can.Message) -> None:
        """Check that a feedback that is neither rejected nor a repetition is either fresh or late."""
        drive = self._axis_loop.axis.drive
        late = drive.monitor.late != self._was_late
        expected = self._bus.is_late(message, self._period_s)
        if expected not in {None, late}:
            raise Failed(
                f"a feedback of {message.timestamp}, read at {self._bus.now_s}, is {'' if late else 'not '}late"
            )
        if drive.fresh != (self._was_fresh or not late):
            raise Failed(
                "a feedback that is neither rejected, a repetition nor late is not fresh, or one is in spite of it"
            )

    def _check_counts(self) -> None:
        counters, taken = self._axis_loop.bus.link.counters, self._bus.taken
        received, errors = self._counts
        if self._axis_loop.bus.error is None:
            if self._last is not None:
                self._check(self._last)
            wrong = sum(message.is_error_frame for message in taken)
            ours = sum(map(self._is_ours, taken))
            if counters.received - received != ours or counters.errors - errors != wrong:
                raise Failed(
                    f"{ours} frames and {wrong} error frames came in, {counters.received - received} and "
                    f"{counters.errors - errors} were counted"
                )
        elif counters.received == received:
            self.discarded += len(taken)
        if counters.rejected != sum(counters.rejected_by_reason.values()):
            raise Failed(f"{counters.rejected} frames rejected, by reason {counters.rejected_by_reason}")
