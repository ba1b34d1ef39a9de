"""The service: on each tick read the bus, update the axis, write the command, publish what happened."""

import asyncio
from collections.abc import Callable
from typing import Any

import can
import structlog

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.messages import NO_EFFORT, Command, Refused
from twostage_servo.axis.state import DRIVEN, ENABLED
from twostage_servo.axis.trips import Trip, TripCode
from twostage_servo.canbus.link import Link, LinkError
from twostage_servo.canbus.profile import DriveProfile, FrameRejected
from twostage_servo.service.recorder import Record, Recorder
from twostage_servo.service.requests import (
    ArmRequest,
    DisarmRequest,
    MoveRequest,
    RecordingRequest,
    Request,
    ResetRequest,
    StatusRequest,
    StopRequest,
    WatchRequest,
)
from twostage_servo.service.settings import ServiceSettings
from twostage_servo.service.snapshot import take_snapshot
from twostage_servo.service.statistics import LatenessHistogram
from twostage_servo.ticks import Tick, Ticks

_READING = (StatusRequest, WatchRequest)
Publisher = Callable[[Tick], None]
FrameObserver = Callable[[int, str, int, bytes], None]

_PARTING_FRAMES = 3
"""Disable commands sent before the service ends: one lost frame must not leave the drive to its time-out."""


