"""The running service, its drives, its bus and its clients in simulated time, each of which can be made to fail."""

import asyncio
import functools
import math
import tempfile
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from twostage_servo.app.closed_loop import SERVICE, ClosedLoop, HeldTicks, Wires, closed_loop
from twostage_servo.axis.axis import Axis
from twostage_servo.canbus.link import BusSettings
from twostage_servo.config.loader import Config, LoadedConfig
from twostage_servo.config.machine import Machine
from twostage_servo.faults.clients import Clients
from twostage_servo.faults.companion import Companions
from twostage_servo.faults.defects import DefectiveService, Defects
from twostage_servo.timing.ticks import Tick

if TYPE_CHECKING:
    from twostage_servo.service.log import LogWriter

__all__ = ["DRIVE", "SERVICE", "Sample", "World", "operate"]

DRIVE = "drive"
"""Name of the node of the drive that has the fault; that of the service is :data:`SERVICE`."""

_BUS = BusSettings(interface="socketcan", channel="can0", reopen_interval_ms=50.0)
"""What the simulated bus stands for: its error frames are those of Linux' SocketCAN."""


class Sample(NamedTuple):
    """The true axis and what the service did, at one tick; axis unit, axis unit/s, effort unit, s."""

    time_s: float
    position: float
    velocity: float
    effort: float
    state: str


