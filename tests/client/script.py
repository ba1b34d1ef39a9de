"""A service whose answers are written before they are asked for, at a real socket."""

import copy
import functools
import json
import socket
from pathlib import Path
from typing import Any

from tests.service.rig import World, simulate
from twostage_servo.client.blocking import ServoClient
from twostage_servo.client.connection import Connection


@functools.cache
def _told() -> str:
    async def script(world: World) -> str:
        await world.until(lambda: world.axis.ready_to_arm)
        return json.dumps(world.loop.snapshot())

    return simulate(script)


def status(**changes: Any) -> dict[str, Any]:
    """Return what a service tells of a disarmed axis; what is given takes the place of parts of a group."""
    told: dict[str, Any] = copy.deepcopy(json.loads(_told()))
    for name, change in changes.items():
        told[name] = told[name] | change if isinstance(told[name], dict) and isinstance(change, dict) else change
    return told


def done(**changes: Any) -> dict[str, Any]:
    """Return the answer to a request that was carried out."""
    return {"ok": True} | status(**changes)


def snapshot(**changes: Any) -> dict[str, Any]:
    """Return what a watcher is told."""
    return {"event": "snapshot"} | status(**changes)


def refused(code: str) -> dict[str, Any]:
    """Return the answer to a request that was not carried out."""
    return {"ok": False, "error": {"code": code, "message": f"it is {code}"}}


def lines(*answers: object) -> bytes:
    """Return answers as they are sent."""
    return b"".join(json.dumps(answer).encode() + b"\n" for answer in answers)


class Script:
    """The service."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._connection: socket.socket | None = None

    def connect(self, axis: str | None = None, timeout_s: float = 5.0) -> ServoClient:
        client = ServoClient(self.path, axis, timeout_s)
        self._connection, _ = self._listener.accept()
        return client

    def connection_of(self, timeout_s: float = 5.0) -> Connection:
        connection = Connection(self.path, timeout_s)
        self._connection, _ = self._listener.accept()
        return connection

    def accept(self) -> socket.socket:
        """Let the next one in."""
        return self._listener.accept()[0]

    @property
    def connection(self) -> socket.socket:
        assert self._connection is not None
        return self._connection

    def answers(self, *answers: object) -> None:
        self.connection.sendall(lines(*answers))

    def asked(self) -> list[Any]:
        """Return what has been asked so far."""
        self.connection.setblocking(False)
        received = b""
        try:
            while piece := self.connection.recv(65536):
                received += piece
        except BlockingIOError:
            pass
        finally:
            self.connection.setblocking(True)
        assert received.endswith(b"\n") or not received
        return [json.loads(line) for line in received.splitlines()]

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._listener.close()