class ServoService:
    """One axis on one bus.

    Parameters
    ----------
    settings
        The table ``[service]``.
    axis
        The axis to drive.
    profile
        How its drive's frames are packed.
    link
        The bus, not yet open.

    Attributes
    ----------
    command
        What the axis decided on in this tick.
    bus_error
        Why the bus is not open; None while it is.
    publishers
        Called at the end of each tick; they must not wait.
    frame_observers
        Called with tick index, ``sent`` or ``received``, identifier and data of each frame.
    """

    def __init__(self, settings: ServiceSettings, axis: Axis, profile: DriveProfile, link: Link) -> None:
        self.settings = settings
        self.axis = axis
        self.profile = profile
        self.link = link
        self.ticks = Ticks(settings.tick_ms / 1e3)
        self.lateness = LatenessHistogram()
        self.tick_count = 0
        self.tick_missed = 0
        self.uptime_s = 0.0
        self.heartbeat_state: int | None = None
        self.recorder = Recorder(max(1, round(1e3 * settings.recording_s / settings.tick_ms)))
        self.publishers: list[Publisher] = [self._report_changes]
        self.frame_observers: list[FrameObserver] = []
        self.command: Command = NO_EFFORT
        self._command_counter = 0
        self.bus_error: str | None = "not opened yet"
        self._opening: asyncio.Task[None] | None = None
        self._ending_ticks: int | None = None
        self._parting_frames = 0
        self._reported_state = axis.state
        self._reported_trip: Trip | None = None
        self._reported_rejected = 0
        self._reported_stale = True
        self._ticks_a_report = max(1, round(1e3 / settings.tick_ms))
        self._log = structlog.get_logger().bind(axis=axis.settings.name)

    async def run(self) -> None:
        """Run until :meth:`shut_down` has brought the axis to rest; the drive is disabled on every way out."""
        self._opening = asyncio.create_task(self._keep_trying_to_open())
        try:
            async for tick in self.ticks:
                self.read(tick)
                self.update(tick)
                self.write(tick)
                self.publish(tick)
        except Exception:
            self._log.critical("the loop failed, the drive is being disabled", exc_info=True)
            raise
        finally:
            self._disable_drive()
            self._opening.cancel()
            await asyncio.gather(self._opening, return_exceptions=True)
            self.link.close()

    def shut_down(self) -> None:
        """Bring the axis to rest, disable the drive, and end the loop; within the shutdown time-out at the latest."""
        if self._ending_ticks is None:
            self._ending_ticks = round(self.settings.shutdown_timeout_ms / self.settings.tick_ms)
            self._log.info("ending", state=self.axis.state)
            self.axis.disarm()

    # The tick --------------------------------------------------------------------------------------------------------

    def read(self, tick: Tick) -> None:
        """Drain the bus; the newest feedback of the drive goes to the axis."""
        self.lateness.add(tick.lateness_s)
        self.tick_count += 1
        self.tick_missed += tick.missed
        self.uptime_s = tick.index * self.ticks.period_s
        self.axis.begin_tick(tick.index, tick.missed)
        if self.bus_error is not None:
            return
        try:
            messages = self.link.drain()
        except LinkError as error:
            self._lose_bus(error)
            return
        for message in messages:
            for observe in self.frame_observers:
                observe(tick.index, "received", message.arbitration_id, bytes(message.data))
            try:
                self._take(message)
            except FrameRejected as rejection:
                self.link.counters.rejected += 1
                self._log.debug("frame rejected", tick=tick.index, reason=rejection.reason, text=str(rejection))

    def update(self, _: Tick) -> None:
        """Let the axis decide on its effort."""
        if self._ending_ticks is not None:
            self._ending_ticks -= 1
            self.axis.disarm()
            if self._ending_ticks <= 0:
                self.axis.end_braking()
        self.command = self.axis.step()

    def write(self, tick: Tick) -> None:
        """Send the newest command; one that the bus cannot take now is dropped, never kept."""
        if self.bus_error is not None:
            return
        command = self.command
        data = self.profile.encode_command(command.effort, command.enable, self._next_counter())
        try:
            sent = self.link.send(self.profile.command_id, data)
        except LinkError as error:
            self._lose_bus(error)
            return
        if sent:
            for observe in self.frame_observers:
                observe(tick.index, "sent", self.profile.command_id.identifier, data)

    def publish(self, tick: Tick) -> None:
        """Record the tick and tell whoever listens; none of it waits."""
        axis, observer = self.axis, self.axis.law.observer
        self.recorder.add(
            Record(
                tick.index, tick.missed, 1e6 * tick.lateness_s, axis.state, axis.drive.position, observer.position,
                observer.velocity, observer.disturbance, self.command.effort, axis.law.target,
                axis.law.speed_reference, axis.following_error,
            )
        )  # fmt: skip
        for publisher in self.publishers:
            publisher(tick)
        if self._ending_ticks is not None and axis.state not in ENABLED:
            self._parting_frames += 1
            if self._parting_frames >= _PARTING_FRAMES:
                self.ticks.stop()

    # Requests --------------------------------------------------------------------------------------------------------

    def handle(self, request: Request) -> dict[str, Any]:
        """Carry out a request of a client.

        Raises
        ------
        Refused
            If the axis does not carry it out.
        """
        if isinstance(request, RecordingRequest):
            return {"fields": Record._fields, "records": self.recorder.records()}
        if not isinstance(request, _READING):
            if self._ending_ticks is not None:
                raise Refused("ending", "the service is ending: nothing but reading is possible any more.")
            self._command_axis(request)
        return self.snapshot()

    def _command_axis(self, request: Request) -> None:
        axis = self.axis
        match request:
            case ArmRequest():
                if self.bus_error is not None:
                    raise Refused("bus_closed", f"the bus is not open: {self.bus_error}")
                axis.arm()
            case DisarmRequest():
                axis.disarm()
            case StopRequest():
                axis.stop()
            case ResetRequest():
                axis.reset()
                self.recorder.discard()
            case MoveRequest(position=position, by=by, velocity=velocity):
                speed = axis.settings.cruise_velocity if velocity is None else velocity
                if position is not None:
                    axis.move_to(position, speed)
                elif by is not None:
                    axis.move_by(by, speed)

    def snapshot(self) -> dict[str, Any]:
        """Return the state of service and axis, ready for JSON."""
        return take_snapshot(self)

    # Small parts -----------------------------------------------------------------------------------------------------

    def _take(self, message: can.Message) -> None:
        profile = self.profile
        if profile.is_feedback(message):
            feedback = profile.decode_feedback(message)
            faulty = (
                feedback.fault
                or (feedback.fault is None and feedback.fault_code)
                or (feedback.command_timeout and self.axis.state in DRIVEN)
            )
            fault_code = (feedback.fault_code or 0) if faulty else None
            self.axis.take_feedback(feedback.position, feedback.counter, feedback.enabled, fault_code)
        elif profile.is_heartbeat(message):
            self.heartbeat_state = profile.decode_heartbeat(message).state
        else:
            self.axis.notice_foreign_command(f"0x{message.arbitration_id:X} [{message.data.hex(' ')}]")

    def _lose_bus(self, error: LinkError) -> None:
        self.bus_error = str(error)
        self._log.error("the bus failed", error=self.bus_error)
        self.axis.raise_trip(TripCode.BUS_FAILED, self.bus_error)
        self.axis.drive.forget()
        self.heartbeat_state = None
        self.link.close()
        self._opening = asyncio.create_task(self._keep_trying_to_open())

    async def _keep_trying_to_open(self) -> None:
        """Open the bus, in a thread since that may take seconds; the axis is disarmed or tripped meanwhile."""
        while True:
            try:
                await self.link.open_in_thread()
            except LinkError as error:
                if str(error) != self.bus_error:
                    self._log.warning("the bus does not open, trying again", error=str(error))
                self.bus_error = str(error)
                await asyncio.sleep(self.link.settings.reopen_interval_ms / 1e3)
            else:
                self.bus_error = None
                self._log.info(
                    "the bus is open", interface=self.link.settings.interface, channel=self.link.settings.channel
                )
                return

    def _disable_drive(self) -> None:
        if self.bus_error is not None:
            return
        data = self.profile.encode_command(0.0, enable=False, counter=self._next_counter())
        try:
            self.link.send(self.profile.command_id, data)
        except LinkError as error:
            self._log.error("the drive could not be told to disable; its own time-out has to stop it", error=str(error))

    def _next_counter(self) -> int:
        self._command_counter += 1
        return self._command_counter

    def _report_changes(self, tick: Tick) -> None:
        axis, rejected = self.axis, self.link.counters.rejected
        if axis.trip is not None and axis.trip is not self._reported_trip:
            self.recorder.keep()
            self._log.error(
                "trip", tick=tick.index, code=axis.trip.code, cause=axis.trip.cause, next_action=axis.trip.next_action
            )
        self._reported_trip = axis.trip
        if axis.state is not self._reported_state:
            self._log.info("state", tick=tick.index, before=self._reported_state, now=axis.state)
            self._reported_state = axis.state
        if axis.drive.is_stale is not self._reported_stale:
            self._reported_stale = axis.drive.is_stale
            self._log.warning("feedback stale" if self._reported_stale else "feedback fresh", tick=tick.index)
        if rejected != self._reported_rejected and tick.index % self._ticks_a_report == 0:
            self._log.warning(
                "frames rejected", tick=tick.index, new=rejected - self._reported_rejected, total=rejected
            )
            self._reported_rejected = rejected
