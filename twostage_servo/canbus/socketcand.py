"""Client of a CAN bus that is served over TCP: by socketcand, or by this package's hub.

In place of python-can's own ``socketcand`` interface, which retries a refused connection as fast as it can for 10 s,
waits without limit for the greeting, fails when a frame follows the greeting closely, and does not notice that the
server has gone. It also sends with ``sendall``: when the server has stopped reading for so long that the send buffer is
full, that blocks the caller, here the tick, until the server reads again. This one drops
the frame.
"""

import contextlib
import select
import socket
import time
from typing import Any, Final

import can

_CONNECT_TIMEOUT_S: Final = 1.0
"""For the whole opening: a server that greets byte by byte has no more time than one that says nothing."""
_UNACKNOWLEDGED_LIMIT_MS: Final = 500
"""Longest that sent bytes may wait for an acknowledgement. A cut cable shows up here, and old commands die with it."""
_SEND_BUFFER_BYTES: Final = 32768
"""Room for a burst of some 50 frames; bounds the old commands that wait on a connection that stalls."""
_LONGEST_TOKEN: Final = 200
_ROOM: Final = 65536
_NONE: Final[tuple[can.Message | None, bytes, bool]] = None, b"", False


class SocketcandBus(can.BusABC):
    """One channel of a socketcand server, in raw mode.

    Parameters
    ----------
    channel
        Name of the CAN interface on the server.
    host, port
        Where the server listens.
    tcp_tune
        Send each frame at once instead of collecting several (TCP_NODELAY).
    can_filters
        As in :class:`can.BusABC`.

    Raises
    ------
    can.CanInitializationError
        When the server does not answer as it should within a second.
    OSError
        When there is no connection.
    """

    def __init__(
        self,
        channel: str,
        host: str = "127.0.0.1",
        port: int = 29536,
        tcp_tune: bool = True,
        can_filters: Any = None,
    ) -> None:
        self.channel_info = f"socketcand on {channel}@{host}:{port}"
        self._received = bytearray()
        self._is_drained = False
        self._prepared: dict[int, tuple[can.Message, bytes, bool]] = {}
        deadline_s = time.monotonic() + _CONNECT_TIMEOUT_S
        self._socket = socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT_S)
        try:
            self._greet(channel, deadline_s)
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNACKNOWLEDGED_LIMIT_MS)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, tcp_tune)
        except BaseException:
            self._socket.close()
            raise
        super().__init__(channel=channel, can_filters=can_filters)

    def _greet(self, channel: str, deadline_s: float) -> None:
        self._expect("< hi >", deadline_s)
        for command in (f"< open {channel} >", "< rawmode >"):
            self._socket.sendall(command.encode("ascii"))
            self._expect("< ok >", deadline_s)

    def _expect(self, answer: str, deadline_s: float) -> None:
        try:
            while (token := self._next_token()) is None:
                left_s = deadline_s - time.monotonic()
                if left_s <= 0.0:
                    raise TimeoutError  # noqa: TRY301
                self._socket.settimeout(left_s)
                self._append(self._socket.recv(256))
        except TimeoutError as error:
            text = f"expected {answer}, but no answer came within {_CONNECT_TIMEOUT_S:g} s of the connection's opening"
            raise can.CanInitializationError(text) from error
        if token != answer:
            raise can.CanInitializationError(f"expected {answer}, the answer was {token!r}")

    def _append(self, data: bytes) -> None:
        if not data:
            raise can.CanOperationError("the server closed the connection")
        self._received += data

    def _next_token(self) -> str | None:
        end = self._received.find(b">")
        if end < 0 and len(self._received) <= _LONGEST_TOKEN:
            return None
        if not 0 <= end <= _LONGEST_TOKEN:
            raise can.CanOperationError(f"not the socketcand protocol: {bytes(self._received[:_LONGEST_TOKEN])!r}")
        token = self._received[: end + 1].decode("ascii", "replace").strip()
        del self._received[: end + 1]
        return token

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if b">" not in self._received:
            if timeout != 0:
                select.select([self._socket], [], [], timeout)
            elif self._is_drained:  # by the last read: whoever drains the bus need not ask the kernel again
                self._is_drained = False
                return None, False
            with contextlib.suppress(BlockingIOError):
                data = self._socket.recv(_ROOM)
                self._append(data)
                self._is_drained = len(data) < _ROOM
        token = self._next_token()
        return (None if token is None else _parse(token, self.channel_info)), False

    def look_again(self) -> None:
        """Ask the kernel at the next read, whatever the last one has said: whoever drained the bus ended before."""
        self._is_drained = False

    def prepare(self, msg: can.Message) -> None:
        """Make the text of a data frame ready for :meth:`send`, which takes it if it is given the same message next.

        Whether the connection has room is asked here as well: between this and the sending nobody but this program
        fills it, and of one tick's frames there are a few.

        Raises
        ------
        can.CanOperationError
            When the frame is no classic data frame.
        """
        self._prepared[msg.arbitration_id] = msg, _text(msg), self._has_room()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - never waits
        """Hand a data frame to the TCP connection, without ever waiting.

        Raises
        ------
        can.CanTimeoutError
            When the send buffer is full; nothing of the frame was sent.
        can.CanOperationError
            When the connection broke, or the frame is no classic data frame.
        """
        prepared, text, has_room = self._prepared.pop(msg.arbitration_id, _NONE)
        if prepared is not msg:
            text, has_room = _text(msg), self._has_room()
        try:
            sent = self._socket.send(text) if has_room else 0
        except OSError as error:
            raise can.CanOperationError(f"cannot send: {error}") from error
        if not sent:
            raise can.CanTimeoutError("the send buffer is full")
        if sent < len(text):
            raise can.CanOperationError("the send buffer took a part of a frame only")

    def _has_room(self) -> bool:
        """Whether a third of the buffer is free, so that never a part of a frame is sent; see tcp(7)."""
        try:
            return bool(select.select([], [self._socket], [], 0)[1])
        except (OSError, ValueError):  # it is closed, which the sending will tell
            return True

    def fileno(self) -> int:
        """File descriptor of the connection, -1 when closed."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Close the connection."""
        super().shutdown()
        self._socket.close()


def _text(msg: can.Message) -> bytes:
    if msg.is_remote_frame or msg.is_error_frame or msg.is_fd:
        raise can.CanOperationError("only classic data frames can be sent over socketcand")
    identifier = f"{msg.arbitration_id:08X}" if msg.is_extended_id else f"{msg.arbitration_id:03X}"
    return f"< send {identifier} {len(msg.data)} {msg.data.hex(' ')} >".encode("ascii")


def _parse(token: str, server: str) -> can.Message:
    """Read ``< frame 181 12.345678 0102 >``, or the bus error ``< error 20000004 12.345678 >``."""
    words = token.split()
    try:
        kind, identifier, timestamp, *data = words[1:-1]
        number = int(identifier, 16)
        if words[0] != "<" or kind not in {"frame", "error"} or len(data) > (kind == "frame"):
            raise ValueError("unknown")  # noqa: TRY301
        return can.Message(
            timestamp=float(timestamp),
            arbitration_id=number & 0x1FFFFFFF,
            is_extended_id=len(identifier) != 3,
            is_error_frame=kind == "error",
            data=bytes.fromhex("".join(data)),
            check=True,
        )
    except ValueError as error:
        raise can.CanOperationError(f"{server} says {token!r}") from error
