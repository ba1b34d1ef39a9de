"""Puts a service together: its parts from a configuration, what carries out requests, and the loop over them."""

import functools
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import can

from twostage_servo.api.fields import JsonObject
from twostage_servo.app.assembly import build_axis, build_drive, cyclic_frames
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.canbus.bus_load import bus_load
from twostage_servo.canbus.link import BusSettings, Link
from twostage_servo.config.loader import Config, LoadedConfig
from twostage_servo.config.machine import Machine
from twostage_servo.drives.drive import Drive
from twostage_servo.service.authority import Authority
from twostage_servo.service.axis_group import AxisGroup
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.background_server import BackgroundServer
from twostage_servo.service.bus_connection import BusConnection, FrameObserver
from twostage_servo.service.disabled_report import DisabledReport
from twostage_servo.service.event_log import EventLog
from twostage_servo.service.reload import Change, Reload
from twostage_servo.service.request_age import RequestAge, no_time_asleep
from twostage_servo.service.request_handler import EraseLearned, RequestHandler
from twostage_servo.service.runtime import Runtime
from twostage_servo.service.servo_service import Publisher, ServoService
from twostage_servo.service.shutdown import Shutdown
from twostage_servo.service.snapshot import StatusReport
from twostage_servo.service.statistics import TickStatistics
from twostage_servo.service.status_lines import StatusLines
from twostage_servo.service.trip_recorder import TripRecorder, TripWriter

if TYPE_CHECKING:
    from twostage_servo.canbus.identifier import Identifier

_ECHOING: Final = frozenset({"udp_multicast"})
"""Interfaces of python-can on which a sender hears its own frames, whatever it asks for."""


@dataclass(frozen=True, slots=True)
class Parts:
    """What a service consists of, beside what surrounds it.

    Attributes
    ----------
    machine
        The configuration.
    buses, axis_loops
        The buses, not yet open, and the axes on them.
    statistics, shutdown, authority
        What the ticks were like; what ends the service; and who commands.
    background
        Serves the clients between the ticks.
    """

    machine: Machine
    buses: tuple[BusConnection, ...]
    axis_loops: tuple[AxisLoop, ...]
    statistics: TickStatistics
    shutdown: Shutdown
    authority: Authority
    background: BackgroundServer

    @property
    def period_s(self) -> float:
        """Length of a tick in s."""
        return self.machine.service.tick_ms / 1e3

    @property
    def names(self) -> list[str]:
        """The names of the axes."""
        return [axis_loop.name for axis_loop in self.axis_loops]

    def axis_loop(self, name: str | None = None) -> AxisLoop:
        """Return the axis of a name; without one, the only axis.

        Raises
        ------
        KeyError
            If there is none of this name, or no name and several axes.
        """
        if name is None and len(self.axis_loops) == 1:
            return self.axis_loops[0]
        for axis_loop in self.axis_loops:
            if axis_loop.name == name:
                return axis_loop
        raise KeyError(name)


def build_parts(
    machine: Machine | LoadedConfig[Config],
    bus: BusSettings | None = None,
    opener: Callable[[BusSettings], can.BusABC] | None = None,
    observers: Sequence[FrameObserver] = (),
) -> Parts:
    """Return the parts of the service that a configuration describes.

    Parameters
    ----------
    machine
        The configuration, of several axes or of one.
    bus
        A bus to use in place of the configured ones.
    opener
        What makes the bus of these settings, in place of python-can: a simulated one.
    observers
        Are shown each frame.

    Raises
    ------
    ConfigError
        If the parts do not fit together.
    """
    if isinstance(machine, LoadedConfig):
        machine = Machine.of(machine)
    tick_s = machine.service.tick_ms / 1e3
    members: dict[tuple[str, str | int], list[_Member]] = {}
    for loaded in machine.axes:
        on = bus or loaded.config.bus
        drive = build_drive(loaded)
        member = _Member(loaded, drive, build_axis(loaded, drive.traits, tick_s))
        members.setdefault((on.interface, on.channel), []).append(member)
    buses: list[BusConnection] = []
    axis_loops: list[AxisLoop] = []
    for on_bus in members.values():
        connection = BusConnection(_build_link(on_bus, bus, opener, tick_s), tick_s, observers)
        buses.append(connection)
        recording_s = machine.service.recording_s
        axis_loops += [AxisLoop(one.axis, one.drive, connection, tick_s, recording_s) for one in on_bus]
    shutdown = Shutdown(machine.service, axis_loops)
    return Parts(
        machine,
        tuple(buses),
        tuple(axis_loops),
        TickStatistics(),
        shutdown,
        Authority(),
        BackgroundServer(tick_s),
    )


