"""The service: on each tick read the bus, update the axis, write the command, publish what happened."""

import asyncio
from collections.abc import Callable
from typing import Any

import structlog

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.messages import NO_EFFORT, Command
from twostage_servo.axis.state import ENABLED
from twostage_servo.axis.trips import TripCode
from twostage_servo.canbus.link import Link, LinkError
from twostage_servo.canbus.profile import DriveProfile
from twostage_servo.service.desk import Desk
from twostage_servo.service.receiver import Receiver
from twostage_servo.service.recorder import Record, Recorder
from twostage_servo.service.reporter import Reporter
from twostage_servo.service.requests import Request
from twostage_servo.service.settings import ServiceSettings
from twostage_servo.service.snapshot import take_snapshot
from twostage_servo.service.statistics import LatenessHistogram
from twostage_servo.ticks import Tick, Ticks

Publisher = Callable[[Tick], None]
FrameObserver = Callable[[int, str, int, bytes], None]

_DROPPED_IN_A_ROW = 2
"""Commands in a row that the bus did not take, at which the axis trips: one is an accident."""

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
    dated
        Whether the drive samples at a rhythm of its own, so that a frame's age dates its sample.

    Attributes
    ----------
    desk
        Where clients ask for what they want.
    reporter
        Tells the log, and keeps the recordings of trips.
    failure
        The defect that ends the service, or None.
    failed_tick
        Index of the latest tick in which a defect showed, and which does not count as completed; or None.
    command
        What the axis decided on in this tick.
    bus_error
        Why the bus is not open; None while it is.
    publishers
        Called at the end of each tick; they must not wait.
    frame_observers
        Called with tick index, ``sent`` or ``received``, identifier and data of each frame.
    """

    def __init__(
        self, settings: ServiceSettings, axis: Axis, profile: DriveProfile, link: Link, *, dated: bool = False
    ) -> None:
        self.settings = settings
        self.axis = axis
        self.profile = profile
        self.link = link
        self.receiver = Receiver(profile, link, settings.tick_ms / 1e3, dated=dated)
        self.ticks = Ticks(settings.tick_ms / 1e3)
        self.lateness = LatenessHistogram()
        self.tick_count = 0
        self.tick_missed = 0
        self.uptime_s = 0.0
        self.recorder = Recorder(max(1, round(1e3 * settings.recording_s / settings.tick_ms)))
        self.desk = Desk(self)
        self.reporter = Reporter(self)
        self.publishers: list[Publisher] = [self.reporter]
        self.frame_observers: list[FrameObserver] = []
        self.command: Command = NO_EFFORT
        self.failure: Exception | None = None
        self.failed_tick: int | None = None
        self.bus_error: str | None = "not opened yet"
        self._command_counter = 0
        self._sent_s: float | None = None
        self._dropped_in_a_row = 0
        self._opening: asyncio.Task[None] | None = None
        self._ending_ticks: int | None = None
        self._parting_frames = 0
        self._log = structlog.get_logger().bind(axis=axis.settings.name)

    async def run(self) -> None:
        """Run until :meth:`shut_down` has brought the axis to rest; the drive is disabled on every way out.

        Raises
        ------
        Exception
            A defect of this program. If the tick still works, a quick stop has brought the axis to rest before.
        """
        self._opening = asyncio.create_task(self._keep_trying_to_open())
        try:
            async for tick in self.ticks:
                try:
                    self.read(tick)
                    self.update(tick)
                    self.write(tick)
                except Exception as error:  # noqa: BLE001 - raised again when the axis is at rest, or at once
                    self._fail(tick, error, in_control=True)
                try:
                    self.publish(tick)
                except Exception as error:  # noqa: BLE001 - likewise
                    self._fail(tick, error, in_control=False)
                self._end_at_rest()
        finally:
            try:
                self._disable_drive()
            finally:
                self._opening.cancel()
                await asyncio.gather(self._opening, return_exceptions=True)
                self.link.close()
        if self.failure is not None:
            raise self.failure

    def shut_down(self) -> None:
        """Bring the axis to rest, disable the drive, and end the loop; within the shutdown time-out at the latest."""
        if self._ending_ticks is None:
            self._ending_ticks = round(self.settings.shutdown_timeout_ms / self.settings.tick_ms)
            self._log.info("ending", state=self.axis.state)
            self.axis.disarm()

    @property
    def is_ending(self) -> bool:
        """Whether :meth:`shut_down` has been called."""
        return self._ending_ticks is not None

    # The tick --------------------------------------------------------------------------------------------------------

    def read(self, tick: Tick) -> None:
        """Drain the bus; the newest feedback of the drive goes to the axis."""
        self.lateness.add(tick.lateness_s)
        self.tick_count += 1
        self.tick_missed += tick.missed
        self.uptime_s = tick.index * self.ticks.period_s
        self.axis.begin_tick(tick.index, tick.missed)
        self.receiver.begin_tick(tick, self._sent_s)
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
            self.receiver.take(message, self.axis)

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
        self._sent_s = asyncio.get_running_loop().time() if sent else None
        self._dropped_in_a_row = 0 if sent else self._dropped_in_a_row + 1
        if self._dropped_in_a_row >= _DROPPED_IN_A_ROW:
            self.axis.raise_trip(
                TripCode.COMMANDS_DROPPED, f"the bus has not taken {self._dropped_in_a_row} commands in a row"
            )
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

    # Requests --------------------------------------------------------------------------------------------------------

    def handle(self, request: Request, client: str = "this process") -> dict[str, Any]:
        """Carry out a request of a client; see :meth:`Desk.handle`."""
        return self.desk.handle(request, client)

    def snapshot(self) -> dict[str, Any]:
        """Return the state of service and axis, ready for JSON."""
        return take_snapshot(self)

    # Small parts -----------------------------------------------------------------------------------------------------

    def _end_at_rest(self) -> None:
        if self._ending_ticks is not None and self.axis.state not in ENABLED:
            self._parting_frames += 1
            if self._parting_frames >= _PARTING_FRAMES:
                self.ticks.stop()

    def fail(self, error: Exception) -> None:
        """Take notice of a defect outside the tick: quick stop, then the service ends with it."""
        self._fail(None, error, in_control=False)

    def _fail(self, tick: Tick | None, error: Exception, *, in_control: bool) -> None:
        """Quick stop at the first defect; a second one in what controls the axis ends the loop at once."""
        if tick is not None:
            self.failed_tick = tick.index
        if self.failure is not None:
            if in_control:
                raise self.failure
            return
        self.failure = error
        self._log.critical("the loop failed, the axis is being stopped", exc_info=error)
        self.axis.raise_trip(TripCode.INTERNAL_ERROR, f"{type(error).__name__} in the loop: {error}")
        self.shut_down()

    def _lose_bus(self, error: LinkError) -> None:
        self.bus_error = str(error)
        self._log.error("the bus failed", error=self.bus_error)
        self.axis.raise_trip(TripCode.BUS_FAILED, self.bus_error)
        self.axis.drive.forget()
        self.receiver.forget()
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