class World:
    """One axis in operation, with the others of its machine. Made by :func:`operate`.

    Attributes
    ----------
    loop
        All of it.
    service, requests, axis_loop, drive, node, wire, wires, ticks
        The parts, each with its own ways to fail; axis_loop and drive are those of the axis that has the fault.
    companions
        The other axes of the machine.
    simulation
        The true drive's settings.
    clients
        Those who ask something of the service.
    samples, keeps_samples
        The true axis, a sample a tick; and whether they are kept.
    serving
        The service's task.
    start, target, velocity
        The move that is under way or next, in axis unit and axis unit/s.
    wrap_in
        How far ahead the encoder shall wrap, in axis unit.
    fault_s
        When the fault began, in s.
    begun_s, fault_place
        When the fault, or the last move after it, began, in s, and where the axis was then, in axis unit.
    undisturbed
        The samples of the same run without the fault; the same as `samples` up to it.
    refusals
        Answers to what clients have asked: the code of each refusal, None for what was carried out.
    held
        What a fault has taken from the process, and gives back when the world ends at the latest.
    log
        A log that stands in for the usual one, with a reader that stands still until `log_released` is set.
    defects
        Which part of a tick has a defect.
    """

    def __init__(self, loop: ClosedLoop, wires: Wires, ticks: HeldTicks, defects: Defects, axis_name: str) -> None:
        parts = loop.parts
        self.loop = loop
        self.wires = wires
        self.wire = wires.wire(parts.axis_loop(axis_name).bus.link.settings)
        self.service, self.requests = loop.service, loop.requests
        self.axis_loop = parts.axis_loop(axis_name)
        self.simulation = parts.machine.axis(axis_name).config.simulation
        self.ticks, self.defects = ticks, defects
        self.drive, self.node = loop.axes[axis_name].drive, loop.axes[axis_name].node
        self.companions = Companions(loop, axis_name, self.until)
        self.clients = Clients(loop, axis_name, lambda: self.folder)
        self.samples: list[Sample] = []
        self.keeps_samples = True
        self.serving = loop.serving
        self.start = self.target = self.velocity = 0.0
        self.wrap_in = 0.0
        self.fault_s = self.begun_s = 0.0
        self.fault_place = 0.0
        self.undisturbed: Sequence[Sample] = ()
        self.refusals: list[str | None] = []
        self.log: LogWriter | None = None
        self.log_released = threading.Event()
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.held = ExitStack()
        self._waiting: tuple[Callable[[], bool], asyncio.Future[bool], float] | None = None
        loop.listen(self._on_tick)
        self.serving.add_done_callback(self.look_without_ticks)

    @property
    def axis(self) -> Axis:
        """The axis that has the fault."""
        return self.axis_loop.axis

    @property
    def now_s(self) -> float:
        """The simulated time in s."""
        return asyncio.get_running_loop().time()

    @property
    def period_s(self) -> float:
        """The tick in s."""
        return self.ticks.period_s

    def change(self, **faults: Any) -> None:
        """Let faults of the drive begin or end now; see :class:`~twostage_servo.simulation.faults.DriveFaults`."""
        self.drive.change(self.now_s, **faults)

    @property
    def heading(self) -> float:
        """The direction in which the axis moves, or will: 1 or -1."""
        return math.copysign(1.0, self.target - self.start)

    def plan(self, start: float, target: float, velocity: float) -> None:
        """Have a move before it: axis unit and axis unit/s."""
        self.start, self.target, self.velocity = start, target, velocity

    def plan_wrap(self, wrap_in: float) -> None:
        """Let the encoder wrap so far ahead, in axis unit."""
        self.wrap_in = wrap_in

    def aim(self, target: float) -> None:
        """Have another set-point, in axis unit, before it."""
        self.target = target

    def turn_back(self) -> None:
        """Have the way back before it."""
        self.start, self.target = self.target, self.start

    def begin_fault(self, now_s: float, place: float, undisturbed: Sequence[Sample]) -> None:
        """Record when (s) and where (axis unit) the fault begins, and the samples of the run without it."""
        self.fault_s = now_s
        self.undisturbed = undisturbed
        self.begin_travel(now_s, place)

    def begin_travel(self, now_s: float, place: float) -> None:
        """Record when (s) and where (axis unit) the travel that counts begins."""
        self.begun_s, self.fault_place = now_s, place

    def use_log(self, log: "LogWriter") -> None:
        """Have a log in place of the usual one, until the world ends."""
        self.log = log

    def keep_no_samples(self) -> None:
        """Keep no samples from here on."""
        self.keeps_samples = False

    def place(self) -> float:
        """Return the true position at this very moment, in axis unit."""
        self.change()
        return self.drive.position

    def later(self, delay_s: float, act: Callable[[], object]) -> None:
        """Do something after a simulated time in s."""
        asyncio.get_running_loop().call_later(delay_s, act)

    @property
    def folder(self) -> Path:
        """A folder for files of this world, which goes with it."""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="twostage-servo-")
        return Path(self._folder.name)

    def look_without_ticks(self, *_: object) -> None:
        """Look, once a period, whether what is waited for has come, after the service has ended."""
        self._look()
        if self._waiting is not None and not self._waiting[1].done():
            self.later(self.period_s, self.look_without_ticks)

    async def close(self) -> None:
        """End the clients, and let the log's reader go on."""
        self.held.close()
        await self.clients.close()
        if self._folder is not None:
            self._folder.cleanup()
        self.log_released.set()
        if self.log is not None:
            self.log.close()

    async def until(self, condition: Callable[[], bool], longest_s: float) -> bool:
        """Wait, tick by tick, until a condition holds, for a simulated time in s at most; return whether it does."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[bool] = loop.create_future()
        self._waiting = (condition, future, loop.time() + longest_s)
        # A service that is held up makes no ticks, and one that has ended makes none any more.
        if self.serving.done():
            loop.call_soon(self.look_without_ticks)

        def give_up() -> None:
            if not future.done():
                future.set_result(condition())

        timer = loop.call_later(longest_s + 1.0, give_up)
        try:
            return await future
        finally:
            timer.cancel()
            self._waiting = None

    async def seconds(self, duration_s: float) -> None:
        """Let simulated time pass."""
        await asyncio.sleep(duration_s)

    def record_sample(self) -> None:
        """Record a sample of this moment."""
        place, effort = self.place(), self.axis_loop.command.effort
        self.samples.append(Sample(self.now_s, place, self.drive.velocity, effort, str(self.axis.state)))

    def _on_tick(self, _: Tick) -> None:
        if self.keeps_samples:
            self.record_sample()
        self._look()

    def _look(self) -> None:
        if self._waiting is not None:
            condition, future, deadline_s = self._waiting
            if not future.done() and (condition() or self.now_s >= deadline_s):
                future.set_result(condition())


async def _read_nothing() -> Callable[[], None]:
    """Stand in for a configuration that was read again: it has not changed."""
    return lambda: None


@asynccontextmanager
async def operate(machine: Machine | LoadedConfig[Config], axis_name: str | None = None) -> AsyncIterator[World]:
    """Run service and drives on the running loop, which has to be in simulated time, until the block ends.

    Parameters
    ----------
    machine
        What runs, or the configuration of its only axis.
    axis_name
        The axis that shall have the fault; None for the first.
    """
    if isinstance(machine, LoadedConfig):
        machine = Machine.of(machine)
    name = axis_name or machine.axes[0].config.axis.name
    bus = _BUS.with_frames_of(machine.axis(name).config.bus)
    wires, ticks, defects = Wires(), HeldTicks(machine.service.tick_ms / 1e3), Defects()
    async with closed_loop(
        machine,
        bus=bus,
        wires=wires,
        sparse=True,
        node_name=lambda axis: DRIVE if axis == name else axis,
        ticks=lambda _: ticks,
        prepare_reload=_read_nothing,
        make_service=functools.partial(DefectiveService, defects),
    ) as loop:
        world = World(loop, wires, ticks, defects, name)
        try:
            yield world
        finally:
            await world.close()
