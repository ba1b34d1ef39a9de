"""One blocking connection to a service: the protocol on a socket."""

import math
import socket
import struct
from _thread import allocate_lock  # threading takes a while to import
from collections.abc import Iterator
from pathlib import Path

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import Request, WatchRequest
from twostage_servo.api.socket_trust import check_server, find_distrust
from twostage_servo.api.status import Status
from twostage_servo.client.errors import ConfigError, Reason, ServoError, Unreachable
from twostage_servo.client.protocol import Protocol, checked, longest_wait_s, status_in

AT_ONCE = 1 << 16
"""Bytes taken from a socket at a time."""


class Connection:
    """A connection, over which one thread at a time asks.

    Parameters
    ----------
    path
        Path of the control socket.
    timeout_s
        Longest wait for the connection, and for an answer.

    Attributes
    ----------
    reconnected
        How often it was made anew.

    Raises
    ------
    ServoError
        If nobody answers there, or who does is not to be trusted.
    """

    def __init__(self, path: Path, timeout_s: float) -> None:
        self.path = path
        self.reconnected = 0
        self._timeout_s = timeout_s
        self._lock = allocate_lock()
        self._open(timeout_s)

    def _open(self, within_s: float) -> None:
        self._socket = connected(self.path, within_s)
        self._socket.settimeout(self._timeout_s)
        self._protocol = Protocol(self.path)

    def reconnect(self, within_s: float) -> None:
        """Connect anew within a time (s)."""
        with self._lock:
            self._socket.close()
            self._open(within_s)
            self.reconnected += 1

    def close(self) -> None:
        """End the connection."""
        self._socket.close()

    def fileno(self) -> int:
        """File descriptor of the connection, for ``select``."""
        return self._socket.fileno()

    def ask(self, request: Request, patience_s: float | None = None) -> JsonObject:
        """Send a request and return its answer; snapshots that come before are kept.

        Raises
        ------
        ServoError
            If it is refused, or the service does not answer in time.
        """
        with self._lock:
            self._socket.settimeout(self._timeout_s if patience_s is None else patience_s)
            number, line = self._protocol.send(request)
            try:
                self._socket.sendall(line)
            except (BrokenPipeError, ConnectionResetError):
                pass  # what was said last, before the connection was closed, is still to be read
            except OSError as error:
                raise self._failed(error) from error
            while (answer := self._protocol.answer_to(number)) is None:
                self._receive()
            return answer

    def snapshots(self, watch: WatchRequest) -> Iterator[Status]:
        """Yield a snapshot every so many ticks."""
        self.ask(watch)
        self._socket.settimeout(longest_wait_s(self._timeout_s, watch))
        while True:
            while not (kept := self._protocol.snapshots):
                self._receive()
            yield status_in(checked(kept.popleft()), self.path)

    def drain(self) -> list[JsonObject]:
        """Return the snapshots that have come, without waiting.

        Raises
        ------
        Unreachable
            If the service is gone.
        """
        with self._lock:
            self._socket.settimeout(0.0)
            try:
                while True:
                    self._protocol.receive(self._socket.recv(AT_ONCE))
            except BlockingIOError:
                pass
            except OSError as error:
                raise self._failed(error) from error
            return self.kept()

    def kept(self) -> list[JsonObject]:
        """Return the snapshots that have come with answers."""
        snapshots = list(self._protocol.snapshots)
        self._protocol.snapshots.clear()
        return snapshots

    def _receive(self) -> None:
        try:
            data = self._socket.recv(AT_ONCE)
        except OSError as error:
            raise self._failed(error) from error
        self._protocol.receive(data)

    def _failed(self, error: OSError) -> ServoError:
        return self._protocol.silent() if isinstance(error, TimeoutError) else self._protocol.lost(error)


def connected(path: Path, within_s: float, *, wait: bool = True) -> socket.socket:
    """Return a socket that is connected to a service which is to be trusted.

    Parameters
    ----------
    path
        Path of the control socket.
    within_s
        Longest wait, s.
    wait
        Whether to wait where others are waiting to be let in.

    Raises
    ------
    BlockingIOError
        If others are waiting, and this one shall not.
    ServoError
        If nobody answers there, or who does is not to be trusted.
    """
    stream = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if wait:
            _connect(stream, path, within_s)
        else:
            stream.setblocking(False)
            stream.connect(str(path))
        check_server(stream, path)
    except OSError as error:
        is_open = _is_connected(stream)
        stream.close()
        if isinstance(error, BlockingIOError) and not wait:
            raise
        raise (_untrusted(path, error) if is_open else _nobody(path, error, within_s)) from error
    except BaseException:
        stream.close()
        raise
    return stream


def _connect(stream: socket.socket, path: Path, within_s: float) -> None:
    """Connect within a time, also where others are waiting to be let in.

    A socket that never waits is refused at once, with EAGAIN, while the queue of those who wait is full. The kernel's
    own wait is served first come, first served; a later attempt of our own would compete with whoever else tries.
    """
    seconds, rest_s = divmod(within_s, 1.0)
    wait = struct.pack("@ll", int(seconds), min(999_999, math.ceil(1e6 * rest_s)))
    stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, wait)
    stream.connect(str(path))


def _is_connected(stream: socket.socket) -> bool:
    try:
        stream.getpeername()
    except OSError:
        return False
    return True


def _nobody(path: Path, error: OSError, within_s: float) -> ServoError:
    if not isinstance(error, PermissionError) and path.exists() and not path.is_socket():
        return ConfigError(f"{path} is not a socket")
    if distrust := find_distrust(path):
        return _untrusted(path, distrust)
    hint = {
        FileNotFoundError: "is the service running? Start it with `twostage-servo run --config FILE`, "
        "or name its socket with --socket",
        ConnectionRefusedError: "the service that made this socket has ended; start it again",
        BlockingIOError: f"other clients keep connecting, and {within_s:g} s were not enough; `ss -xp` shows them",
        PermissionError: "you may not use it; its owner and group may, if they may enter its folder",
    }.get(type(error), str(error))
    return Unreachable(Reason.NO_SERVICE, f"no service answers at {path}: {hint}")


def _untrusted(path: Path, error: OSError) -> Unreachable:
    return Unreachable(Reason.UNTRUSTED, f"the socket {path} is not used: {error}")
