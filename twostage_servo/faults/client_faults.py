"""Injections by clients of the control socket: those who leave too soon, do not read, or ask for too much at once."""

import asyncio
import contextlib
import socket
from random import Random
from typing import Final

from twostage_servo.api.request_reading import LONGEST_LINE
from twostage_servo.api.requests import ArmRequest, StatusRequest
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.state import State
from twostage_servo.client.errors import Refused, ServoError
from twostage_servo.faults.clients import OPERATOR
from twostage_servo.faults.host_faults import suspend
from twostage_servo.faults.world import World
from twostage_servo.service.background_server import Priority

FREEZE_S: Final = 1.5
"""For so long the service stands still: longer than a command may wait."""
_FLOOD_S: Final = 0.5
_HALF_CLOSED: Final = 70
_UNREAD: Final = 110
"""Answers to one who reads none: more than the kernel takes."""
_HEAVY: Final = 55
_DROPPED: Final = "dropped"


def leave_too_soon(world: World, _: Random) -> None:
    """Let a client ask for motion while others are served, and go before it is its turn."""
    _count_what_is_carried_out(world)
    world.requests.authority.release(OPERATOR)
    world.clients.spawn(_leave_too_soon(world))


async def _leave_too_soon(world: World) -> None:
    async with world.loop.parts.background.slot(Priority.REQUEST):
        async with world.clients.open_socket() as (_, writer):
            writer.write(b'{"op": "move", "by": 1.0}\n{"op": "home", "position": 0.0}\n{"op": "arm"}\n')
        await writer.wait_closed()
        await asyncio.sleep(3.0 * world.period_s)
    world.refusals.append(_DROPPED)


def freeze(world: World, random: Random) -> None:
    """Hold the host up, and let a client ask for motion meanwhile, one who waits for the answer.

    While the axis is disarmed only the requests are held up: so long a silence of the drive may cost a short counter
    its reference, which has nothing to do with requests.
    """
    _count_what_is_carried_out(world)
    world.requests.authority.release(OPERATOR)
    if world.axis.state is State.DISARMED:
        world.clients.spawn(_hold_requests_up(world))
    else:
        suspend(FREEZE_S)(world, random)
    world.clients.spawn(_ask_and_wait(world))


async def _hold_requests_up(world: World) -> None:
    async with world.loop.parts.background.slot(Priority.REQUEST):
        await asyncio.sleep(FREEZE_S)


async def _ask_and_wait(world: World) -> None:
    await asyncio.sleep(2.0 * world.period_s)  # by then it stands still
    async with world.clients.connect() as client:
        try:
            await client.ask(ArmRequest())
        except Refused as refused:
            world.refusals.append(refused.code)
        else:
            world.refusals.append(None)


def half_closed(world: World, _: Random) -> None:
    """Let more clients than are possible ask for much, say that no more will come, and read nothing."""
    world.clients.spawn(_half_closed(world))


async def _half_closed(world: World) -> None:
    async with world.clients.open_socket() as (_, writer):
        path = writer.get_extra_info("peername")
        with contextlib.ExitStack() as stack:
            for _ in range(_HALF_CLOSED):
                caller = stack.enter_context(socket.socket(socket.AF_UNIX))
                caller.setblocking(False)
                with contextlib.suppress(OSError):  # the queue is full, or the service has ended
                    caller.connect(path)
                    caller.send(_UNREAD * b'{"op": "status"}\n')
                    caller.shutdown(socket.SHUT_WR)
                await asyncio.sleep(_FLOOD_S / _HALF_CLOSED)


def heavy_lines(world: World, _: Random) -> None:
    """Let clients ask, again and again, for what takes the longest to be found wrong."""
    end_s = world.now_s + _FLOOD_S
    for number in range(_HEAVY):
        world.clients.spawn(_heavy_lines(world, number * 0.1 * world.period_s, end_s))


async def _heavy_lines(world: World, begin_s: float, end_s: float) -> None:
    head, foot = b'{"op":"move","positions":{"stop":""', b"}}\n"
    body = b"".join(b',"%x":""' % number for number in range(LONGEST_LINE))[: LONGEST_LINE - len(head) - len(foot)]
    line = head + body[: body.rindex(b",")] + foot
    await asyncio.sleep(begin_s)
    async with world.clients.open_socket() as (reader, writer):
        while world.now_s < end_s:
            writer.write(line)
            if not await reader.readline():
                return
            await asyncio.sleep(world.period_s)


async def was_dropped(world: World) -> str | None:
    """Check that nothing was carried out for a client that had gone."""
    return _judge(world, _DROPPED)


async def has_expired(world: World) -> str | None:
    """Check that what was asked during the freeze was refused after it."""
    return _judge(world, RefusalCode.EXPIRED)


async def serves_others(world: World) -> str | None:
    """Check that a new client is answered, and that the others were kept within their number."""
    try:
        async with world.clients.connect() as client:
            await client.ask(StatusRequest())
    except ServoError as error:
        return f"a new client is not served: {error}"
    return None


def _judge(world: World, wanted: str) -> str | None:
    told = ", ".join("carried out" if code is None else code for code in world.refusals)
    return None if world.refusals == [wanted] else f"expected {wanted}, got {told or 'nothing'}"


def _count_what_is_carried_out(world: World) -> None:
    world.requests.listen(lambda *_: world.refusals.append(None))
