"""The budget of connections: descriptors, tasks and buffers are bounded whatever clients do, and nobody waits."""

import asyncio
import contextlib
import errno
import os
import random
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import structlog
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.service.operators import STATUS, call, connect, read_all, serve
from tests.service.rig import World
from twostage_servo.axis.state import State
from twostage_servo.service.background_server import Priority
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.service.listening_socket import ListeningSocket


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - the number only


def test_half_closed_clients_that_do_not_read_are_no_more_than_others(
    path: Path, callers: contextlib.ExitStack
) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="move", position=2000.0)
        before, most = descriptors(), 0
        for number in range(1, 201):
            caller = await call(callers, path, (90 + number % 50) * STATUS)  # more than the kernel takes, or less
            caller.shutdown(socket.SHUT_WR)
            await world.seconds(0.03)
            most = max(most, descriptors() - before - number)
        assert most <= 64
        assert len(control._sessions._connections) <= 64
        assert len(control._sessions._serving) <= 64
        assert sum(len(one._outgoing) for one in control._sessions._connections) <= 64
        assert world.service.statistics.missed == 0
        assert (await (await connect(path)).ask(op="stop"))["axis"]["state"] == "stopping"
        assert (await operator.ask(op="status"))["ok"]  # who commands never has to make room

    serve(path, script)


@pytest.mark.parametrize("count", [1, 70])
def test_the_end_waits_for_no_client(path: Path, callers: contextlib.ExitStack, count: int) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        for number in range(count):
            caller = await call(callers, path, (115 - number) * STATUS)
            caller.shutdown(socket.SHUT_WR)
            await call(callers, path, b'{"op": "watch", "every": 1}\n')
        await world.seconds(0.1)
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        await control.stop()
        assert loop.time() == begun_s
        assert not control._sessions._serving
        assert not len(control._sessions._connections)

    serve(path, script)


def test_a_half_closed_client_that_reads_gets_all_of_its_answers(path: Path, callers: contextlib.ExitStack) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        caller = await call(callers, path, 300 * STATUS)
        caller.shutdown(socket.SHUT_WR)
        answers = await read_all(caller)
        assert len(answers) == 300
        assert all(answer["ok"] for answer in answers)
        assert not len(control._sessions._connections)

    serve(path, script)


def test_the_last_line_needs_no_end(path: Path, callers: contextlib.ExitStack) -> None:
    async def script(_: World, __: ControlSocket) -> None:
        caller = await call(callers, path, STATUS[:-1])
        caller.shutdown(socket.SHUT_WR)
        assert [answer["ok"] for answer in await read_all(caller)] == [True]

    serve(path, script)


def test_who_sends_no_more_has_a_second_to_take_the_rest(path: Path, callers: contextlib.ExitStack) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        caller = await call(callers, path, b'{"op": "recording"}\n')
        await world.seconds(0.1)
        (connection,) = control._sessions._connections
        for _ in range(100):
            connection.write(b"x" * 10_000)
        caller.shutdown(socket.SHUT_WR)
        await world.seconds(0.9)
        assert connection in control._sessions._connections
        await world.seconds(0.3)
        assert not len(control._sessions._connections)
        assert connection.closed

    serve(path, script)


def test_who_has_hung_up_makes_room_before_anybody_else(path: Path, callers: contextlib.ExitStack) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        first = await connect(path)
        await first.done(op="status")
        for _ in range(62):
            await (await connect(path)).done(op="status")
        leaving = await call(callers, path, b'{"op": "recording"}\n')
        await world.seconds(0.1)
        last = next(one for one in control._sessions._connections if one.peer.endswith("#64"))
        for _ in range(100):
            last.write(b"x" * 10_000)
        leaving.shutdown(socket.SHUT_WR)
        await world.seconds(0.05)
        assert len(control._sessions._connections) == 64
        await (await connect(path)).done(op="status")
        assert last.closed
        await first.done(op="status")

    serve(path, script)


