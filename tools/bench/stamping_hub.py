"""A bus whose frames are stamped by the kernel as they come in, so that its own wake-ups are not in what is measured.

It speaks as much of the socketcand protocol as the package's own hub, on one channel. The kernel stamps a segment on
the loopback address within the call that sends it (SO_TIMESTAMPNS, socket(7)): the stamp is when the sender sent, to a
microsecond or so, as the stamp of a CAN board is when the frame was on the wire. It stands in the frame, in seconds of
the monotonic clock with nine decimals.
"""

import contextlib
import selectors
import socket
import struct
import time
from typing import Final

from tools.bench.plan import HOST

_SO_TIMESTAMPNS: Final = 35
"""asm-generic/socket.h; the control message that it brings has the same number."""
_TIMESPEC: Final = struct.Struct("qq")
_ROOM: Final = 256


class StampingHub:
    """The bus; :meth:`serve` never ends.

    Attributes
    ----------
    port
        The TCP port that was free.
    """

    def __init__(self) -> None:
        self._listener = socket.create_server((HOST, 0))
        self.port: int = self._listener.getsockname()[1]
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._nodes: set[_Node] = set()
        self._to_monotonic_ns = time.monotonic_ns() - time.time_ns()

    def serve(self) -> None:
        """Pass frames on for ever."""
        while True:
            for key, _ in self._selector.select():
                if key.data is None:
                    self._let_in()
                else:
                    self._read(key.data)

    def _let_in(self) -> None:
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        node = _Node(connection)
        self._nodes.add(node)
        self._selector.register(connection, selectors.EVENT_READ, node)
        node.tell(b"< hi >")

    def _read(self, node: "_Node") -> None:
        try:
            data, ancillary, _, _ = node.connection.recvmsg(65536, _ROOM)
        except OSError:
            data, ancillary = b"", []
        if not data:
            self._selector.unregister(node.connection)
            self._nodes.discard(node)
            node.connection.close()
            return
        stamp_ns = self._stamp_ns(ancillary)
        *tokens, node.rest = (node.rest + data).split(b">")
        for token in tokens:
            words = token.split()
            if words[1:2] == [b"send"]:
                frame = b"< frame %b %d.%09d %b >" % (words[2], *divmod(stamp_ns, 10**9), _packed(words[4:]))
                for other in self._nodes:
                    if other is not node and other.is_raw:
                        other.tell(frame)
            else:
                node.is_raw = node.is_raw or words[1:2] == [b"rawmode"]
                node.tell(b"< ok >")

    def _stamp_ns(self, ancillary: list[tuple[int, int, bytes]]) -> int:
        for level, kind, data in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, nanoseconds = _TIMESPEC.unpack_from(data)
                return int(seconds) * 10**9 + int(nanoseconds) + self._to_monotonic_ns
        return time.monotonic_ns()


class _Node:
    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.rest = b""
        self.is_raw = False

    def tell(self, data: bytes) -> None:
        """Send; who does not read loses frames, as on a bus."""
        with contextlib.suppress(OSError):
            self.connection.send(data)


def _packed(words: list[bytes]) -> bytes:
    return b"".join(word.rjust(2, b"0") for word in words).upper()
