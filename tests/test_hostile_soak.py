"""The soak under hostile clients: its verdict can fail, its gate does what it says, and its clients are a nuisance."""

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from tests.service.operators import serve
from tools.soak import hostile
from tools.soak.hostile_clients import HostileClients
from tools.soak.hostile_processes import HostileProcesses
from tools.soak.hub_gate import HubGate, Mode
from twostage_servo.api.requests import StopRequest
from twostage_servo.client.async_connection import AsyncConnection
from twostage_servo.client.errors import Refused

HELD = {"descriptors": 8, "tasks": 4, "threads": 4, "resident_mb": 80.0}


def verdict(folder: Path, **at_the_end: float) -> dict[str, Any]:
    run = hostile.Hostility(folder, 1)
    run.held = [{"when": "", **HELD}, {"when": "", **HELD}, {"when": "", **HELD, **at_the_end}]
    return hostile.summarise(run, 1, 60.0)


@pytest.mark.parametrize(
    ("at_the_end", "broken"),
    [
        ({}, []),
        ({"descriptors": 7, "resident_mb": 80.9}, []),
        ({"descriptors": 9}, ["1 more descriptors than after the warm-up"]),
        ({"tasks": 6}, ["2 more tasks than after the warm-up"]),
        ({"threads": 5}, ["1 more threads than after the warm-up"]),
        ({"resident_mb": 81.5}, ["1.5 more resident_mb than after the warm-up"]),
    ],
)
def test_what_is_held_at_the_end_is_compared(tmp_path: Path, at_the_end: dict[str, float], broken: list[str]) -> None:
    summary = verdict(tmp_path, **at_the_end)
    assert summary["broken"] == broken
    assert json.loads(json.dumps(summary)) == summary
    assert ("BROKEN" in hostile.as_text(summary)) is bool(broken)


def test_a_run_that_did_not_come_to_a_comparison_is_broken(tmp_path: Path) -> None:
    summary = hostile.summarise(hostile.Hostility(tmp_path, 1), 1, 1.0)
    assert summary["broken"] == ["it did not come to a comparison"]


def test_what_the_clients_did_is_added_up_over_all_that_were_killed(tmp_path: Path) -> None:
    (tmp_path / "counts-1.json").write_text('{"abort": 3, "read": 1}', encoding="utf-8")
    (tmp_path / "counts-2.json").write_text('{"abort": 4}', encoding="utf-8")
    assert HostileProcesses(tmp_path).counts() == {"abort": 7, "read": 1}


async def through(script: Callable[[HubGate], Awaitable[None]]) -> None:
    async def hub(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"< hi >")
        writer.write(await reader.read(100))
        await reader.read()
        writer.close()

    server = await asyncio.start_server(hub, "127.0.0.1", 0)
    gate = HubGate(server.sockets[0].getsockname()[1])
    await gate.set_mode(Mode.OPEN)
    try:
        await script(gate)
    finally:
        await gate.set_mode(Mode.SHUT)
        server.close()


def test_an_open_gate_lets_both_through_and_a_shut_one_cuts_off() -> None:
    async def script(gate: HubGate) -> None:
        port = gate.port
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"echo")
        assert await reader.readexactly(10) == b"< hi >echo"
        await gate.set_mode(Mode.SHUT)
        assert await reader.read() == b""
        writer.close()
        with pytest.raises(ConnectionRefusedError):
            await asyncio.open_connection("127.0.0.1", port)
        await gate.set_mode(Mode.OPEN)
        assert gate.port == port
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        assert await reader.readexactly(6) == b"< hi >"
        writer.close()

    asyncio.run(through(script))


def test_a_slow_hub_greets_byte_by_byte_and_a_silent_one_never() -> None:
    async def script(gate: HubGate) -> None:
        gate.slow_pause_s = 0.001
        await gate.set_mode(Mode.SLOW)
        reader, writer = await asyncio.open_connection("127.0.0.1", gate.port)
        assert await reader.readexactly(6) == b"< hi >"
        writer.close()
        await gate.set_mode(Mode.SILENT)
        reader, writer = await asyncio.open_connection("127.0.0.1", gate.port)
        writer.write(b"hello")
        await writer.drain()
        waiting = asyncio.ensure_future(reader.read(1))
        await gate.set_mode(Mode.OPEN)  # cuts it off, before anything has come
        (heard,) = await asyncio.gather(waiting, return_exceptions=True)
        assert heard == b"" or isinstance(heard, ConnectionError)
        writer.close()

    asyncio.run(through(script))


@pytest.mark.parametrize(
    "name",
    ["operate", "read", "read_nothing", "connect_in_a_loop", "half_close", "send_heavy_lines", "send_garbage", "abort",
     "crowd", "ask_in_a_row"],
)  # fmt: skip
def test_each_character_leaves_a_service_that_serves_and_misses_no_tick(tmp_path: Path, name: str) -> None:
    path = tmp_path / "control.sock"

    async def script(world: Any, _: object) -> None:
        clients = HostileClients(str(path), 7)
        for _again in range(3):
            try:
                await asyncio.wait_for(getattr(clients, name)(), 10.0)
            except (OSError, TimeoutError, ValueError, asyncio.IncompleteReadError):
                clients.counts["cut off"] += 1
        await world.seconds(2.0)
        connection = AsyncConnection(path, 10.0)
        await connection.open(10.0)
        with contextlib.suppress(Refused):
            await connection.ask(StopRequest())
        connection.close()
        assert world.service.statistics.missed == 0

    serve(path, script)
