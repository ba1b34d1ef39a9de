"""A client of the control socket, on plain blocking sockets and the standard library alone."""

import contextlib
import json
import math
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from twostage_servo.api.socket_trust import check_server, find_distrust
from twostage_servo.cli.output import CommandError, ExitCode

Answer = dict[str, Any]

_LONGEST_TICK_S = 0.1
_PARTING_S = 1.0
_READING = frozenset({"status", "watch", "recording"})
_REPEATED = frozenset({"stop", "disarm"})
"""Asked for again where the connection ends without an answer: asked twice they do no more than once."""
_WITHOUT_ANSWER = frozenset({"too_many_clients", "connection_lost"})
_PAUSE_S = 0.002
_OF_ALL = frozenset({"release", "acquire", "preempt", "reload"})
BAD_USAGE = frozenset({"bad_request", "position_limit", "velocity_limit", "which_axis"})
"""Refusals for which the request alone is to blame, whatever the axis does."""
_WITHOUT_PLACE = frozenset({"arm", "jog"})
"""Requests that name no position: one that is beyond the limits is the axis' own."""


class Client:
    """One connection to a service.

    Parameters
    ----------
    path
        Path of the control socket.
    timeout_s
        Longest wait for an answer.
    axis
        Name of the axis that the requests concern, if they name one.

    Attributes
    ----------
    repeated
        How often a `stop` or a `disarm` was asked for again, over a connection anew.
    """

    def __init__(self, path: Path, timeout_s: float = 5.0, axis: str | None = None) -> None:
        self.path = path
        self._named = {} if axis is None else {"axis": axis}
        self._timeout_s = timeout_s
        self._has_commanded = False
        self.repeated = 0
        self._open(timeout_s)

    def _open(self, timeout_s: float) -> None:
        """Connect within a time.

        Raises
        ------
        CommandError
            If nobody answers there, or who does is not to be trusted.
        """
        path = self.path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            _connect(self._socket, path, timeout_s)
        except OSError as error:
            self._socket.close()
            if not isinstance(error, PermissionError) and path.exists() and not path.is_socket():
                raise CommandError(ExitCode.USAGE, "usage", f"{path} is not a socket") from error
            if distrust := find_distrust(path):
                raise _untrusted(path, distrust) from error
            hint = {
                FileNotFoundError: "is the service running? Start it with `twostage-servo run --config FILE`, "
                "or name its socket with --socket",
                ConnectionRefusedError: "the service that made this socket has ended; start it again",
                BlockingIOError: f"others connect to it all of the time, and {timeout_s:g} s were not enough; "
                "`ss -xp` shows them",
                PermissionError: "you may not use it; its owner and group may, if they may enter its folder",
            }.get(type(error), str(error))
            raise CommandError(ExitCode.UNREACHABLE, "unreachable", f"no service answers at {path}: {hint}") from error
        try:
            check_server(self._socket, path)
        except OSError as error:
            self._socket.close()
            raise _untrusted(path, error) from error
        self._lines = self._socket.makefile("rb")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._has_commanded:
            # Leaving on purpose is not dying: what was asked for goes on without us.
            self._socket.settimeout(_PARTING_S)
            with contextlib.suppress(CommandError):
                self.request(op="release")
        self.close()

    def close(self) -> None:
        """End the connection without giving the lease back: what was commanded follows `service.holder_lost`."""
        self._lines.close()
        self._socket.close()

    def request(self, **fields: Any) -> Answer:
        """Send one request and return its answer. A `stop` or `disarm` whose connection ends is asked for again.

        Raises
        ------
        CommandError
            If the service refuses it or does not answer.
        """
        self._has_commanded = self._has_commanded or fields.get("op") not in _READING
        if fields["op"] not in _OF_ALL:
            fields |= self._named
        end_s = time.monotonic() + self._timeout_s
        while True:
            try:
                return self._ask(fields)
            except CommandError as error:
                if fields["op"] not in _REPEATED or error.code not in _WITHOUT_ANSWER:
                    raise
                self._connect_again(end_s, error)

    def _connect_again(self, end_s: float, why: CommandError) -> None:
        """Connect anew before a time; raise what made it necessary where that is not possible."""
        self.close()
        time.sleep(_PAUSE_S)
        left_s = end_s - time.monotonic()
        if left_s <= 0.0:
            raise why
        try:
            self._open(left_s)
        except CommandError as error:
            raise why from error
        self._socket.settimeout(self._timeout_s)
        self.repeated += 1

    def _ask(self, fields: Answer) -> Answer:
        try:
            self._socket.sendall(json.dumps(fields, allow_nan=False).encode() + b"\n")
        except ValueError as error:
            raise CommandError(ExitCode.USAGE, "bad_request", "a number must be finite") from error
        except (BrokenPipeError, ConnectionResetError):
            pass  # what was said last, before the connection was closed, is still to be read
        except OSError as error:
            raise self._lost(error) from error
        answer = self._read()
        while answer.get("event"):  # snapshots that were under way
            answer = self._read()
        _raise_failure(answer, fields["op"])
        return answer

    def be_patient(self, timeout_s: float) -> None:
        """Wait for answers for so long (s) from here on: for what takes the service longer than a few ticks."""
        self._timeout_s = timeout_s
        self._socket.settimeout(timeout_s)

    def watch(self, every: int) -> Iterator[Answer]:
        """Yield a snapshot every so many ticks."""
        self.request(op="watch", every=every)
        self._socket.settimeout(self._timeout_s + every * _LONGEST_TICK_S)
        while True:
            snapshot = self._read()
            _raise_failure(snapshot)
            del snapshot["event"]
            yield snapshot

    def _read(self) -> Answer:
        try:
            line = self._lines.readline()
        except TimeoutError as error:
            text = f"the service at {self.path} does not answer: it hangs, or its machine is overloaded"
            raise CommandError(ExitCode.UNREACHABLE, "no_answer", text) from error
        except OSError as error:
            raise self._lost(error) from error
        if not line.endswith(b"\n"):
            raise self._lost("the connection was closed")
        answer: Answer = json.loads(line)
        return answer

    def _lost(self, error: object) -> CommandError:
        return CommandError(ExitCode.UNREACHABLE, "connection_lost", f"the service at {self.path} is gone: {error}")


def _untrusted(path: Path, error: OSError) -> CommandError:
    return CommandError(ExitCode.UNREACHABLE, "untrusted_socket", f"the socket {path} is not used: {error}")


def _connect(stream: socket.socket, path: Path, timeout_s: float) -> None:
    """Connect within a time, also where others are waiting to be let in.

    A socket that never waits is refused at once, with EAGAIN, while the queue of those who wait is full. The kernel's
    own wait is served first come, first served; a later attempt of our own would compete with whoever else tries.
    """
    seconds, rest_s = divmod(timeout_s, 1.0)
    wait = struct.pack("@ll", int(seconds), min(999_999, math.ceil(1e6 * rest_s)))
    stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, wait)
    stream.connect(str(path))
    stream.settimeout(timeout_s)


def _raise_failure(answer: Answer, op: str = "") -> None:
    """Raise what a failure says, of what was asked for; let any other line pass."""
    if answer.get("ok", True):
        return
    failure = answer["error"]
    of_the_axis = op in _WITHOUT_PLACE and failure["code"] == "position_limit"
    code = ExitCode.USAGE if failure["code"] in BAD_USAGE and not of_the_axis else ExitCode.FAILED
    raise CommandError(code, failure["code"], failure["message"])
