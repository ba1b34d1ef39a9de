"""A crowd at the control socket: who is turned away is told, and in how few lines of the log."""

import asyncio
import contextlib
import json
import os
import socket
from pathlib import Path

import pytest
import structlog

from tests.service.operators import STATUS, call, connect, serve
from tests.service.rig import World
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.service.newcomers import MOST_SILENT


def heard(caller: socket.socket) -> list[dict[str, dict[str, str]]]:
    return [json.loads(line) for line in caller.recv(1 << 16).splitlines()]


def test_of_too_many_silent_ones_the_oldest_is_turned_away_and_told_why(
    path: Path, callers: contextlib.ExitStack
) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        crowd = []
        for _number in range(MOST_SILENT + 3):
            crowd.append(await call(callers, path))
            await world.seconds(0.01)
        await world.seconds(0.5)
        for one in crowd[:3]:
            (told,) = heard(one)
            assert told["error"]["code"] == "too_many_clients"
            assert "too many others wait for a place. Connect again" in told["error"]["message"]
            assert one.recv(1) == b""
        for one in crowd[3:]:
            with pytest.raises(BlockingIOError):
                one.recv(1)
        await world.seconds(1.0)
        await call(callers, path)
        await world.seconds(0.1)

    with structlog.testing.capture_logs() as logs:
        serve(path, script)
    told = [line for line in logs if line["event"] == "connections were refused: all places are taken"]
    me = f"pid {os.getpid()} uid {os.getuid()}"
    assert told == [
        {**told[0], "log_level": "warning", "room": "control_socket", "newest": f"{me} #1", "number": 1},
        {**told[0], "newest": f"{me} #4", "number": 3},  # those of the second before, too
    ]


def test_a_silent_one_that_speaks_just_as_he_would_have_to_go_is_heard(
    path: Path, callers: contextlib.ExitStack
) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        one = await call(callers, path)
        await world.seconds(0.05)
        assert control._admission is not None
        newcomers = control._admission.newcomers
        assert newcomers is not None
        assert len(newcomers) == 1
        one.send(STATUS)
        assert control._admission._shed_silent()
        await world.seconds(0.05)
        assert heard(one)[0]["ok"]
        other = await call(callers, path)
        await world.seconds(0.05)
        other.close()
        assert control._admission._shed_silent()  # he has left: that is no reason for a line in the log
        assert not control._admission._shed_silent()

    with structlog.testing.capture_logs() as logs:
        serve(path, script)
    assert not [line for line in logs if line["log_level"] == "warning" and line.get("room") == "control_socket"]


def test_where_all_places_are_taken_wave_after_wave_finds_one(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        for _number in range(64):
            await (await connect(path)).done(op="status")
        for _wave in range(3):
            asking = [asyncio.create_task((await connect(path)).ask(op="status")) for _ in range(5)]
            await world.seconds(0.2)
            assert all(task.done() and task.result()["ok"] for task in asking)

    serve(path, script)


def test_who_leaves_without_a_word_is_no_client_at_all(path: Path, callers: contextlib.ExitStack) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        at_once = await call(callers, path)
        at_once.close()
        later = await call(callers, path)
        await world.seconds(0.05)
        later.close()
        await world.seconds(0.05)
        assert control._admission is not None
        newcomers = control._admission.newcomers
        assert newcomers is not None
        assert len(newcomers) == 0
        assert not control._sessions._serving

    with structlog.testing.capture_logs() as logs:
        serve(path, script)
    assert not [line for line in logs if line.get("room") == "control_socket"]
