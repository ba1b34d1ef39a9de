"""Requests that come too late: whoever asked may have given up, so only what brings an axis to rest is carried out."""

import asyncio
import contextlib
import json
import socket
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import structlog

from tests.service.operators import Json, connect, serve
from tests.service.rig import World
from twostage_servo.axis.state import State
from twostage_servo.service.background_server import Priority
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.service.listening_socket import BACKLOG, ListeningSocket
from twostage_servo.service.request_age import RequestAge, time_asleep_s
from twostage_servo.timing.virtual_clock import VirtualClockLoop, run

FREEZE_S = 8.0


def call(callers: contextlib.ExitStack, path: Path, *requests: dict[str, Any]) -> socket.socket:
    """Connect and ask, without a pass of the service's loop."""
    caller = callers.enter_context(socket.socket(socket.AF_UNIX))
    caller.setblocking(False)
    caller.connect(str(path))
    ask(caller, *requests)
    return caller


def ask(caller: socket.socket, *requests: dict[str, Any]) -> None:
    caller.sendall(b"".join(json.dumps(request).encode() + b"\n" for request in requests))


def said(caller: socket.socket) -> list[Json]:
    """Return what a caller has been answered so far."""
    with contextlib.suppress(BlockingIOError):
        return [json.loads(line) for line in caller.recv(1 << 20).splitlines()]
    return []


