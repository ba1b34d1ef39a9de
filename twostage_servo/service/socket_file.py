"""The path of the control socket: one service has it at a time, removes only its own, and makes a lost one again."""

import asyncio
import contextlib
import fcntl
import os
import select
import socket
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Final

import structlog

from twostage_servo.api.address import prepare_folder

_LOOK_S: Final = 1.0
"""Pause between two looks at the path."""

Listen = Callable[[socket.socket], "asyncio.Task[None]"]
Slot = Callable[[], AbstractAsyncContextManager[None]]

_Identity = tuple[int, int]


class SocketInUseError(OSError):
    """Another service has the path of the control socket."""


class SocketFile:
    """A path with the socket that this service has made there.

    Beside the socket lies a file with the lock of the service that has the path, ``control.sock.lock``: of two that
    start at the same time one gets it, and it ends with its process.

    Parameters
    ----------
    path
        Of the socket.
    backlog
        Clients that may wait to be let in.
    """

    def __init__(self, path: Path, backlog: int) -> None:
        self.path = path
        self._backlog = backlog
        self._lock_path = path.with_name(path.name + ".lock")
        self._lock: int | None = None
        self._identity: _Identity | None = None
        self._trouble = ""
        self._log = structlog.get_logger().bind(room="control_socket")

    def bind(self) -> socket.socket:
        """Claim the path and return a socket that listens there; keep it open while it is the one there.

        Raises
        ------
        SocketInUseError
            If another service has it.
        OSError
            If it cannot be used.
        """
        prepare_folder(self.path)
        self._acquire_lock()
        listener = socket.socket(socket.AF_UNIX)
        try:
            _remove_if_dead(self.path)
            previous = os.umask(0o117)  # owner and group only, from the first moment on
            try:
                listener.bind(str(self.path))
            finally:
                os.umask(previous)
            listener.setblocking(False)
            listener.listen(self._backlog)
            self._identity = _identity(self.path)
        except BaseException:
            listener.close()
            if self._identity is None:
                self._release_lock()
            raise
        return listener

    def remove(self) -> None:
        """Remove the socket, if it is still this one, and let others have the path. Before the listener is closed.

        An open listener holds the number of its file, which otherwise could be that of another service's socket.
        """
        if self._is_there():
            self.path.unlink(missing_ok=True)
        self._identity = None
        self._release_lock()

    async def maintain(
        self, slot: Slot, listen: Listen, listening: "asyncio.Task[None]", listener: socket.socket
    ) -> None:
        """Check the path repeatedly, and make the socket again if somebody has removed it. Clients stay connected.

        Parameters
        ----------
        slot
            Grants a slot between the ticks, in which to look.
        listen
            Begins to let clients in from a socket, and returns the task, which closes it.
        listening, listener
            The task that lets clients in now, and its socket.
        """
        while True:
            await asyncio.sleep(_LOOK_S)
            async with slot():
                fresh = self._bind_again()
            if fresh is None:
                continue
            forgotten, forgotten_listener, listener = listening, listener, fresh
            listening = listen(fresh)
            await _accept_the_last(forgotten, forgotten_listener)

    def _bind_again(self) -> socket.socket | None:
        """Make the socket again if it is gone; return it, or None."""
        if self._is_there() and self._has_lock():
            return None
        try:
            if self._is_there():
                self._acquire_lock()
                listener = None
            else:
                listener = self.bind()
        except OSError as error:
            if str(error) != self._trouble:
                self._trouble = str(error)
                text = "the control socket was removed and cannot be created again: no new client can connect"
                self._log.error(text, socket=str(self.path), error=self._trouble)
            return None
        self._trouble = ""
        self._log.warning("the control socket was removed, and has been created again", socket=str(self.path))
        return listener

    # Socket and lock -------------------------------------------------------------------------------------------------

    def _is_there(self) -> bool:
        return self._identity is not None and _identity(self.path) == self._identity

    def _has_lock(self) -> bool:
        return self._lock is not None and _identity(self._lock_path) == _identity(self._lock)

    def _acquire_lock(self) -> None:
        while not self._has_lock():
            descriptor = os.open(self._lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                os.close(descriptor)
                if isinstance(error, BlockingIOError):
                    raise _in_use(self.path) from error
                raise
            if self._lock is not None:
                os.close(self._lock)
            # Its last owner may have removed it meanwhile: a lock on a file that nobody can find is none.
            self._lock = descriptor

    def _release_lock(self) -> None:
        if self._lock is None:
            return
        if self._has_lock():
            with contextlib.suppress(OSError):  # a folder that has become read-only: the lock alone counts
                self._lock_path.unlink(missing_ok=True)
        os.close(self._lock)
        self._lock = None


async def _accept_the_last(listening: "asyncio.Task[None]", listener: socket.socket) -> None:
    """Close a socket to which nobody can come any more, when those who wait there have been let in."""
    look = select.poll()
    look.register(listener, select.POLLIN)
    while True:
        await asyncio.sleep(_LOOK_S)
        if listening.done() or not look.poll(0):
            break
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)


def _identity(file: Path | int) -> _Identity | None:
    """Return device and inode of a file; None if it is not there."""
    try:
        status = os.fstat(file) if isinstance(file, int) else file.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _remove_if_dead(path: Path) -> None:
    """Remove a socket that nobody serves any more. Never waits."""
    if not os.path.lexists(path):
        return
    if not path.is_socket():
        raise SocketInUseError(f"{path} exists and is not a socket; remove it, or set service.socket to another path")
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except FileNotFoundError:
            return
        except BlockingIOError:  # one that does not keep up with its clients
            pass
    raise _in_use(path)


def _in_use(path: Path) -> SocketInUseError:
    return SocketInUseError(
        f"another service answers at {path}, or is about to; end it, or give this one its own path in service.socket"
    )
