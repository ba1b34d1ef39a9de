"""Operators at the control socket: real connections to the real service, in simulated time."""

import asyncio
import contextlib
import json
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from tests.service.rig import World, simulate
from twostage_servo.service.control_socket import ControlSocket

Json = dict[str, Any]

STATUS = b'{"op": "status"}\n'

_operators: list["Operator"] = []


class Operator:
    """A client that speaks raw lines."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def send(self, line: bytes) -> Json:
        self.writer.write(line + b"\n")
        return await self.answer()

    async def ask(self, **request: object) -> Json:
        return await self.send(json.dumps(request).encode())

    async def done(self, **request: object) -> Json:
        """Ask for what has to be carried out."""
        answer = await self.ask(**request)
        assert answer["ok"], answer
        return answer

    async def refused(self, **request: object) -> str:
        """Ask for what has to be refused; return the code."""
        answer = await self.ask(**request)
        assert not answer["ok"], answer
        code: str = answer["error"]["code"]
        return code

    async def answer(self) -> Json:
        line = await self.reader.readline()
        assert line.endswith(b"\n"), "the connection was closed"
        answer: Json = json.loads(line)
        return answer

    def die(self) -> None:
        self.writer.transport.abort()


def serve(path: Path, script: Callable[[World, ControlSocket], Awaitable[None]], *overrides: str) -> None:
    """Run service, drive and control socket in simulated time until the script ends."""

    async def main(world: World) -> None:
        control = world.loop.control_socket(path)
        await control.start()
        try:
            await world.until(lambda: world.axis.ready_to_arm)
            await script(world, control)
        finally:
            await control.stop()
            for operator in _operators:
                operator.die()
            _operators.clear()
            await world.seconds(0.01)

    simulate(main, *overrides)


async def connect(path: Path, limit: int = 1 << 16) -> Operator:
    operator = Operator(*await asyncio.open_unix_connection(str(path), limit=limit))
    _operators.append(operator)
    return operator


async def call(callers: contextlib.ExitStack, path: Path, data: bytes = b"") -> socket.socket:
    """Connect with a socket that never waits, and say something."""
    caller = callers.enter_context(socket.socket(socket.AF_UNIX))
    caller.setblocking(False)
    while True:
        with contextlib.suppress(BlockingIOError):
            caller.connect(str(path))
            break
        await asyncio.sleep(0.001)
    await say(caller, data)
    return caller


async def say(caller: socket.socket, data: bytes) -> None:
    """Say all of it, however often the kernel has to be asked."""
    while data:
        try:
            data = data[caller.send(data) :]
        except BlockingIOError:
            await asyncio.sleep(0.001)


async def read_all(caller: socket.socket) -> list[Json]:
    """Return what is said until the other side ends."""
    data = b""
    while True:
        try:
            piece = caller.recv(1 << 16)
        except BlockingIOError:
            await asyncio.sleep(0.001)
            continue
        if not piece:
            return [json.loads(line) for line in data.splitlines()]
        data += piece
