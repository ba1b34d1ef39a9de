"""The running service, its drives, its bus and its clients in simulated time, each of which can be made to fail."""

import asyncio
import json
import math
import tempfile
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from twostage_servo.api.request_reading import parse_request
from twostage_servo.api.requests import BadRequestError
from twostage_servo.app.closed_loop import SERVICE, ClosedLoop, HeldTicks, Wires, closed_loop
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.canbus.link import BusSettings
from twostage_servo.client.async_connection import AsyncConnection
from twostage_servo.config.loader import Config, LoadedConfig
from twostage_servo.config.machine import Machine
from twostage_servo.faults.companion import Companion
from twostage_servo.timing.ticks import Tick

if TYPE_CHECKING:
    from twostage_servo.service.control_socket import ControlSocket
    from twostage_servo.service.log import LogWriter

__all__ = ["DRIVE", "OPERATOR", "SERVICE", "Sample", "World", "operate"]

DRIVE = "drive"
"""Name of the node of the drive that has the fault; that of the service is :data:`SERVICE`."""

OPERATOR = "operator"
"""The client who commands the axis."""

_LONGEST_ANSWER_S = 30.0
"""How long an answer may take, in simulated time: longer than anything that holds the service up."""

_TO_REST_S = 3.0
"""How long the other axes may take to come to rest."""

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
    companions, fault_reaction
        The other axes of the machine, and what they do when one trips.
    simulation
        The true drive's settings.
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
    """

    def __init__(self, loop: ClosedLoop, wires: Wires, ticks: HeldTicks, axis_name: str) -> None:
        parts = loop.parts
        self.loop = loop
        self.wires = wires
        self.wire = wires.wire(parts.axis_loop(axis_name).bus.link.settings)
        self.service, self.requests = loop.service, loop.requests
        self.fault_reaction = parts.machine.fault_reaction
        self.axis_loop = parts.axis_loop(axis_name)
        self.simulation = parts.machine.axis(axis_name).config.simulation
        self.ticks = ticks
        self.drive, self.node = loop.axes[axis_name].drive, loop.axes[axis_name].node
        self.companions = [
            Companion(one.axis_loop, one.drive, one.node) for name, one in loop.axes.items() if name != axis_name
        ]
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
        self._tasks: set[asyncio.Task[None]] = set()
        self._socket: ControlSocket | None = None
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

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Let a client work beside the service, until it is done or the world ends."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    @asynccontextmanager
    async def client(self) -> AsyncIterator[AsyncConnection]:
        """Connect to the service's control socket as a client that keeps to the protocol.

        Raises
        ------
        ServoError
            If no service answers there.
        """
        await self._serve_clients()
        connection = AsyncConnection(self.socket_path, _LONGEST_ANSWER_S)
        await connection.open(_LONGEST_ANSWER_S)
        try:
            yield connection
        finally:
            connection.close()

    @asynccontextmanager
    async def bad_client(self) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
        """Connect as one who sends what no client of ours does, or does not read; so it has the socket itself."""
        await self._serve_clients()
        reader, writer = await asyncio.open_unix_connection(str(self.socket_path), limit=1 << 20)
        try:
            yield reader, writer
        finally:
            writer.close()

    async def _serve_clients(self) -> None:
        """Serve the control socket, from the first client on."""
        if self._socket is None:
            self._socket = self.loop.control_socket(self.socket_path)
            await self._socket.start()

    @property
    def folder(self) -> Path:
        """A folder for files of this world, which goes with it."""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="twostage-servo-")
        return Path(self._folder.name)

    @property
    def socket_path(self) -> Path:
        """The path of the control socket."""
        return self.folder / "control.sock"

    def look_without_ticks(self, *_: object) -> None:
        """Look, once a period, whether what is waited for has come, after the service has ended."""
        self._look()
        if self._waiting is not None and not self._waiting[1].done():
            self.later(self.period_s, self.look_without_ticks)

    def ask(self, request: str | dict[str, Any], client: str = OPERATOR) -> str | None:
        """Make a request of a client; return the code with which it is refused, or None if it was carried out."""
        line = request if isinstance(request, str) else json.dumps(request)
        if self.companions and '"op": "reload"' not in line:
            line = f'{line.rstrip()[:-1]}, "axis": {json.dumps(self.axis_loop.name)}}}'
        try:
            self.requests.handle(parse_request(line.encode()), client)
        except BadRequestError:
            return RefusalCode.BAD_REQUEST
        except Refused as refused:
            return refused.code
        return None

    async def start_companions(self, longest_s: float) -> None:
        """Arm the other axes and let them jog."""
        for companion in self.companions:
            self.loop.listen(companion.on_tick)
        await self.until(lambda: all(companion.ready for companion in self.companions), longest_s)
        for companion in self.companions:
            companion.begin()
        await self.until(lambda: all(companion.jogs for companion in self.companions), longest_s)

    def forget_companions(self) -> None:
        """Note from here on what the other axes do."""
        for companion in self.companions:
            companion.forget()

    async def companions_complaint(self, *, shared: bool) -> str:
        """Return what the other axes have done wrong; they are given the time to come to rest."""

        def complaints() -> str:
            tripped = self.axis.trip is not None
            each = (one.complaint(self.fault_reaction, tripped=tripped, shared=shared) for one in self.companions)
            return "; ".join(filter(None, each))

        if complaints():
            await self.until(lambda: not complaints(), _TO_REST_S)
        return complaints()

    async def close(self) -> None:
        """End the clients, and let the log's reader go on."""
        self.held.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._socket is not None:
            await self._socket.stop()
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
    wires, ticks = Wires(), HeldTicks(machine.service.tick_ms / 1e3)
    async with closed_loop(
        machine,
        bus=bus,
        wires=wires,
        sparse=True,
        node_name=lambda axis: DRIVE if axis == name else axis,
        ticks=lambda _: ticks,
        prepare_reload=_read_nothing,
    ) as loop:
        world = World(loop, wires, ticks, name)
        try:
            yield world
        finally:
            await world.close()
