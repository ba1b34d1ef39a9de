"""Injections in the host: its time, its disk, its log, its clients, and the program itself."""

import asyncio
import contextlib
import errno
import json
import os
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, TextIO, cast

import structlog
from pydantic import ValidationError

from twostage_servo.axis.messages import Refused
from twostage_servo.faults.world import World
from twostage_servo.service.log import open_log
from twostage_servo.service.requests import REQUESTS
from twostage_servo.service.trip_files import TripFiles

Injection = Callable[[World, Random], None]

LARGEST_RETARGET = 0.25
"""How far a new set-point may lie from the present one, as a share of the move."""

OPERATOR, ANOTHER = "operator", "another operator"


def stall(duration_s: float) -> Injection:
    """Hold the host up once, for a time in s."""

    def inject(world: World, _: Random) -> None:
        left = [duration_s]
        world.ticks.hold = lambda: left.pop() if left else 0.0

    return inject


def hog(world: World, random: Random) -> None:
    """Let every tick of the next second be up to 90 % of its period late."""
    end_s = world.now_s + 1.0
    world.ticks.hold = lambda: random.uniform(0.0, 0.9) * world.period_s if world.now_s < end_s else 0.0


def defect(world: World, _: Random) -> None:
    """Let a defect show in the loop, once."""
    armed = [True]

    def fail(_: object) -> None:
        if armed:
            armed.clear()
            raise RuntimeError("a defect, injected")

    world.service.publishers.append(fail)


def wall_clock_jumps(world: World, random: Random) -> None:
    """Set the wall clock by an hour, forwards or back."""
    world.wall_offset_s += random.choice((-3600.0, 3600.0))


def full_disk(world: World, _: Random) -> None:
    """Let every trip file fail for want of space, and ask for one in each of the next 20 ticks."""

    def no_space(path: Path, *_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    files = TripFiles(Path(tempfile.gettempdir()) / "nowhere", no_space)
    world.station.reporter.trip_files = files
    _for_ticks(world, 20, lambda: files.write("full", {}, world.station.recorder.records()))


def blocked_log(world: World, _: Random) -> None:
    """Let the log's reader stop reading, and write 100 lines in each of the next 20 ticks."""
    world.log = open_log("debug", cast("TextIO", _StuckStream(world.log_released)), capacity=50)
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
    """Let a client ask 200 times in a tick for a second, and two watch every tick without reading."""
    world.spawn(_flood(world, world.now_s + 1.0))


async def _flood(world: World, end_s: float) -> None:
    async with contextlib.AsyncExitStack() as stack:
        watchers = [await stack.enter_async_context(world.client()) for _ in range(2)]
        for _, writer in watchers:
            writer.write(b'{"op": "watch", "every": 1}\n')
        reader, writer = await stack.enter_async_context(world.client())
        while world.now_s < end_s:
            writer.write(b'{"op": "status"}\n' * 200)
            for _ in range(200):
                await reader.readline()
            await asyncio.sleep(world.period_s)


def bad_set_points(world: World, _: Random) -> None:
    """Ask for set-points that no axis can take; each has to be refused."""
    limits = world.axis.settings.limits
    beyond = limits.position_maximum + 1.0
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
        world.refusals.append(_ask(world, line, OPERATOR))


def second_client(world: World, _: Random) -> None:
    """Let another client command the axis that the operator holds; it has to be refused."""
    world.service.desk.lease.demand(OPERATOR)
    target = world.drive.position
    for request in ({"op": "move", "position": target}, {"op": "arm"}, {"op": "reset"}, {"op": "jog", "velocity": 1.0}):
        world.refusals.append(_ask(world, json.dumps(request), ANOTHER))


def client_dies(world: World, _: Random) -> None:
    """End the operator's connection without a word."""
    world.service.desk.lease.demand(OPERATOR)
    world.service.desk.leave(OPERATOR)


def reload(world: World, _: Random) -> None:
    """Ask the service to read its configuration again."""
    world.service.desk.reload = lambda: None
    world.refusals.append(_ask(world, '{"op": "reload"}', OPERATOR))
    world.service.desk.lease.release(OPERATOR)


def retarget(world: World, random: Random) -> None:
    """Send another set-point, up to a quarter of the move away from the present one."""
    span = LARGEST_RETARGET * abs(world.target - world.start)
    limits = world.axis.settings.limits
    world.target = min(
        max(world.target + random.uniform(-span, span), limits.position_minimum), limits.position_maximum
    )
    world.axis.move_to(world.target, world.velocity)


def _ask(world: World, line: str, client: str) -> str | None:
    """Return the code with which a request is refused, or None if it was carried out."""
    try:
        world.service.handle(REQUESTS.validate_json(line), client)
    except ValidationError:
        return "bad_request"
    except Refused as refused:
        return refused.code
    return None


def _for_ticks(world: World, count: int, act: Callable[[], Any]) -> None:
    left = count

    def after_each_tick(_: object) -> None:
        nonlocal left
        if left > 0:
            left -= 1
            act()

    world.service.publishers.append(after_each_tick)
