"""A service with its drives in one process and in simulated or real time: the axes move to and fro all the while."""

import asyncio
import contextlib
import dataclasses
import functools
from collections import defaultdict
from collections.abc import AsyncIterator, Callable
from typing import Final

from tools.bench.children import ROOT
from tools.bench.plan import PATIENT
from twostage_servo.api.requests import ArmRequest, MoveRequest, Request
from twostage_servo.app.assembly import build_service, drive_side
from twostage_servo.axis.refusals import Refused
from twostage_servo.canbus.link import Link
from twostage_servo.config.loader import Config, LoadedConfig, load
from twostage_servo.config.machine import Machine
from twostage_servo.service.servo_service import ServoService
from twostage_servo.simulation.bus import Wire
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.simulation.node import DriveNode

_CONFIG: Final = ROOT / "config" / "demo.toml"

_AXES_A_BUS: Final = 8

_HALF_WAY: Final = 200.0
_VELOCITY: Final = 100.0
_MOVE_S: Final = 6.0
"""A move of twice that way takes 4 s at that velocity; the axis stands for the rest."""


def build(axes: int) -> tuple[ServoService, list[DriveNode], Callable[[], list[Request]]]:
    """Build a service of so many axes with a simulated drive for each, on the running loop.

    Eight share a bus: at 10 ms a tick they take 38 % of one of 500 kbit/s.

    Returns
    -------
    tuple
        The service, the drives, and what gives the requests that send the axes to the other end each time.
    """
    now = asyncio.get_running_loop().time
    wires: defaultdict[str | int, Wire] = defaultdict(lambda: Wire(now))
    files = tuple(_file(index) for index in range(axes))
    machine = dataclasses.replace(Machine.of(files[0]), axes=files)
    service = build_service(machine, opener=lambda bus: wires[bus.channel].attach("service"))
    nodes = []
    for loaded, axis_loop in zip(files, service.axis_loops, strict=True):
        side = drive_side(loaded, axis_loop.drive)
        drive = SimulatedDrive(loaded.config.simulation, side, now())
        attach = functools.partial(wires[loaded.config.bus.channel].attach, axis_loop.name)
        link = Link(loaded.config.bus, side.identifiers, attach)
        nodes.append(DriveNode(drive, link, loaded.config.simulation.cycle_ms / 1e3))
    end = _HALF_WAY

    def to_the_other_end() -> list[Request]:
        nonlocal end
        end = -end
        ends = dict.fromkeys((axis_loop.name for axis_loop in service.axis_loops), end)
        return [MoveRequest(positions=ends, velocity=_VELOCITY)]

    return service, nodes, to_the_other_end


@functools.cache  # 64 of them take a second, each time
def _file(index: int) -> LoadedConfig[Config]:
    return load(_CONFIG, [*PATIENT, *_apart(index)])


def _apart(index: int) -> tuple[str, ...]:
    """Return what an axis needs of its own; the interface stands for the bus that is simulated."""
    bus, offset = divmod(index, _AXES_A_BUS)
    return (
        f"axis.name=axis{index}",
        f"protocol.identifier_offset={offset}",
        "bus.interface=socketcan",
        f"bus.channel=can{bus}",
    )


@contextlib.asynccontextmanager
async def operate(axes: int, prepare: Callable[[ServoService], None]) -> AsyncIterator[ServoService]:
    """Run a service of so many axes, moving, while the block runs.

    Parameters
    ----------
    axes
        How many.
    prepare
        Called with the service before it runs.
    """
    service, nodes, to_the_other_end = build(axes)
    prepare(service)
    driving = [asyncio.create_task(node.run()) for node in nodes]
    serving = asyncio.create_task(service.run())
    await _insist(service, ArmRequest())

    async def shuttle() -> None:
        while True:
            for request in to_the_other_end():
                await _insist(service, request)
            await asyncio.sleep(_MOVE_S)

    shuttling = asyncio.create_task(shuttle())
    try:
        yield service
        for axis_loop in service.axis_loops:
            if axis_loop.axis.trip is not None:
                raise RuntimeError(f"{axis_loop.name} tripped while it was measured: {axis_loop.axis.trip.cause}")
    finally:
        shuttling.cancel()
        service.shut_down()
        await asyncio.gather(shuttling, serving, return_exceptions=True)
        for node in nodes:
            node.stop()
        await asyncio.gather(*driving)


async def _insist(service: ServoService, request: Request) -> None:
    """Ask for something until it is not refused: the drive may not have been heard yet."""
    while True:
        try:
            service.handle(request)
        except Refused:
            await asyncio.sleep(0.01)
        else:
            return
