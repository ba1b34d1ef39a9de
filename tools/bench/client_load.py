"""Clients of the control socket that make work for the service: ``python -m tools.bench.client_load KIND``.

One process for all of them. It prints a line when they are connected, and goes on until it is ended. The fifty
operators are clients as the package has them; the others do what no client of ours does, and have the socket itself.
"""

import argparse
import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any, Final

from twostage_servo.api.requests import MoveRequest, RecordingRequest, Request, StatusRequest, WatchRequest
from twostage_servo.client.async_connection import AsyncConnection
from twostage_servo.client.errors import Refused

_CLIENTS: Final = 50
_INTERVAL_S: Final = 0.1
"""Each of the fifty asks ten times a second."""
_LONGEST_ANSWER_S: Final = 30.0
_BEYOND: Final = 1e8
"""A set-point beyond any limit: it is refused, and the measured axis stays on its way."""

_Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


async def never_reading_watcher(path: Path) -> None:
    """Ask for a snapshot on every tick, and read none of them."""
    async with _connected(path) as (_, writer):
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        _ask(writer, op="watch", every=1)
        print("ready", flush=True)
        await asyncio.Event().wait()


async def flooding_client(path: Path) -> None:
    """Ask for the status as quickly as the socket takes it, and read what comes."""
    async with _connected(path) as (reader, writer), asyncio.TaskGroup() as group:
        reading = group.create_task(_read_all(reader))
        print("ready", flush=True)
        while not reading.done():
            for _ in range(20):
                _ask(writer, op="status")
            await writer.drain()
            await asyncio.sleep(0)


async def connecting_client(path: Path) -> None:
    """Connect and leave, as quickly as the service lets one in."""
    print("ready", flush=True)
    while True:
        async with _connected(path):
            await asyncio.sleep(0)


async def fifty_clients(path: Path) -> None:
    """Fifty operators at once: some watch, some ask for the status, some ask for what is refused."""
    kinds = (StatusRequest(), MoveRequest(position=_BEYOND))
    with contextlib.ExitStack() as opened:
        connections = [AsyncConnection(path, _LONGEST_ANSWER_S) for _ in range(_CLIENTS)]
        for connection in connections:
            opened.callback(connection.close)
            await connection.open(_LONGEST_ANSWER_S)
        async with asyncio.TaskGroup() as group:
            for number, connection in enumerate(connections):
                if number % 5 == 0:
                    group.create_task(_keep_watching(connection))
                else:
                    request = RecordingRequest() if number == 1 else kinds[number % 2]
                    group.create_task(_keep_asking(connection, request, _INTERVAL_S * number / _CLIENTS))
            print("ready", flush=True)


async def _keep_watching(connection: AsyncConnection) -> None:
    async for _ in connection.snapshots(WatchRequest(every=10)):
        pass


async def _keep_asking(connection: AsyncConnection, request: Request, begin_s: float) -> None:
    loop = asyncio.get_running_loop()
    due_s = loop.time() + begin_s
    while True:
        await asyncio.sleep(due_s - loop.time())
        with contextlib.suppress(Refused):
            await connection.ask(request)
        due_s = max(due_s, loop.time() - _INTERVAL_S) + _INTERVAL_S


@contextlib.asynccontextmanager
async def _connected(path: Path) -> AsyncIterator[_Streams]:
    reader, writer = await asyncio.open_unix_connection(path)
    try:
        yield reader, writer
    finally:
        writer.transport.abort()


def _ask(writer: asyncio.StreamWriter, **request: Any) -> None:
    writer.write(json.dumps(request).encode("ascii") + b"\n")


async def _read_all(reader: asyncio.StreamReader) -> None:
    while await reader.read(1 << 16):
        pass


KINDS: Final[dict[str, Callable[[Path], Awaitable[None]]]] = {
    "never_reading_watcher": never_reading_watcher,
    "flooding_client": flooding_client,
    "connecting_client": connecting_client,
    "fifty_clients": fifty_clients,
}


def main() -> None:
    """Make work until the process is ended."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kind", choices=sorted(KINDS))
    parser.add_argument("--socket", type=Path, required=True)
    options = parser.parse_args()

    async def run() -> None:
        await KINDS[options.kind](options.socket)

    asyncio.run(run())


if __name__ == "__main__":
    main()
