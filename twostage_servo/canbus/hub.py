"""A CAN bus between processes of one machine: a server of the socketcand protocol on the loopback interface.

Any socketcand client can join, such as python-can's ``socketcand`` interface. Spoken is what one in raw mode needs::

    server  < hi >
    client  < open CHANNEL >                  server  < ok >
    client  < rawmode >                       server  < ok >
    client  < send 201 4 0 0 1 b2 >           server, to all others  < frame 201 12.345678 000001B2 >

Identifiers have 3 hexadecimal digits for 11 bits and 8 for 29. The time stamps are seconds of the hub's event loop.
"""

import asyncio
import ipaddress
import logging
import socket
from typing import Final

_log = logging.getLogger(__name__)

_LONGEST_TOKEN: Final = 100
_SETTLING_S: Final = 0.05
"""From the last answer of the greeting to the first frame: python-can takes the answer only if nothing follows in the
same read. What comes meanwhile is kept for so long."""
_LARGEST_BACKLOG_BYTES: Final = 65536
"""In the hub and again in the kernel: about 1500 frames each, a second of a busy bus that a client has not read."""


class Hub:
    """The server. Every channel name is a bus of its own, made by the first client that opens it.

    Parameters
    ----------
    host
        A loopback address, 127.0.0.1 or another of 127.0.0.0/8.
    port
        TCP port; 0 takes a free one.

    Attributes
    ----------
    port : int
        The port that is in use, once started.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 29536) -> None:
        self.host = "127.0.0.1" if host == "localhost" else host
        self.port = port
        self._server: asyncio.Server | None = None
        self._nodes: set[_Node] = set()

    async def start(self) -> None:
        """Begin to serve.

        Raises
        ------
        ValueError
            When the host is no IPv4 loopback address.
        OSError
            When the port is not free.
        """
        try:
            is_loopback = ipaddress.IPv4Address(self.host).is_loopback
        except ValueError:
            is_loopback = False
        if not is_loopback:
            raise ValueError(
                f"the hub serves this machine only: host {self.host!r} is not a loopback address, use 127.0.0.1"
            )
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Node(self._nodes, loop), self.host, self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """Drop all clients and end serving; does nothing when not started."""
        if self._server is None:
            return
        self._server.close()
        for node in tuple(self._nodes):
            node.transport.abort()
        await self._server.wait_closed()
        self._server = None


class _Node(asyncio.Protocol):
    """One client."""

    transport: asyncio.Transport

    def __init__(self, nodes: "set[_Node]", loop: asyncio.AbstractEventLoop) -> None:
        self._nodes = nodes
        self._loop = loop
        self._received = bytearray()
        self._channel: str | None = None
        self._is_raw = False
        self._early: list[bytes] | None = None  # frames that wait until the greeting has been read

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - what create_server hands over; for the type checker
        self.transport = transport
        self._name = "{}:{}".format(*transport.get_extra_info("peername"))
        # The kernel's buffer would grow to megabytes; beyond the limit of its own, asyncio calls pause_writing().
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _LARGEST_BACKLOG_BYTES)
        transport.set_write_buffer_limits(high=_LARGEST_BACKLOG_BYTES)
        self._nodes.add(self)
        transport.write(b"< hi >")

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - asyncio's signature
        self._nodes.discard(self)

    def pause_writing(self) -> None:
        _log.warning("hub: client %s on channel %s does not read, dropped", self._name, self._channel)
        self._is_raw = False
        self.transport.abort()

    def data_received(self, data: bytes) -> None:
        self._received += data
        try:
            while (end := self._received.find(b">")) >= 0 and not self.transport.is_closing():
                words = self._received[: end + 1].decode("ascii").split()
                del self._received[: end + 1]
                self._obey(words)
            if len(self._received) > _LONGEST_TOKEN:
                raise ValueError(f"no end within {_LONGEST_TOKEN} bytes")  # noqa: TRY301
        except ValueError as error:
            _log.warning("hub: client %s on channel %s sent invalid data, closed: %s", self._name, self._channel, error)
            self._is_raw = False
            self.transport.write(f"< error {error} >".encode("ascii", "replace"))
            self.transport.close()

    def _obey(self, words: list[str]) -> None:
        match words:
            case ["<", "open", channel, ">"] if self._channel is None:
                self._channel = channel
                self.transport.write(b"< ok >")
            case ["<", "rawmode", ">"] if self._channel is not None:
                self._is_raw = True
                self.transport.write(b"< ok >")
                self._early = []
                self._loop.call_later(_SETTLING_S, self._catch_up)
            case ["<", "send", identifier, length, *data, ">"] if self._is_raw:
                self._send(identifier, length, data)
            case _:
                raise ValueError(f"unexpected {' '.join(words)[:40]!r}".replace(">", ")").replace("<", "("))

    def _catch_up(self) -> None:
        early, self._early = self._early or [], None
        if early and self._is_raw and not self.transport.is_closing():
            self.transport.write(b"".join(early))

    def _hear(self, frame: bytes) -> None:
        if self._early is None:
            self.transport.write(frame)
        else:
            self._early.append(frame)

    def _send(self, identifier: str, length: str, data: list[str]) -> None:
        number, payload = int(identifier, 16), bytes(int(byte, 16) for byte in data)
        is_extended = len(identifier) == 8
        if not 0 <= number <= (0x1FFFFFFF if is_extended else 0x7FF) or len(identifier) not in {3, 8}:
            raise ValueError(f"identifier {identifier[:10]} is neither 3 nor 8 digits in range")
        if len(payload) != int(length, 16) or len(payload) > 8:
            raise ValueError(f"length {length[:10]} with {len(payload)} bytes")
        frame = f"< frame {number:0{len(identifier)}X} {self._loop.time():.6f} {payload.hex().upper()} >".encode(
            "ascii"
        )
        for node in tuple(self._nodes):
            if node is not self and node._is_raw and node._channel == self._channel:  # noqa: SLF001
                node._hear(frame)  # noqa: SLF001
