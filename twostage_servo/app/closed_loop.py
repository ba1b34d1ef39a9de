"""The closed loop: the service, its simulated drives and what lies between them, in simulated or in real time.

There is one, whoever needs it: the demo, the fault campaign, the soaks, the fuzzing, the benchmark and the tests.
"""

import asyncio
import functools
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AbstractContextManager, asynccontextmanager, nullcontext
from dataclasses import dataclass
from typing import Final

import can

from twostage_servo.app.assembly import drive_side
from twostage_servo.app.build import Parts, build_parts
from twostage_servo.app.punctual import punctual
from twostage_servo.app.service_harness import ServiceHarness
from twostage_servo.canbus.link import BusSettings, Link
from twostage_servo.config.loader import Config, LoadedConfig
from twostage_servo.config.machine import Machine
from twostage_servo.host.settings import RealtimeSettings
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.bus_connection import FrameObserver
from twostage_servo.service.reload import Change
from twostage_servo.service.runtime import Runtime
from twostage_servo.service.servo_service import Publisher, ServoService
from twostage_servo.simulation.bus import Wire
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.simulation.node import DriveNode
from twostage_servo.timing.ticks import Tick, Ticks

SERVICE: Final = "service"
"""Name of the service's node on each wire."""


class HeldTicks(Ticks):
    """Ticks that a busy host serves late, see :meth:`hold_up`."""

    __slots__ = ("_hold",)

    def __init__(self, period_s: float) -> None:
        super().__init__(period_s)
        self._hold: Callable[[], float] | None = None

    def hold_up(self, hold: Callable[[], float]) -> None:
        """Let a function give the time in s by which the next tick is held up, from now on."""
        self._hold = hold

    async def __anext__(self) -> Tick:
        """Wait for the next deadline, and for the host."""
        held_s = self._hold() if self._hold is not None else 0.0
        if held_s > 0.0 and self._start_s is not None:
            loop = asyncio.get_running_loop()
            await asyncio.sleep(self._start_s + (self._index + 1) * self.period_s - loop.time() + held_s)
        return await super().__anext__()


class Wires:
    """A simulated wire for each bus of a machine.

    Parameters
    ----------
    opener
        Opens the service's end of a wire; by default it is attached to it.

    Attributes
    ----------
    wall_offset_s
        How far the clock that stamps the frames has been set, in s.
    """

    def __init__(self, opener: Callable[[Wire], can.BusABC] | None = None) -> None:
        self.wall_offset_s = 0.0
        self._opener = opener
        self._wires: dict[tuple[str, str | int], Wire] = {}

    def shift_wall_clock(self, by_s: float) -> None:
        """Set the clock that stamps the frames forwards by a time in s, or back if it is negative."""
        self.wall_offset_s += by_s
        for wire in self._wires.values():
            wire.clock_was_set(by_s)

    def wire(self, bus: BusSettings) -> Wire:
        """Return the wire that stands for a bus; it is made when it is new."""
        key = bus.interface, bus.channel
        if key not in self._wires:
            clock = asyncio.get_running_loop().time
            self._wires[key] = Wire(lambda: clock() + self.wall_offset_s)
        return self._wires[key]

    def open_for_service(self, bus: BusSettings) -> can.BusABC:
        """Open the service's end."""
        wire = self.wire(bus)
        return wire.attach(SERVICE) if self._opener is None else self._opener(wire)


@dataclass(frozen=True, slots=True)
class SimulatedAxis:
    """An axis with its simulated drive.

    Attributes
    ----------
    axis_loop
        The axis in its service.
    drive, node
        Its drive, and what runs it on its bus.
    """

    axis_loop: AxisLoop
    drive: SimulatedDrive
    node: DriveNode


class ClosedLoop:
    """A service that runs, with its drives. Made, and ended, by :func:`closed_loop`.

    Parameters
    ----------
    harness
        The service.
    axes
        The axes with their drives, by the axes' names.
    wires
        What joins them; None on a bus of python-can.

    Attributes
    ----------
    parts, requests, service, trip_files, listen, axis_loop, snapshot, control_socket
        Those of the harness.
    axes, wires
        As given.
    serving
        The service's task.
    """

    def __init__(self, harness: ServiceHarness, axes: dict[str, SimulatedAxis], wires: Wires | None) -> None:
        self.parts, self.requests, self.service = harness.parts, harness.requests, harness.service
        self.trip_files, self.listen, self.axis_loop = harness.trip_files, harness.listen, harness.axis_loop
        self.snapshot, self.control_socket = harness.snapshot, harness.control_socket
        self.axes = axes
        self.wires = wires
        loop = asyncio.get_running_loop()
        self._driving = [loop.create_task(one.node.run()) for one in axes.values()]
        self.serving = loop.create_task(self.service.run())

    async def end(self) -> None:
        """Bring the axes to rest and end the service, then the drives; a defect of the service is left in its task."""
        self.service.shut_down()
        await asyncio.gather(self.serving, return_exceptions=True)
        for one in self.axes.values():
            one.node.stop()
        await asyncio.gather(*self._driving)