def build_requests(
    parts: Parts,
    runtime: Runtime,
    prepare_reload: Callable[[], Awaitable[Change]] | None = None,
    asleep_s: Callable[[], float] = no_time_asleep,
    erase_learned: EraseLearned | None = None,
) -> RequestHandler:
    """Return what carries out the requests of clients.

    Parameters
    ----------
    parts, runtime
        The service.
    prepare_reload
        Reads the configuration again, outside the loop; None where there is none to read.
    asleep_s
        Tells how long the machine has slept, s, for the age of requests.
    erase_learned
        Erases the files of what the laws of some axes have learned; None where there are none.
    """
    report = StatusReport(parts.axis_loops, parts.statistics, parts.authority, runtime.report)
    return RequestHandler(
        parts.axis_loops,
        StatusLines(report),
        parts.authority,
        parts.shutdown,
        Reload(parts.axis_loops, prepare_reload),
        RequestAge(parts.period_s, asleep_s),
        parts.machine.service.holder_lost,
        erase_learned,
    )


def build_service(
    parts: Parts,
    runtime: Runtime,
    snapshot: Callable[[AxisLoop], JsonObject],
    trip_files: TripWriter | None = None,
    publishers: Sequence[Publisher] = (),
    make_service: Callable[..., ServoService] = ServoService,
) -> ServoService:
    """Return the service, its buses not yet open.

    Parameters
    ----------
    parts, runtime
        What it consists of, and what surrounds it.
    snapshot
        Makes what a trip's file says of an axis.
    trip_files
        Writes them; None: the recordings of trips stay in memory only.
    publishers
        Are told of each tick, beside the log and the recorders of trips.
    make_service
        Makes the service of what :class:`~twostage_servo.service.servo_service.ServoService` takes.
    """
    own: list[Publisher] = []
    for axis_loop in parts.axis_loops:
        own += [
            EventLog(axis_loop).publish,
            DisabledReport(axis_loop).publish,
            TripRecorder(axis_loop, snapshot, trip_files).publish,
        ]
    return make_service(
        parts.buses,
        parts.axis_loops,
        AxisGroup(parts.machine.fault_reaction),
        parts.shutdown,
        parts.statistics,
        replace(runtime, idle=(*runtime.idle, parts.background)),
        (*own, *publishers),
    )


class _Member(NamedTuple):
    """An axis on a bus."""

    loaded: LoadedConfig[Config]
    drive: Drive
    axis: Axis

    @property
    def name(self) -> str:
        """The axis' name."""
        return self.axis.settings.name


def _build_link(
    members: list[_Member],
    bus: BusSettings | None,
    opener: Callable[[BusSettings], can.BusABC] | None,
    tick_s: float,
) -> Link:
    settings = bus or members[0].loaded.config.bus
    owners: dict[int, str] = {}
    heard: list[Identifier] = []
    for loaded, drive, axis in members:
        for identifier in drive.decoders:
            if identifier.identifier in owners:
                raise loaded.problem(
                    ("protocol",),
                    f"{owners[identifier.identifier]} also uses identifier {identifier} on this bus: give each "
                    "drive its own (protocol.identifier_offset, or another DBC)",
                )
            owners[identifier.identifier] = f"axis {axis.settings.name} ({loaded.source})"
        # What the drive obeys only somebody else can have sent, where the bus does not bring our own frames back.
        echoed = drive.obeyed if settings.interface in _ECHOING else ()
        heard += [identifier for identifier in drive.decoders if identifier not in echoed]
    _check_load(settings, members, tick_s)
    return Link(settings, heard, functools.partial(opener, settings) if opener is not None else None)


def _check_load(settings: BusSettings, members: list[_Member], tick_s: float) -> None:
    if settings.bitrate is None:
        return
    frames = [frame for one in members for frame in cyclic_frames(one.loaded, one.drive, tick_s)]
    load = bus_load(frames, settings.bitrate)
    if load > 1.0:
        names = ", ".join(one.name for one in members)
        raise members[0].loaded.problem(
            ("bus", "bitrate"),
            f"the bus cannot carry it: the frames of {names} on a tick of {1e3 * tick_s:g} ms take up to "
            f"{100.0 * load:.3g} % of {settings.bitrate / 1e3:g} kbit/s; raise the bit rate or service.tick_ms, or use "
            "another bus for some of the axes",
        )


def traits_of(axis_loops: Sequence[AxisLoop]) -> dict[str, DriveTraits]:
    """Return what axes have to know of their drives, by their names."""
    return {axis_loop.name: axis_loop.drive.traits for axis_loop in axis_loops}


def replace_axes(parts: Parts, axes: Sequence[Axis]) -> None:
    """Put axes in the place of a disarmed service's own, in whose order they are; they know what those knew."""
    for axis_loop, axis in zip(parts.axis_loops, axes, strict=True):
        axis_loop.replace_axis(axis)
    parts.shutdown.allow_for_stops()
