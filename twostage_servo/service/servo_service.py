"""The service: on each tick read the buses, update the axes, write the commands, publish what happened."""

import asyncio
import contextlib
import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import structlog

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import Request
from twostage_servo.api.status import RealtimeStatus, Status
from twostage_servo.axis.state import BRAKING, ENABLED
from twostage_servo.axis.trips import TripCode
from twostage_servo.service.axis_group import AxisGroup, GroupReaction
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.background_server import BackgroundServer
from twostage_servo.service.bus_connection import BusConnection
from twostage_servo.service.desk import Desk
from twostage_servo.service.settings import ServiceSettings, with_time_to_stop
from twostage_servo.service.snapshot import report_service
from twostage_servo.service.statistics import TickStatistics
from twostage_servo.timing.ticks import Tick, Ticks, busy_wait

if TYPE_CHECKING:
    from twostage_servo.timing.output_offset import OutputOffset

Publisher = Callable[[Tick], None]

_PARTING_FRAMES = 3
"""Disable commands sent before the service ends: one lost frame must not leave the drive to its time-out."""


class ServoService:
    """Axes on their buses, on one tick.

    Parameters
    ----------
    settings
        The table ``[service]``.
    buses
        The buses with the axes on them.
    group_reaction
        What the other axes do when one trips.

    Attributes
    ----------
    settings
        As given, with the time that the axes take to stop where no `shutdown_timeout_ms` is stated.
    axis_loops
        The axes, in the order of their names' appearance.
    desk
        Where clients ask for what they want.
    turns
        When they may ask: between the ticks.
    statistics
        What the ticks were like.
    failure
        The defect that ends the service, or None.
    not_disabled
        Names of the axes whose drives had not reported that they are disabled when the service ended.
    failed_tick
        Index of the latest tick in which a defect showed, and which does not count as completed; or None.
    publishers
        Called at the end of each tick; they must not wait.
    after_tick
        Called with the tick and the loop's time in s when the tick is over: for work that fits into the idle time.
    output_offset
        How long after the deadline of a tick its commands leave; None lets them leave as soon as they are ready.
    host
        Tells how punctual the host lets the service be; None where it runs in simulated time.
    """

    def __init__(
        self, settings: ServiceSettings, buses: Sequence[BusConnection], group_reaction: GroupReaction = "stop"
    ) -> None:
        self.settings = self._stated = settings
        self.buses = buses
        self.axis_loops = [axis_loop for bus in buses for axis_loop in bus.axis_loops]
        self.ticks = Ticks(settings.tick_ms / 1e3)
        self.statistics = TickStatistics()
        self.uptime_s = 0.0
        self.desk = Desk(self)
        self.background = BackgroundServer(self.ticks.period_s)
        self.publishers: list[Publisher] = []
        self.after_tick: Callable[[Tick, float], None] | None = None
        self.output_offset: OutputOffset | None = None
        self.host: Callable[[], RealtimeStatus] | None = None
        self.failure: Exception | None = None
        self.failed_tick: int | None = None
        self.not_disabled: list[str] = []
        self._group = AxisGroup(group_reaction)
        self._ending_ticks: int | None = None
        self._parting_frames = 0
        self._log = structlog.get_logger()
        for axis_loop in self.axis_loops:
            axis_loop.event_log.snapshot = functools.partial(self.snapshot, axis_loop.name)
        self.allow_for_stops()

    def allow_for_stops(self) -> None:
        """Take notice of how long the axes need to stop; for when they have other settings."""
        self.settings = with_time_to_stop(self._stated, (axis_loop.axis.design for axis_loop in self.axis_loops))

    async def run(self) -> None:
        """Run until :meth:`shut_down` has brought the axes to rest; the drives are disabled on every way out.

        Raises
        ------
        Exception
            A defect of this program. If the tick still works, a quick stop has brought the axes to rest before.
        """
        for bus in self.buses:
            bus.start()
        loop = asyncio.get_running_loop()
        now_s = loop.time
        tick_index = 0
        try:
            async for tick in self.ticks:
                tick_index = tick.index
                begun_s = read_s = updated_s = held_s = written_s = self.ticks.begin(tick)
                self.statistics.begin(tick.lateness_s, tick.missed)
                try:
                    self.read(tick)
                    read_s = now_s()
                    self.update()
                    updated_s = now_s()
                    held_s = self._hold(loop, tick, updated_s)
                    self.write(tick)
                    written_s = now_s()
                except Exception as error:  # noqa: BLE001 - raised again when the axes are at rest, or at once
                    self._fail(tick, error, in_control=True)
                try:
                    self.publish(tick)
                except Exception as error:  # noqa: BLE001 - likewise
                    self._fail(tick, error, in_control=False)
                ended_s = now_s()
                self.statistics.end(begun_s, read_s, updated_s, held_s, written_s, ended_s)
                self._end_at_rest()
                if self.after_tick is not None:
                    try:
                        self.after_tick(tick, ended_s)
                    except Exception as error:  # noqa: BLE001 - likewise
                        self._fail(tick, error, in_control=False)
                self.background.open(tick.deadline_s + self.ticks.period_s - self.ticks.margin_s)
        finally:
            self.background.end()
            try:
                with contextlib.ExitStack() as every_drive:  # a defect at one drive is not in the way of the others
                    for axis_loop in self.axis_loops:
                        every_drive.callback(axis_loop.disable_drive, tick_index)
                self.not_disabled = [one.name for one in self.axis_loops if one.tell_if_not_disabled()]
            finally:
                await asyncio.gather(*(bus.close() for bus in self.buses))
        if self.failure is not None:
            raise self.failure

    def shut_down(self) -> None:
        """Bring the axes to rest, disable the drives, and end the loop.

        They are told to disable within the shutdown time-out at the latest, and then have their own time to report it
        (``axis.arming_timeout_ms``).
        """
        if self._ending_ticks is None:
            self._ending_ticks = round(self.settings.shutdown_timeout_ms / self.settings.tick_ms)
            self._log.info("ending", states={axis_loop.name: axis_loop.axis.state for axis_loop in self.axis_loops})
            for axis_loop in self.axis_loops:
                axis_loop.axis.disarm("the service ends")

    @property
    def is_ending(self) -> bool:
        """Whether :meth:`shut_down` has been called."""
        return self._ending_ticks is not None

    # The tick --------------------------------------------------------------------------------------------------------

    def read(self, tick: Tick) -> None:
        """Drain every bus; the newest feedback of each drive goes to its axis."""
        self.uptime_s = tick.index * self.ticks.period_s
        for axis_loop in self.axis_loops:
            axis_loop.begin_tick(tick)
        for bus in self.buses:
            bus.read(tick)

    def update(self) -> None:
        """Let each axis decide on its effort, and all of them react if one has tripped; make the commands ready."""
        if self._ending_ticks is not None:
            self._end_braking(self._ending_ticks)
        for axis_loop in self.axis_loops:
            axis_loop.update()
        self._group.react(self.axis_loops)
        for axis_loop in self.axis_loops:
            axis_loop.make_ready()

    def write(self, tick: Tick) -> None:
        """Send the newest commands; one that its bus cannot take now is dropped, never kept."""
        for axis_loop in self.axis_loops:
            axis_loop.write(tick)

    def publish(self, tick: Tick) -> None:
        """Record the tick and tell whoever listens; none of it waits."""
        for axis_loop in self.axis_loops:
            axis_loop.publish(tick)
        for bus in self.buses:
            bus.publish(tick)
        for publisher in self.publishers:
            publisher(tick)

    # Requests --------------------------------------------------------------------------------------------------------

    def handle(self, request: Request, client: str = "this process") -> dict[str, Any]:
        """Carry out a request of a client; see :meth:`Desk.handle`."""
        return self.desk.handle(request, client)

    def status(self, name: str | None = None) -> Status:
        """Return the state of the service and of all axes, or of the one that is named.

        Raises
        ------
        KeyError
            If no axis has this name.
        """
        axis_loops = self.axis_loops if name is None else [self.axis_loop(name)]
        return Status(report_service(self), {axis_loop.name: axis_loop.report() for axis_loop in axis_loops})

    def snapshot(self, name: str | None = None) -> JsonObject:
        """Return the same ready for JSON; see :meth:`Status.to_json`."""
        return self.status(name).to_json()

    def axis_loop(self, name: str | None = None) -> AxisLoop:
        """Return the axis of a name; without one, the only axis.

        Raises
        ------
        KeyError
            If there is none of this name, or no name and several axes.
        """
        if name is None and len(self.axis_loops) == 1:
            return self.axis_loops[0]
        return next((axis_loop for axis_loop in self.axis_loops if axis_loop.name == name), None) or _no_axis_loop(name)

    # Small parts -----------------------------------------------------------------------------------------------------

    def _hold(self, loop: asyncio.AbstractEventLoop, tick: Tick, ready_s: float) -> float:
        """Let the time at which the commands shall leave come; return the loop's time then."""
        offset = self.output_offset
        if offset is None:
            return ready_s
        send_s = tick.deadline_s + offset.offset_s
        offset.learn(ready_s - tick.deadline_s)
        return ready_s if ready_s >= send_s else busy_wait(loop, send_s)

    def _end_braking(self, ticks_left: int) -> None:
        self._ending_ticks = ticks_left - 1
        for axis_loop in self.axis_loops:
            axis = axis_loop.axis
            axis.disarm()
            if self._ending_ticks <= 0 and axis.state in BRAKING:
                self._tell_if_it_coasts(axis_loop)
                axis.end_braking()

    def _tell_if_it_coasts(self, axis_loop: AxisLoop) -> None:
        velocity = axis_loop.axis.estimate.velocity
        if abs(velocity) > axis_loop.axis.design.rest_velocity:
            self._log.error(
                "the drive is disabled while the axis moves: the time to brake at the end of the service is over",
                axis=axis_loop.name,
                velocity=velocity,
                shutdown_timeout_ms=self.settings.shutdown_timeout_ms,
            )

    def _end_at_rest(self) -> None:
        if self._ending_ticks is not None and all(axis_loop.axis.state not in ENABLED for axis_loop in self.axis_loops):
            self._parting_frames += 1
            # Each drive has its time to report that it is off: what was not seen is told, not taken for granted.
            waits = any(axis_loop.axis.is_disabling for axis_loop in self.axis_loops)
            if self._parting_frames >= _PARTING_FRAMES and not waits:
                self.ticks.stop()

    def fail(self, error: Exception) -> None:
        """Take notice of a defect outside the tick: quick stop, then the service ends with it."""
        self._fail(None, error, in_control=False)

    def _fail(self, tick: Tick | None, error: Exception, *, in_control: bool) -> None:
        """Quick stop at the first defect; a second one in what controls the axes ends the loop at once."""
        if tick is not None:
            self.failed_tick = tick.index
        if self.failure is not None:
            if in_control:
                raise self.failure
            return
        self.failure = error
        self._log.critical("the loop failed, the axes are being stopped", exc_info=error)
        for axis_loop in self.axis_loops:
            axis_loop.axis.raise_trip(TripCode.INTERNAL_ERROR, f"{type(error).__name__} in the loop: {error}")
        self.shut_down()


def _no_axis_loop(name: str | None) -> AxisLoop:
    raise KeyError(name)
