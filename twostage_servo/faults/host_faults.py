"""Injections in the host: its time, its disk, its log, its clients, and the program itself."""

import asyncio
import contextlib
import errno
import os
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, TextIO, cast

import structlog

from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.trips import Reaction
from twostage_servo.faults.clients import OPERATOR
from twostage_servo.faults.defects import PARTS
from twostage_servo.faults.world import World
from twostage_servo.service.log import open_log
from twostage_servo.telemetry.trip_files import TripFiles

Injection = Callable[[World, Random], None]

LARGEST_RETARGET = 0.25
"""How far a new set-point may lie from the present one, as a share of the move."""

LATEST_TICK = 0.9
"""How late a tick of a busy host comes at most, as a share of its period."""

ANOTHER = "another operator"


def suspend(duration_s: float) -> Injection:
    """Suspend the host once, for a time in s."""

    def inject(world: World, _: Random) -> None:
        left = [duration_s]
        world.ticks.hold_up(lambda: left.pop() if left else 0.0)

    return inject


def after_suspension(duration_s: float, tick_s: float, missed_ticks_allowed: int, command_timeout_s: float) -> Reaction:
    """Return the reaction of an armed axis that its limits ask for when the host is suspended.

    A drive that hears nothing for longer than its time-out has disabled itself, whatever the service makes of the ticks
    that it has missed; the last command is up to a tick older than the suspension.
    """
    if duration_s + tick_s > command_timeout_s:
        return Reaction.DISABLE
    return Reaction.QUICK_STOP if int(duration_s / tick_s + 1e-9) > missed_ticks_allowed else Reaction.NONE


def hog(world: World, random: Random) -> None:
    """Let every tick of the next second be late, by up to the largest share of its period."""
    end_s = world.now_s + 1.0
    world.ticks.hold_up(lambda: random.uniform(0.0, LATEST_TICK) * world.period_s if world.now_s < end_s else 0.0)


def defect(world: World, random: Random) -> None:
    """Let a defect show once in what closes the loop: where a tick reads, decides, or writes."""
    world.defects.show_in(random.choice(PARTS))


def defect_of_a_publisher(world: World, _: Random) -> None:
    """Let a defect show once in what is told of each tick."""
    armed = [True]

    def fail(_: object) -> None:
        if armed:
            armed.clear()
            raise RuntimeError("a defect, injected")

    world.loop.listen(fail)


def wall_clock_jumps(world: World, random: Random) -> None:
    """Set the wall clock by an hour, forwards or back."""
    world.wires.shift_wall_clock(random.choice((-3600.0, 3600.0)))


def full_disk(world: World, _: Random) -> None:
    """Let every trip file fail for want of space, and ask for one in each of the next 20 ticks."""

    def no_space(folder: Path, *_: object) -> Path:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))

    files = TripFiles(Path(tempfile.gettempdir()) / "nowhere", no_space)
    world.loop.trip_files.use(files)
    _for_ticks(world, 20, lambda: files.write("x", "full", {}, world.axis_loop.recorder.records()))


def blocked_log(world: World, _: Random) -> None:
    """Let the log's reader stop reading, and write 100 lines in each of the next 20 ticks."""
    world.use_log(open_log("debug", cast("TextIO", _StuckStream(world.log_released)), capacity=50))
    log = structlog.get_logger()

    def write() -> None:
        for number in range(100):
            log.info("flood", number=number)

    _for_ticks(world, 20, write)


class _StuckStream:
    """A stream whose reader does not read until it is released."""

    def __init__(self, released: threading.Event) -> None:
        self._released = released

    def write(self, _: str) -> int:
        self._released.wait()
        return 0

    def flush(self) -> None:
        """Nothing is kept."""

    def isatty(self) -> bool:
        return False


def flood(world: World, _: Random) -> None:
    """Let a client ask 200 times in each of 10 ticks, and two watch every tick without reading."""
    world.clients.spawn(_flood(world, world.now_s + 10.0 * world.period_s))


async def _flood(world: World, end_s: float) -> None:
    async with contextlib.AsyncExitStack() as stack:
        watchers = [await stack.enter_async_context(world.clients.open_socket()) for _ in range(2)]
        for _, writer in watchers:
            writer.write(b'{"op": "watch", "every": 1}\n')
        reader, writer = await stack.enter_async_context(world.clients.open_socket())
        while world.now_s < end_s:
            writer.write(b'{"op": "status"}\n' * 200)
            for _ in range(200):
                await reader.readline()
            await asyncio.sleep(world.period_s)


def bad_set_points(world: World, _: Random) -> None:
    """Ask for set-points that no axis can take; each has to be refused."""
    limits = world.axis.settings.limits
    beyond = limits.position_maximum + 0.01 * (limits.position_maximum - limits.position_minimum)
    lines = [
        '{"op": "move", "position": NaN}',
        '{"op": "move", "position": Infinity}',
        '{"op": "move", "position": 1e400}',
        f'{{"op": "move", "position": {beyond}}}',
        f'{{"op": "move", "position": 0, "velocity": {2.0 * limits.velocity}}}',
        '{"op": "move", "position": 0, "velocity": -1}',
        '{"op": "jog", "velocity": NaN}',
    ]
    for line in lines:
        world.refusals.append(world.clients.ask(line))


def second_client(world: World, _: Random) -> None:
    """Let another client command the axis that the operator holds; it has to be refused."""
    world.requests.authority.acquire(OPERATOR)
    target = world.drive.position
    for request in ({"op": "move", "position": target}, {"op": "arm"}, {"op": "reset"}, {"op": "jog", "velocity": 1.0}):
        world.refusals.append(world.clients.ask(request, ANOTHER))


def client_dies(world: World, _: Random) -> None:
    """End the operator's connection without a word."""
    world.requests.authority.acquire(OPERATOR)
    world.requests.disconnect(OPERATOR)


def reload(world: World, _: Random) -> None:
    """Ask the service to read its configuration again."""
    world.clients.spawn(_reload(world))


async def _reload(world: World) -> None:
    try:
        await world.requests.prepare_reload(OPERATOR)
    except Refused as refused:
        world.refusals.append(refused.code)
    else:
        world.refusals.append(world.clients.ask('{"op": "reload"}'))
    world.requests.authority.release(OPERATOR)


def retarget(world: World, random: Random) -> None:
    """Send another set-point, up to a quarter of the move away from the present one."""
    span = LARGEST_RETARGET * abs(world.target - world.start)
    limits = world.axis.settings.limits
    target = world.target + random.uniform(-span, span)
    world.aim(min(max(target, limits.position_minimum), limits.position_maximum))
    world.axis.move_to(world.target, world.velocity)


def _for_ticks(world: World, count: int, act: Callable[[], Any]) -> None:
    left = count

    def after_each_tick(_: object) -> None:
        nonlocal left
        if left > 0:
            left -= 1
            act()

    world.loop.listen(after_each_tick)
