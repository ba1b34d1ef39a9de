"""A socketcand server at a simulated bus, without a socket: the client's own code runs in simulated time."""

import socket
from typing import Any

import can
import pytest

from twostage_servo.canbus import socketcand
from twostage_servo.simulation.bus import Wire


class TextConnection:
    """The client's end of a connection to the server; it hands over whatever has arrived at a node of the wire.

    Parameters
    ----------
    bus
        The server's place on the wire.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._greeting = [b"< hi >"]
        self._unread = bytearray()
        self._free, self._other = socket.socketpair()  # for select(), which wants a descriptor that has room

    def recv(self, size: int) -> bytes:
        if self._greeting:
            return self._greeting.pop(0)
        while len(self._unread) < size and (frame := self._bus.recv(0)) is not None:
            text = f"< frame {frame.arbitration_id:03X} {frame.timestamp:.6f} {frame.data.hex()} >"
            self._unread += text.encode("ascii")
        if not self._unread:
            raise BlockingIOError
        data = bytes(self._unread[:size])
        del self._unread[:size]
        return data

    def sendall(self, data: bytes) -> None:
        assert data.startswith((b"< open ", b"< rawmode "))
        self._greeting.append(b"< ok >")

    def send(self, data: bytes) -> int:
        _, kind, number, _, *octets, _ = data.decode("ascii").split()
        assert kind == "send"
        payload = bytes(int(octet, 16) for octet in octets)
        self._bus.send(can.Message(arbitration_id=int(number, 16), is_extended_id=False, data=payload))
        return len(data)

    def fileno(self) -> int:
        return self._free.fileno()

    def close(self) -> None:
        self._bus.shutdown()
        self._free.close()
        self._other.close()

    def settimeout(self, timeout_s: float | None) -> None:
        """There is nothing to wait for."""

    def setblocking(self, blocking: bool) -> None:
        assert not blocking

    def setsockopt(self, *_: Any) -> None:
        """It has no options."""


def socketcand_at(wire: Wire, name: str) -> can.BusABC:
    """Open the client's bus to a server at a node of the wire."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket, "create_connection", lambda *_, **__: TextConnection(wire.attach(name)))
        return socketcand.SocketcandBus("can0")