@asynccontextmanager
async def closed_loop(
    machine: Machine | LoadedConfig[Config],
    *,
    bus: BusSettings | None = None,
    wires: Wires | None = None,
    sparse: bool = False,
    node_name: Callable[[str], str] = str,
    ticks: Callable[[float], Ticks] = Ticks,
    realtime: RealtimeSettings | None = None,
    observers: Sequence[FrameObserver] = (),
    publishers: Sequence[Publisher] = (),
    prepare_reload: Callable[[], Awaitable[Change]] | None = None,
    sign_of_life: Callable[[float], None] | None = None,
    make_service: Callable[..., ServoService] = ServoService,
) -> AsyncIterator[ClosedLoop]:
    """Run a service and a simulated drive for each of its axes on the running loop, until the block ends.

    Parameters
    ----------
    machine
        The configuration, of several axes or of one.
    bus
        A bus to use in place of the configured ones.
    wires
        What stands for the buses; None: the buses of python-can that the settings name.
    sparse
        Whether the drives leave out the cycles of their firmware in which nothing is due; it needs wires.
    node_name
        Gives the name of a drive's node on its wire, from that of its axis.
    ticks
        Makes the ticks, of a period in s.
    realtime
        Makes the service punctual on its host, with ticks of its own; None: it runs in simulated time.
    observers
        Are shown each frame.
    publishers
        Are told of each tick.
    prepare_reload
        Reads the configuration again; None where there is none to read.
    sign_of_life
        Called with the loop's time in s after each completed tick.
    make_service
        Makes the service of what :class:`~twostage_servo.service.servo_service.ServoService` takes.

    Raises
    ------
    ConfigError
        If the parts do not fit together.
    """
    opener = None if wires is None else wires.open_for_service
    parts = build_parts(machine, bus, opener, observers)
    surroundings: AbstractContextManager[Runtime] = nullcontext(
        Runtime(ticks(parts.period_s), sign_of_life=sign_of_life)
    )
    if realtime is not None:
        surroundings = punctual(realtime, parts.axis_loops, parts.period_s, sign_of_life)
    with surroundings as runtime:
        axes = {
            one.config.axis.name: _simulated(one, parts, bus or one.config.bus, wires, node_name, sparse=sparse)
            for one in parts.machine.axes
        }
        loop = ClosedLoop(ServiceHarness(parts, runtime, prepare_reload, publishers, make_service), axes, wires)
        try:
            yield loop
        finally:
            await loop.end()


def _simulated(
    loaded: LoadedConfig[Config],
    parts: Parts,
    bus: BusSettings,
    wires: Wires | None,
    node_name: Callable[[str], str],
    *,
    sparse: bool,
) -> SimulatedAxis:
    axis_loop, settings = parts.axis_loop(loaded.config.axis.name), loaded.config.simulation
    side = drive_side(loaded, axis_loop.drive)
    drive = SimulatedDrive(settings, side, asyncio.get_running_loop().time())
    identifiers, cycle_s = side.identifiers, settings.cycle_ms / 1e3
    if wires is None:
        return SimulatedAxis(axis_loop, drive, DriveNode(drive, Link(bus, identifiers), cycle_s, axis=axis_loop.name))
    name, wire = node_name(axis_loop.name), wires.wire(bus)
    link = Link(bus, identifiers, functools.partial(wire.attach, name))
    if not sparse:
        return SimulatedAxis(axis_loop, drive, DriveNode(drive, link, cycle_s, axis=axis_loop.name))
    at = wire.node(name)
    node = DriveNode(
        drive, link, cycle_s, arrival_s=lambda: at.next_arrival_s - wires.wall_offset_s, axis=axis_loop.name
    )
    at.listen(node.wake)
    return SimulatedAxis(axis_loop, drive, node)
