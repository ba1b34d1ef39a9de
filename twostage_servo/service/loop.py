"""The service: on each tick read the buses, update the axes, write the commands, publish what happened."""

import asyncio
import contextlib
import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import structlog

from twostage_servo.api.requests import Request
from twostage_servo.axis.state import BRAKING, ENABLED
from twostage_servo.axis.trips import TripCode
from twostage_servo.service.desk import Desk
from twostage_servo.service.group import Group, GroupReaction
from twostage_servo.service.port import Port
from twostage_servo.service.settings import ServiceSettings, with_time_to_stop
from twostage_servo.service.snapshot import report_service
from twostage_servo.service.station import Station
from twostage_servo.service.statistics import TickStatistics
from twostage_servo.service.turns import Turns
from twostage_servo.timing.ticks import Tick, Ticks, spin

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
    ports
        The buses with the axes on them.
    group_reaction
        What the other axes do when one trips.

    Attributes
    ----------
    settings
        As given, with the time that the axes take to stop where no `shutdown_timeout_ms` is stated.
    stations
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
        self, settings: ServiceSettings, ports: Sequence[Port], group_reaction: GroupReaction = "stop"
    ) -> None:
        self.settings = self._stated = settings
        self.ports = ports
        self.stations = [station for port in ports for station in port.stations]
        self.ticks = Ticks(settings.tick_ms / 1e3)
        self.statistics = TickStatistics()
        self.uptime_s = 0.0
        self.desk = Desk(self)
        self.turns = Turns(self.ticks.period_s)
        self.publishers: list[Publisher] = []
        self.after_tick: Callable[[Tick, float], None] | None = None
        self.output_offset: OutputOffset | None = None
        self.host: Callable[[], dict[str, Any]] | None = None
        self.failure: Exception | None = None
        self.failed_tick: int | None = None
        self.not_disabled: list[str] = []
        self._group = Group(group_reaction)
        self._ending_ticks: int | None = None
        self._parting_frames = 0
        self._log = structlog.get_logger()
        for station in self.stations:
            station.reporter.snapshot = functools.partial(self.snapshot, station.name)
        self.allow_for_stops()

    def allow_for_stops(self) -> None:
        """Take notice of how long the axes need to stop; for when they have other settings."""
        self.settings = with_time_to_stop(self._stated, (station.axis.design for station in self.stations))

    async def run(self) -> None:
        """Run until :meth:`shut_down` has brought the axes to rest; the drives are disabled on every way out.

        Raises
        ------
        Exception
            A defect of this program. If the tick still works, a quick stop has brought the axes to rest before.
        """
        for port in self.ports:
            port.start()
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
                self.turns.open(tick.deadline_s + self.ticks.period_s - self.ticks.margin_s)
        finally:
            self.turns.end()
            try:
                with contextlib.ExitStack() as every_drive:  # a defect at one drive is not in the way of the others
                    for station in self.stations:
                        every_drive.callback(station.disable_drive, tick_index)
                self.not_disabled = [station.name for station in self.stations if station.tell_if_not_disabled()]
            finally:
                await asyncio.gather(*(port.close() for port in self.ports))
        if self.failure is not None:
            raise self.failure

    def shut_down(self) -> None:
        """Bring the axes to rest, disable the drives, and end the loop.

        They are told to disable within the shutdown time-out at the latest, and then have their own time to report it
        (``axis.arming_timeout_ms``).
        """
        if self._ending_ticks is None:
            self._ending_ticks = round(self.settings.shutdown_timeout_ms / self.settings.tick_ms)
            self._log.info("ending", states={station.name: station.axis.state for station in self.stations})
            for station in self.stations:
                station.axis.disarm("the service ends")

    @property
    def is_ending(self) -> bool:
        """Whether :meth:`shut_down` has been called."""
        return self._ending_ticks is not None

    # The tick --------------------------------------------------------------------------------------------------------

    def read(self, tick: Tick) -> None:
        """Drain every bus; the newest feedback of each drive goes to its axis."""
        self.uptime_s = tick.index * self.ticks.period_s
        for station in self.stations:
            station.begin_tick(tick)
        for port in self.ports:
            port.read(tick)

    def update(self) -> None:
        """Let each axis decide on its effort, and all of them react if one has tripped; make the commands ready."""
        if self._ending_ticks is not None:
            self._end_braking(self._ending_ticks)
        for station in self.stations:
            station.update()
        self._group.react(self.stations)
        for station in self.stations:
            station.make_ready()

    def write(self, tick: Tick) -> None:
        """Send the newest commands; one that its bus cannot take now is dropped, never kept."""
        for station in self.stations:
            station.write(tick)

    def publish(self, tick: Tick) -> None:
        """Record the tick and tell whoever listens; none of it waits."""
        for station in self.stations:
            station.publish(tick)
        for port in self.ports:
            port.publish(tick)
        for publisher in self.publishers:
            publisher(tick)

    # Requests --------------------------------------------------------------------------------------------------------

    def handle(self, request: Request, client: str = "this process") -> dict[str, Any]:
        """Carry out a request of a client; see :meth:`Desk.handle`."""
        return self.desk.handle(request, client)

    def snapshot(self, name: str | None = None, common: dict[str, Any] | None = None) -> dict[str, Any]:
        """Return the state of service and axes, ready for JSON.

        The reports of the axes stand under ``axes``, by their names; that of the only axis, or of the one that is
        named, stands beside what all have in common. That may be given, from :func:`report_service`, by whoever asks
        for several axes in one tick.

        Raises
        ------
        KeyError
            If no axis has this name.
        """
        common = report_service(self) if common is None else common
        if name is None and len(self.stations) > 1:
            return common | {"axes": {station.name: station.report() for station in self.stations}}
        return common | self.station(name).report()

    def station(self, name: str | None = None) -> Station:
        """Return the axis of a name; without one, the only axis.

        Raises
        ------
        KeyError
            If there is none of this name, or no name and several axes.
        """
        if name is None and len(self.stations) == 1:
            return self.stations[0]
        return next((station for station in self.stations if station.name == name), None) or _no_station(name)

    # Small parts -----------------------------------------------------------------------------------------------------

    def _hold(self, loop: asyncio.AbstractEventLoop, tick: Tick, ready_s: float) -> float:
        """Let the time at which the commands shall leave come; return the loop's time then."""
        offset = self.output_offset
        if offset is None:
            return ready_s
        send_s = tick.deadline_s + offset.offset_s
        offset.learn(ready_s - tick.deadline_s)
        return ready_s if ready_s >= send_s else spin(loop, send_s)

    def _end_braking(self, ticks_left: int) -> None:
        self._ending_ticks = ticks_left - 1
        for station in self.stations:
            axis = station.axis
            axis.disarm()
            if self._ending_ticks <= 0 and axis.state in BRAKING:
                self._tell_if_it_coasts(station)
                axis.end_braking()

    def _tell_if_it_coasts(self, station: Station) -> None:
        velocity = station.axis.estimate.velocity
        if abs(velocity) > station.axis.design.rest_velocity:
            self._log.error(
                "the drive is disabled while the axis moves: the time to brake at the end of the service is over",
                axis=station.name,
                velocity=velocity,
                shutdown_timeout_ms=self.settings.shutdown_timeout_ms,
            )

    def _end_at_rest(self) -> None:
        if self._ending_ticks is not None and all(station.axis.state not in ENABLED for station in self.stations):
            self._parting_frames += 1
            # Each drive has its time to report that it is off: what was not seen is told, not taken for granted.
            waits = any(station.axis.is_disabling for station in self.stations)
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
        for station in self.stations:
            station.axis.raise_trip(TripCode.INTERNAL_ERROR, f"{type(error).__name__} in the loop: {error}")
        self.shut_down()


def _no_station(name: str | None) -> Station:
    raise KeyError(name)