def freeze(seconds: float = FREEZE_S) -> None:
    """Let time pass in which nothing of the service runs, as while its process or its machine is stopped."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualClockLoop)
    loop._now_s += seconds


@pytest.mark.parametrize("known", [False, True], ids=["fresh connection", "old connection"])
def test_what_was_asked_while_the_service_stood_still_is_not_carried_out_when_nobody_is_there(
    path: Path, callers: contextlib.ExitStack, known: bool
) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        caller = call(callers, path, {"op": "status"}) if known else None
        await world.seconds(0.1)
        if caller is None:
            caller = call(callers, path, {"op": "arm"})  # while it stands still
        else:
            assert len(said(caller)) == 1
            ask(caller, {"op": "arm"})
        caller.close()
        freeze()
        await world.seconds(1.0)
        assert world.state() is State.DISARMED
        assert not world.drive.enabled
        assert world.requests.authority.holder is None

    with structlog.testing.capture_logs() as logs:
        serve(path, script)
    (dropped,) = [entry for entry in logs if entry["event"] == "request dropped: its client has disconnected"]
    assert dropped["op"] == "arm"


@pytest.mark.parametrize("shut", [False, True], ids=["waits", "half-closed"])
@pytest.mark.parametrize("known", [False, True], ids=["fresh connection", "old connection"])
def test_what_was_asked_while_the_service_stood_still_has_expired_even_if_somebody_waits(
    path: Path, callers: contextlib.ExitStack, known: bool, shut: bool
) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        await world.seconds(0.1)
        caller = call(callers, path)
        if known:
            await world.seconds(0.5)
        ask(caller, {"op": "arm"}, {"op": "status"})
        if shut:
            caller.shutdown(socket.SHUT_WR)
        freeze()
        await world.seconds(0.5)
        refused, status = said(caller)
        assert refused["error"]["code"] == "expired"
        assert "8.0 s" in refused["error"]["message"]
        assert (status["axis"]["state"], status["authority"]["holder"]) == ("disarmed", None)
        await world.until(lambda: world.axis.ready_to_arm)
        if not shut:
            ask(caller, {"op": "arm"})
            await world.seconds(0.5)
            assert said(caller)[0]["ok"]
            assert world.state() is State.HOLDING

    serve(path, script)


@pytest.mark.parametrize("how", ["waits", "half-closed", "gone"])
@pytest.mark.parametrize("op", ["stop", "disarm"])
def test_what_brings_the_axis_to_rest_is_carried_out_however_old_and_whoever_has_gone(
    path: Path, callers: contextlib.ExitStack, op: str, how: str
) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="move", position=400.0)
        await world.seconds(1.0)
        async with world.loop.parts.background.slot(Priority.REQUEST):  # the service is busy, and the axis goes on
            caller = call(callers, path, {"op": op})
            if how == "half-closed":
                caller.shutdown(socket.SHUT_WR)
            elif how == "gone":
                caller.close()
            await world.seconds(1.5)
            assert world.state() is State.SPEED_STAGE
        await world.seconds(0.02)
        assert world.state() in {State.STOPPING, State.DISARMING}
        if how != "gone":
            assert said(caller)[0]["ok"]

    serve(path, script)


@pytest.mark.parametrize("gone", [False, True])
def test_a_command_that_waited_behind_others_for_long_has_expired(
    path: Path, callers: contextlib.ExitStack, gone: bool
) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="release")
        async with world.loop.parts.background.slot(Priority.REQUEST):
            caller = call(callers, path, {"op": "move", "position": 50.0})
            await world.seconds(0.02 if gone else 1.5)
            if gone:
                caller.close()
        await world.seconds(0.5)
        assert world.state() is State.HOLDING
        if not gone:
            assert said(caller)[0]["error"]["code"] == "expired"
            await operator.done(op="move", position=50.0)  # nor has it acquired authority

    serve(path, script)


def test_a_command_that_waited_for_less_is_carried_out(path: Path, callers: contextlib.ExitStack) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        async with world.loop.parts.background.slot(Priority.REQUEST):
            caller = call(callers, path, {"op": "arm"})
            await world.seconds(0.9)
        await world.seconds(0.5)
        assert said(caller)[0]["ok"]
        assert world.state() is State.HOLDING

    serve(path, script)


async def prepared_slowly() -> Callable[[], None]:
    """Read a configuration again, which takes its time."""
    await asyncio.sleep(5.0)
    return lambda: None


def test_a_command_after_a_reload_is_not_as_old_as_the_reload(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        world.prepare = prepared_slowly
        operator = await connect(path)
        await operator.done(op="reload")
        await operator.done(op="arm")

    serve(path, script)


def test_a_command_behind_a_reload_has_waited_for_it(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        world.prepare = prepared_slowly
        operator = await connect(path)
        operator.writer.write(b'{"op": "reload"}\n{"op": "arm"}\n')
        assert (await operator.answer())["ok"]
        assert (await operator.answer())["error"]["code"] == "expired"

    serve(path, script)


def test_a_command_after_an_answer_that_was_read_slowly_is_not_as_old_as_that(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        await world.seconds(2.0)  # so that there is much to tell
        operator = await connect(path, limit=1 << 22)
        operator.writer.write(b'{"op": "recording"}\n' * 20)
        transport = operator.writer.transport
        transport.pause_reading()  # type: ignore[attr-defined]
        await world.seconds(3.0)
        transport.resume_reading()  # type: ignore[attr-defined]
        for _number in range(20):
            await operator.answer()
        await operator.done(op="arm")

    serve(path, script)


def test_a_line_that_is_written_slowly_is_as_old_as_its_end(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        for character in '{"op": "arm"}':
            operator.writer.write(character.encode())
            await world.seconds(0.5)
        assert (await operator.send(b""))["ok"]

    serve(path, script)


def test_requests_sent_in_one_go_are_as_old_as_their_coming(path: Path, callers: contextlib.ExitStack) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        caller = call(callers, path, {"op": "status"}, {"op": "arm"})
        await world.seconds(0.05)
        assert [answer["ok"] for answer in said(caller)] == [True, True]

    serve(path, script)


def test_in_a_queue_that_is_never_empty_nobody_is_older_than_those_let_in_one_queue_before(
    path: Path, callers: contextlib.ExitStack
) -> None:
    """Those who do nothing but connect make nobody else's request old."""

    async def main() -> None:
        listener = callers.enter_context(socket.socket(socket.AF_UNIX))
        listener.bind(str(path))
        listener.setblocking(False)
        listener.listen(BACKLOG)
        door, now_s = ListeningSocket(listener, RequestAge(0.01)), asyncio.get_running_loop().time
        queue: deque[float] = deque()
        for _ in range(300):
            with contextlib.suppress(BlockingIOError):
                while True:
                    call(callers, path).close()
                    queue.append(now_s())
            freeze(0.01)
            accepted = door.accept()
            assert accepted is not None
            callers.enter_context(accepted[0])
            age_s, came_s = now_s() - accepted[1], queue.popleft()
            assert accepted[1] <= came_s
            assert age_s <= 0.01 * (BACKLOG + 3)
        while accepted is not None:
            callers.enter_context(accepted[0])
            accepted = door.accept()
        freeze(5.0)
        call(callers, path)
        last = door.accept()
        assert last is not None
        callers.enter_context(last[0])
        assert now_s() - last[1] == pytest.approx(5.0)  # nothing more is known, so it counts from then

    run(main())


@pytest.mark.parametrize(("period_s", "longest_s"), [(0.001, 1.0), (0.01, 1.0), (0.1, 1.0), (0.2, 2.0)])
def test_the_age_at_which_a_command_expires(period_s: float, longest_s: float) -> None:
    assert RequestAge(period_s).longest_s == pytest.approx(longest_s)


def test_the_time_for_which_a_machine_sleeps_counts() -> None:
    asleep_s = 0.0

    async def main() -> None:
        nonlocal asleep_s
        age = RequestAge(0.01, lambda: asleep_s)
        before_s = age.now_s()
        asleep_s = 3600.0
        assert age.now_s() - before_s == 3600.0

    run(main())
    assert time_asleep_s() >= 0.0


def test_what_is_known_of_when_a_descriptor_was_looked_at() -> None:
    async def main() -> None:
        age = RequestAge(0.01)
        begun_s = age.now_s()
        assert age.was_empty_until_s(begun_s) is None
        for _ in range(3):
            await asyncio.sleep(0.01)
            age.tick()
        assert age.was_empty_until_s(begun_s) == pytest.approx(0.01)
        assert age.was_empty_until_s(0.015) is None  # which was watched from then on only
        age.tick()
        assert age.was_empty_until_s(0.015) == pytest.approx(0.02)

    run(main())
