"""An axis as the service runs it: with its drive's frames, its place on a bus, and its recording."""

import asyncio
import functools

import can
import structlog

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.messages import NO_EFFORT, Command
from twostage_servo.axis.state import ENABLED
from twostage_servo.axis.trips import TripCode
from twostage_servo.drives.drive import Decoder, Drive
from twostage_servo.drives.start_up import StartUp
from twostage_servo.service.bus_connection import BusConnection, Subscriber
from twostage_servo.service.receiver import Receiver
from twostage_servo.telemetry.learned_files import LearnedFile
from twostage_servo.telemetry.recorder import Recorder
from twostage_servo.telemetry.sample import Sample
from twostage_servo.timing.histogram import TimeHistogram
from twostage_servo.timing.ticks import Tick

_DROPPED_IN_A_ROW = 2
"""Commands in a row that the bus did not take, at which the axis trips: one is an accident."""


class AxisLoop:
    """One axis of the service.

    Parameters
    ----------
    axis
        The axis.
    drive
        Its drive's frames.
    bus
        The bus it is on, to which it subscribes.
    period_s
        Length of a tick in s.
    recording_s
        Length of the recording in s.

    Attributes
    ----------
    axis, drive, bus
        As given; a configuration that is read again gives another axis.
    receiver
        Takes the drive's frames to the axis.
    recorder
        The last ticks.
    learned_file
        What became of the file of what the law has learned.
    command
        What the axis decided on in this tick.
    sample
        The newest tick that was recorded; None before the first.
    feedback_to_command
        How long it took from a feedback's arrival until the command that used it left, where the bus dates its frames.
    """

    def __init__(self, axis: Axis, drive: Drive, bus: BusConnection, period_s: float, recording_s: float) -> None:
        self.axis = axis
        self.drive = drive
        self.bus = bus
        self.start_up = StartUp(drive.start_up, period_s)
        self.receiver = Receiver(drive.traits, drive.feedback_id.identifier, period_s)
        self.recorder = Recorder(max(1, round(recording_s / period_s)), period_s)
        self.learned_file = LearnedFile()
        self.command: Command = NO_EFFORT
        self.sample: Sample | None = None
        self._period_s = period_s
        self.feedback_to_command = TimeHistogram()
        self._frames: list[can.Message] = []
        self._missed = 0
        self._start_up_failure = ""
        self._boots = 0
        self._sent_s: float | None = None
        self._dropped_in_a_row = 0
        self._told_to_enable = False  # by the last command that the bus has accepted
        receivers = {
            identifier.identifier: functools.partial(self._deliver, decode)
            for identifier, decode in drive.decoders.items()
        }
        bus.subscribe(Subscriber(receivers, self._record_backlog, self._lose_bus))

    @property
    def name(self) -> str:
        """The axis' name."""
        return self.axis.settings.name

    def begin_tick(self, tick: Tick) -> None:
        """Open a tick."""
        self.axis.begin_tick(tick.index, tick.missed, self._late_s(tick))
        self.receiver.begin_tick(tick, self._sent_s)
        self._missed = tick.missed

    def _late_s(self, tick: Tick) -> float:
        """Return how long after its deadline the last command left, in s; one that the bus has not taken never did."""
        if self._sent_s is None:
            return self._period_s if self._dropped_in_a_row else 0.0
        return self._sent_s - (tick.deadline_s - (1 + tick.missed) * self._period_s)

    def replace_axis(self, axis: Axis) -> None:
        """Put a disarmed axis of other settings in the place of the present one; it knows what that knew."""
        axis.continue_from(self.axis)
        self.axis = axis

    def update(self) -> None:
        """Let the axis decide on its effort."""
        self.command = self.axis.step()

    def make_ready(self) -> None:
        """Pack the newest command, so that nothing but its sending is left."""
        if self.axis.state not in ENABLED:  # another axis has tripped since this one decided
            self.command = NO_EFFORT
        self._frames = self._prepared(self.command)
        if self.drive.start_up:
            self._frames = self._start_up_frames() + self._frames

    def write(self, tick: Tick) -> None:
        """Send the newest command; one that the bus cannot take now is dropped, never kept."""
        sent = self.bus.send(tick.index, self._frames)
        if sent is None:
            return
        if not sent:
            self._sent_s = None
            self._dropped_in_a_row += 1
            if self._dropped_in_a_row >= _DROPPED_IN_A_ROW:
                self.axis.raise_trip(
                    TripCode.COMMANDS_DROPPED, f"the bus did not accept {self._dropped_in_a_row} commands in a row"
                )
            return
        self._sent_s = sent_s = asyncio.get_running_loop().time()
        self._dropped_in_a_row = 0
        self._told_to_enable = bool(self.command.enable)
        arrived_s = self.receiver.arrived_s
        if arrived_s is not None:
            self.feedback_to_command.add(sent_s - arrived_s)

    def record(self, tick: Tick) -> None:
        """Record the tick."""
        axis, estimate = self.axis, self.axis.estimate
        self.sample = sample = Sample(
            tick.index, tick.missed, 1e6 * tick.lateness_s, axis.state, axis.drive.position, estimate.position,
            estimate.velocity, estimate.disturbance, self.command.effort, axis.set_point, axis.speed_reference,
            axis.following_error, tick.index * self._period_s,
        )  # fmt: skip
        self.recorder.add(sample)

    def _deliver(self, decode: Decoder, message: can.Message) -> None:
        """Deliver a frame of the drive, or one that only the drive should have received."""
        if self.start_up.is_done:
            self.receiver.deliver(decode, message, self.axis, self.bus.link)
        else:
            self.start_up.accept(message)

    def _record_backlog(self, reads: int, frames: int) -> None:
        self.axis.drive.record_backlog(reads, frames)

    def _lose_bus(self, error: str) -> None:
        """Trip, and know nothing of the drive any more."""
        self.axis.raise_trip(TripCode.BUS_FAILED, error)
        self.axis.drive.forget()
        self.receiver.forget()
        self.start_up.restart()

    def disable_drive(self, tick_index: int) -> None:
        """Tell the drive to disable, as the last thing before the service ends."""
        if self.bus.send(tick_index, self._prepared(NO_EFFORT)):
            self._told_to_enable = False
        else:
            text = "the drive could not be told to disable; only its own command time-out stops it"
            structlog.get_logger().error(text, axis=self.name, error=self.bus.error or "the bus accepts no frame")

    def report_if_not_disabled(self) -> bool:
        """Return whether the drive may be enabled as the service ends; log it if it was never seen disabled.

        It may be where the last that it has reported is that it is enabled, and where the last command that its bus has
        accepted told it to enable: a drive that does not report its state is then known from nothing else.
        """
        watch = self.axis.disabled
        if watch.seen_enabled:
            text = "the drive did not report that it is disabled; only its own command time-out stops it"
            structlog.get_logger().error(
                text, axis=self.name, code=TripCode.DRIVE_NOT_DISABLED, told_ms=watch.told_ms, moved=watch.moved
            )
        return watch.seen_enabled or self._told_to_enable

    def _prepared(self, command: Command) -> list[can.Message]:
        prepare = self.bus.link.prepare
        return [prepare(identifier, data) for identifier, data in self.drive.encode(command)]

    def _start_up_frames(self) -> list[can.Message]:
        """Go on with the drive's start-up by a tick; one that has booted needs it anew."""
        if self.axis.drive.boots != self._boots:
            self._boots = self.axis.drive.boots
            self.start_up.restart()
        frames = self.start_up.frames(self._missed)
        if self.start_up.failure != self._start_up_failure:
            self._start_up_failure = self.start_up.failure
            structlog.get_logger().error("the drive does not start up", axis=self.name, error=self._start_up_failure)
        return [self.bus.link.prepare(identifier, data) for identifier, data in frames]
