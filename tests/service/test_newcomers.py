"""A fresh client's `stop` is heard, whatever others do to be heard before it."""

import asyncio
import contextlib
import json
import socket
from collections import deque
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.service.operators import STATUS, Operator, call, connect, read_all, serve
from tests.service.rig import World
from twostage_servo.api.requests import Request
from twostage_servo.axis.state import State
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.service.reply import Asker, Reply

STOP = b'{"op": "stop"}\n'


async def moving(path: Path, world: World) -> Operator:
    operator = await connect(path)
    await operator.done(op="arm")
    await world.until(lambda: world.state() is State.HOLDING)
    await operator.done(op="move", position=400.0)
    return operator


async def asking(callers: contextlib.ExitStack, path: Path) -> None:
    """Ask for the status again and again, and come back when told to make room."""
    while True:
        one = await call(callers, path)
        with contextlib.suppress(OSError):
            while True:
                one.send(STATUS)
                await asyncio.sleep(0.005)
                with contextlib.suppress(BlockingIOError):
                    if b"too_many_clients" in one.recv(1 << 16):
                        break
        one.close()


@contextlib.asynccontextmanager
async def background(*tasks: "asyncio.Task[None]") -> AsyncIterator[None]:
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def test_a_fresh_client_is_heard_beside_more_readers_than_there_are_places(
    path: Path, callers: contextlib.ExitStack
) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        await moving(path, world)
        async with background(*[asyncio.create_task(asking(callers, path)) for _ in range(66)]):
            await world.seconds(0.1)
            fresh = await call(callers, path)
            await world.seconds(0.1)  # it is let in, and then its machine is busy with something else
            fresh.send(STOP)
            fresh.shutdown(socket.SHUT_WR)
            answers = await read_all(fresh)
        assert [answer["ok"] for answer in answers] == [True]
        assert world.state() is State.STOPPING

    serve(path, script)


def test_a_fresh_client_has_its_fair_chance_beside_a_crowd_that_only_connects(
    path: Path, callers: contextlib.ExitStack
) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        async def connecting() -> None:
            crowd: deque[socket.socket] = deque()
            while True:
                crowd.append(await call(callers, path))
                if len(crowd) > 200:
                    crowd.popleft().close()

        operator = await moving(path, world)
        fresh = await call(callers, path)
        async with background(asyncio.create_task(connecting())):
            await world.seconds(0.015)
            fresh.send(STOP)
            await world.seconds(0.015)
            assert world.state() is State.STOPPING
            await world.seconds(0.5)
            late = await call(callers, path, STOP)
            late.shutdown(socket.SHUT_WR)
            assert [answer["ok"] for answer in await read_all(late)] == [True]
        assert control._admission is not None
        assert control._admission.newcomers is not None
        assert len(control._admission.newcomers) == 128
        assert (await operator.ask(op="status"))["ok"]  # those who say nothing push nobody out who has

    serve(path, script)


def test_what_an_idle_client_has_just_said_is_read_before_it_would_have_to_make_room(path: Path) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        await (await moving(path, world)).done(op="release")
        one, other = await connect(path), await connect(path)
        for operator in (one, other):
            await operator.done(op="status")
        one.writer.write(STOP)
        assert control._sessions.make_room()  # the one who released
        assert control._sessions.make_room()
        assert (await one.answer())["ok"]
        assert world.state() is State.STOPPING
        assert (await other.answer())["error"]["code"] == "too_many_clients"

    serve(path, script)


def test_a_stop_is_carried_out_where_everybody_has_just_said_something(path: Path) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        await (await moving(path, world)).done(op="release")
        operators = [await connect(path) for _ in range(6)]
        for operator in operators:
            await operator.done(op="status")
        while len(control._sessions._connections) > 6:
            control._sessions.make_room()
        for operator in operators:
            operator.writer.write(STOP if operator is operators[4] else STATUS)
        while len(control._sessions._connections):
            control._sessions.make_room()
        assert world.state() is State.STOPPING

    serve(path, script)


def test_a_stop_goes_before_all_who_wait_for_a_place(
    path: Path, callers: contextlib.ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        operator = await moving(path, world)
        others = [await connect(path) for _ in range(63)]
        for other in others:
            await other.done(op="status")
        there_is_time = asyncio.Event()
        assert control._admission is not None
        monkeypatch.setattr(control._admission, "_admit_some", lambda: None)
        monkeypatch.setattr(control._admission.newcomers, "somebody_waits", there_is_time.wait)
        waiting = [await call(callers, path, STATUS) for _ in range(40)]
        stopping = await connect(path)
        assert (await stopping.ask(op="stop"))["axis"]["state"] == "stopping"
        refused = [json.loads(one.recv(4096)) for one in waiting[32:]]
        assert {answer["error"]["code"] for answer in refused} == {"too_many_clients"}
        for one in waiting[:32]:
            with pytest.raises(BlockingIOError):
                one.recv(1)
        monkeypatch.undo()
        there_is_time.set()
        await world.seconds(0.1)
        assert all(json.loads(one.recv(1 << 16))["ok"] for one in waiting[:32])
        assert (await operator.ask(op="status"))["ok"]

    serve(path, script)


def test_a_client_that_has_been_let_in_says_half_a_line_and_then_the_rest(
    path: Path, callers: contextlib.ExitStack
) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        one = await call(callers, path, STATUS[:5])
        await world.seconds(0.1)
        assert not len(control._sessions._connections)
        await call(callers, path, b"x" * 5000)  # which is too long
        one.send(STATUS[5:])
        one.shutdown(socket.SHUT_WR)
        assert [answer["ok"] for answer in await read_all(one)] == [True]

    serve(path, script)


@pytest.mark.parametrize(("last", "stopped"), [(b"", False), (STOP, True)])
def test_what_a_client_that_has_gone_only_wanted_to_know_is_dropped_at_once(
    path: Path, callers: contextlib.ExitStack, last: bytes, stopped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        await (await moving(path, world)).done(op="release")
        await world.seconds(1.0)
        told: list[Request] = []
        answer = control._sessions._requests.answer

        def counted(request: Request, asker: Asker) -> Reply:
            told.append(request)
            return answer(request, asker)

        monkeypatch.setattr(control._sessions._requests, "answer", counted)
        gone = [await call(callers, path) for _ in range(10)]
        for one in gone:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
            with contextlib.suppress(BlockingIOError):
                for _ in range(10):
                    one.send(100 * STATUS)
            one.send(last)
            one.close()
        await world.seconds(0.1)
        assert (len(told) <= 10 * 2) is True  # all of them need not be shown
        assert len(control._sessions._connections) <= 1
        assert (world.state() is not State.SPEED_STAGE) is stopped

    serve(path, script)
