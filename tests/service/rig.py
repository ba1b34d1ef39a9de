"""The real service and the real drive node on a simulated bus, in simulated time."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import can

from twostage_servo.api.requests import ReloadRequest
from twostage_servo.app.build import Parts
from twostage_servo.app.closed_loop import ClosedLoop, Wires, closed_loop
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.messages import Command
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import State
from twostage_servo.canbus.link import BusSettings
from twostage_servo.config.loader import load
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.faults.frames import profile_of
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.reload import Change
from twostage_servo.service.request_handler import RequestHandler
from twostage_servo.service.servo_service import ServoService
from twostage_servo.service.snapshot import report_axis
from twostage_servo.service.status_line import StatusLine, status_line
from twostage_servo.simulation.bus import Wire
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.timing.ticks import Tick, Ticks
from twostage_servo.timing.virtual_clock import run

BUS = BusSettings(interface="socketcan", channel="can0")
"""What the simulated bus stands for."""

_Result = TypeVar("_Result")


class BusyTicks(Ticks):
    """Ticks on a busy host: the next one is held up for so many seconds, before its deadline or after it."""

    __slots__ = ("hold_s", "late_s")

    def __init__(self, period_s: float) -> None:
        super().__init__(period_s)
        self.hold_s = self.late_s = 0.0

    async def __anext__(self) -> Tick:
        hold_s, self.hold_s = self.hold_s, 0.0
        if hold_s:
            await asyncio.sleep(hold_s)
        tick = await super().__anext__()
        late_s, self.late_s = self.late_s, 0.0
        if late_s:
            await asyncio.sleep(late_s)
        return tick


class World:
    """What a script can look at and act on.

    Attributes
    ----------
    trace
        Each frame of the service: tick, `sent` or `received`, identifier, data.
    sign_of_life
        Called after each completed tick.
    prepare
        Reads the configuration again, for `reload`.
    """

    def __init__(self, trace: "list[tuple[int, str, int, bytes]]") -> None:
        self.loop: ClosedLoop
        self.wire: Wire
        self.ticks: BusyTicks
        self.trace = trace
        self.sign_of_life: Callable[[float], None] = lambda _: None
        self.prepare: Callable[[], Awaitable[Change]] | None = None

    @property
    def service(self) -> ServoService:
        return self.loop.service

    @property
    def requests(self) -> RequestHandler:
        return self.loop.requests

    @property
    def axis_loop(self) -> AxisLoop:
        return self.loop.axis_loop()

    @property
    def drive(self) -> SimulatedDrive:
        return self.loop.axes[self.axis_loop.name].drive

    @property
    def serving(self) -> "asyncio.Task[None]":
        return self.loop.serving

    def completed(self, now_s: float) -> None:
        self.sign_of_life(now_s)

    async def prepare_reload(self) -> Change:
        if self.prepare is None:
            raise Refused(
                RefusalCode.NO_CONFIGURATION,
                "this service runs on settings that are in no file: there is nothing to reload.",
            )
        return await self.prepare()

    @property
    def parts(self) -> Parts:
        return self.loop.parts

    def line(self, missed: int = 0) -> str:
        """The line for the service manager."""
        return status_line(self.service.axis_loops, missed, is_ending=self.service.shutdown.is_ending)

    def status_line(self, show: Callable[[str], bool]) -> StatusLine:
        parts = self.parts
        return StatusLine(parts.axis_loops, parts.statistics, parts.shutdown, parts.period_s, show)

    @property
    def report(self) -> dict[str, Any]:
        """The report of the axis."""
        return report_axis(self.axis_loop).to_json()

    async def reload(self, client: str = "this process") -> dict[str, Any]:
        """Let the service read its configuration again."""
        await self.requests.prepare_reload(client)
        return self.requests.handle(ReloadRequest(), client)

    @property
    def axis(self) -> Axis:
        return self.axis_loop.axis

    @property
    def profile(self) -> DriveProfile:
        """The compiled frames of the drive."""
        return profile_of(self.axis_loop.drive)

    def hear(self, message: can.Message) -> None:
        """Let a frame come in, as if it had just been read."""
        self.axis_loop.bus._receivers[message.arbitration_id](message)

    def state(self) -> State:
        return self.axis.state

    def sent(self) -> list[tuple[int, Command]]:
        """The commands as they stood on the bus, each with its tick."""
        profile = self.profile
        return [
            (tick, profile.decode_command(can.Message(arbitration_id=identifier, is_extended_id=False, data=data)))
            for tick, direction, identifier, data in self.trace
            if direction == "sent"
        ]

    async def seconds(self, duration_s: float) -> None:
        """Let simulated time pass; no real time does."""
        await asyncio.sleep(duration_s)

    async def until(self, condition: Callable[[], bool], longest_s: float = 30.0) -> None:
        for _ in range(round(longest_s / 0.01)):
            if condition():
                return
            await asyncio.sleep(0.01)
        raise AssertionError(f"did not come true within {longest_s} s of simulated time; the axis is {self.axis.state}")

    async def armed(self) -> "World":
        await self.until(lambda: self.axis.ready_to_arm)
        self.axis.arm()
        await self.until(lambda: self.axis.state is State.HOLDING)
        return self

    async def cruising(self, target: float = 400.0, velocity: float = 100.0) -> "World":
        await self.armed()
        self.axis.move_to(target, velocity)
        await self.seconds(1.5)
        assert self.state() is State.SPEED_STAGE
        return self


def simulate(
    script: Callable[[World], Awaitable[_Result]],
    *overrides: str,
    bus: BusSettings = BUS,
    opener: Callable[[Wire], can.BusABC] = lambda wire: wire.attach("service"),
) -> _Result:
    """Run service and drive in simulated time until the script ends; the demo's configuration with overrides."""
    loaded = load(None, overrides)

    unseen: list[dict[str, object]] = []  # what went wrong in the loop, in a callback or a task that nobody waits for

    async def main() -> _Result:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: unseen.append(context))
        trace: list[tuple[int, str, int, bytes]] = []
        world, wires = World(trace), Wires(opener)

        def ticks(period_s: float) -> BusyTicks:
            world.ticks = BusyTicks(period_s)
            return world.ticks

        def observe(tick: int, direction: str, identifier: int, data: bytes) -> None:
            trace.append((tick, direction, identifier, data))

        async with closed_loop(
            loaded,
            bus=bus,
            wires=wires,
            node_name=lambda _: "drive",
            ticks=ticks,
            observers=(observe,),
            prepare_reload=world.prepare_reload,
            sign_of_life=world.completed,
        ) as loop:
            world.loop, world.wire = loop, wires.wire(bus)
            return await script(world)

    result = run(main())
    assert unseen == []
    return result
