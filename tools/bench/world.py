"""A service with its drives in one process and in simulated or real time: the axes move to and fro all the while."""

import asyncio
import contextlib
import dataclasses
import functools
from collections.abc import AsyncIterator
from typing import Final

from tools.bench.children import ROOT
from tools.bench.plan import PATIENT
from twostage_servo.api.requests import ArmRequest, MoveRequest, Request
from twostage_servo.app.closed_loop import ClosedLoop, Wires, closed_loop
from twostage_servo.axis.refusals import Refused
from twostage_servo.config.loader import Config, LoadedConfig, load
from twostage_servo.config.machine import Machine

_CONFIG: Final = ROOT / "config" / "demo.toml"

_AXES_A_BUS: Final = 8

_HALF_WAY: Final = 200.0
_VELOCITY: Final = 100.0
_MOVE_S: Final = 6.0
"""A move of twice that way takes 4 s at that velocity; the axis stands for the rest."""


def machine_of(axes: int) -> Machine:
    """Return a machine of so many axes. Eight share a bus: at 10 ms a tick they take 38 % of one of 500 kbit/s."""
    files = tuple(_file(index) for index in range(axes))
    return dataclasses.replace(Machine.of(files[0]), axes=files)


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
async def operate(axes: int) -> AsyncIterator[ClosedLoop]:
    """Run a service of so many axes, moving, while the block runs."""
    async with closed_loop(machine_of(axes), wires=Wires()) as loop:
        shuttling = asyncio.create_task(_shuttle(loop))
        try:
            yield loop
            for axis_loop in loop.service.axis_loops:
                if axis_loop.axis.trip is not None:
                    raise RuntimeError(f"{axis_loop.name} tripped while it was measured: {axis_loop.axis.trip.cause}")
        finally:
            shuttling.cancel()
            await asyncio.gather(shuttling, return_exceptions=True)


async def _shuttle(loop: ClosedLoop) -> None:
    """Send all axes from one end to the other, again and again."""
    await _insist(loop, ArmRequest())
    end = _HALF_WAY
    while True:
        end = -end
        await _insist(loop, MoveRequest(positions=dict.fromkeys(loop.parts.names, end), velocity=_VELOCITY))
        await asyncio.sleep(_MOVE_S)


async def _insist(loop: ClosedLoop, request: Request) -> None:
    """Ask for something until it is not refused: the drive may not have been heard yet."""
    while True:
        try:
            loop.requests.handle(request)
        except Refused:
            await asyncio.sleep(0.01)
        else:
            return
