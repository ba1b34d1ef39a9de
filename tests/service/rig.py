"""The real service and the real drive node on a simulated bus, in simulated time."""

import asyncio
import functools
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TypeVar

import can

from twostage_servo.app.assembly import build_service, drive_side
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.messages import Command
from twostage_servo.axis.state import State
from twostage_servo.canbus.link import BusSettings, Link
from twostage_servo.config.loader import load
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.faults.frames import profile_of
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.servo_service import ServoService
from twostage_servo.simulation.bus import Wire
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.simulation.node import DriveNode
from twostage_servo.timing.ticks import Tick, Ticks
from twostage_servo.timing.virtual_clock import run

BUS = BusSettings(interface="socketcan", channel="can0")
"""What the simulated bus stands for."""

_Result = TypeVar("_Result")


class BusyTicks(Ticks):
    """Ticks on a busy host: the next one is held up until so many seconds after this one."""

    __slots__ = ("hold_s",)

    def __init__(self, period_s: float) -> None:
        super().__init__(period_s)
        self.hold_s = 0.0

    async def __anext__(self) -> Tick:
        hold_s, self.hold_s = self.hold_s, 0.0
        if hold_s:
            await asyncio.sleep(hold_s)
        return await super().__anext__()


@dataclass
class World:
    """What a script can look at and act on."""

    service: ServoService
    axis_loop: AxisLoop
    drive: SimulatedDrive
    wire: Wire
    ticks: BusyTicks
    serving: "asyncio.Task[None]"
    trace: list[tuple[int, str, int, bytes]] = field(default_factory=list)

    @property
    def axis(self) -> Axis:
        return self.axis_loop.axis

    @property
    def profile(self) -> DriveProfile:
        """The compiled frames of the drive."""
        return profile_of(self.axis_loop.drive)

    def hear(self, message: can.Message) -> None:
        """Let a frame come in, as if it had just been read."""
        self.axis_loop.bus._takers[message.arbitration_id](message)

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
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: unseen.append(context))
        wire = Wire(loop.time)
        service = build_service(loaded, bus, lambda _: opener(wire))
        service.ticks = ticks = BusyTicks(service.ticks.period_s)
        axis_loop = service.axis_loop()
        side = drive_side(loaded, axis_loop.drive)
        drive = SimulatedDrive(loaded.config.simulation, side, loop.time())
        link = Link(BUS, side.identifiers, functools.partial(wire.attach, "drive"))
        node = DriveNode(drive, link, loaded.config.simulation.cycle_ms / 1e3)
        driving = asyncio.create_task(node.run())
        world = World(service, axis_loop, drive, wire, ticks, asyncio.create_task(service.run()))

        def observe(tick: int, direction: str, identifier: int, data: bytes) -> None:
            world.trace.append((tick, direction, identifier, data))

        axis_loop.bus.observers.append(observe)
        try:
            return await script(world)
        finally:
            service.shut_down()
            await asyncio.gather(world.serving, return_exceptions=True)
            node.stop()
            await driving

    result = run(main())
    assert unseen == []
    return result