def test_without_descriptors_the_one_that_matters_least_makes_room_at_once(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        idle, other = await connect(path), await connect(path)
        await idle.done(op="status")
        await other.done(op="status")
        accept, none_left = ListeningSocket.accept, [OSError(errno.EMFILE, "Too many open files")]

        def exhausted(door: ListeningSocket) -> object:
            if none_left:
                raise none_left.pop()
            return accept(door)

        monkeypatch.setattr(ListeningSocket, "accept", exhausted)
        await (await connect(path)).done(op="disarm")
        assert (await idle.answer())["error"]["code"] == "too_many_clients"
        await other.done(op="status")

    with structlog.testing.capture_logs() as logs:
        serve(path, script)
    assert not [entry for entry in logs if entry["event"] == "connections cannot be accepted"]


def test_who_has_asked_for_something_that_is_not_read_yet_is_not_idle(path: Path) -> None:
    async def script(_: World, control: ControlSocket) -> None:
        first, other = await connect(path), await connect(path)
        for client in (first, other):
            await client.done(op="status")
        idle_for_longest, idle = control._sessions._connections
        first.writer.write(b'{"op": "status"}\n')  # in the kernel; nobody has looked
        assert control._sessions.make_room()
        assert idle_for_longest in control._sessions._connections
        assert idle not in control._sessions._connections
        assert (await first.answer())["ok"]
        assert (await other.answer())["error"]["code"] == "too_many_clients"

    serve(path, script)


def test_a_stop_that_was_read_is_carried_out_though_its_connection_has_to_make_room(path: Path) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="move", position=400.0)
        await operator.done(op="release")
        stopping = await connect(path)
        await stopping.done(op="status")
        turn = world.loop.parts.background.slot

        @contextlib.asynccontextmanager
        async def never(rank: Priority) -> AsyncIterator[None]:
            if rank is Priority.URGENT:
                await asyncio.Event().wait()
            async with turn(rank):
                yield

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(world.loop.parts.background, "slot", never)
            stopping.writer.write(b'{"op": "stop"}\n')
            await world.seconds(0.05)
            assert world.state() is not State.STOPPING
            while any(connection.urgent is not None for connection in control._sessions._connections):
                control._sessions.make_room()
        assert world.state() is State.STOPPING

    serve(path, script)


@pytest.mark.long
@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32))
def test_whatever_clients_do_the_budget_holds_and_nothing_is_left(tmp_path: Path, seed: int) -> None:
    rng, path = random.Random(seed), tmp_path / f"{seed}.sock"  # noqa: S311 - it decides on a test
    lines = [
        STATUS, b'{"op": "recording"}\n', b'{"op": "watch", "every": 1}\n', b'{"op": "arm"}\n', b'{"op": "stop"}\n',
        b'{"op": "move", "by": 1.0}\n', b'{"op"', b"x" * 5000, b"\n", b'{"op": "disarm"}\n', b'{"op": "release"}\n',
    ]  # fmt: skip

    async def script(world: World, control: ControlSocket) -> None:
        before, open_ones = descriptors(), list[socket.socket]()
        for _ in range(300):
            action = rng.randrange(6)
            one = rng.choice(open_ones) if open_ones else None
            with contextlib.suppress(OSError):
                if action <= 1 or one is None:
                    caller = socket.socket(socket.AF_UNIX)
                    caller.setblocking(False)
                    open_ones.append(caller)
                    caller.connect(str(path))
                elif action == 2:
                    one.send(rng.choice(lines) * rng.choice((1, 1, 3, 60)))
                elif action == 3:
                    one.shutdown(rng.choice((socket.SHUT_WR, socket.SHUT_RD, socket.SHUT_RDWR)))
                elif action == 4:
                    one.recv(1 << 16)
                else:
                    open_ones.remove(one)
                    one.close()
            if rng.random() < 0.3:
                await world.seconds(rng.choice((0.0, 0.01, 0.2)))
            assert len(control._sessions._connections) <= 64
            assert len(control._sessions._serving) <= 64 + 16  # in this turn let in, and gone again
        newcomer = await connect(path)
        assert await newcomer.ask(op="disarm")
        newcomer.die()
        for caller in open_ones:
            caller.close()
        await world.seconds(2.0)
        assert not len(control._sessions._connections)
        assert not control._sessions._serving
        assert descriptors() <= before
        assert world.service.shutdown.failure is None
        assert world.service.statistics.missed == 0

    serve(path, script)
