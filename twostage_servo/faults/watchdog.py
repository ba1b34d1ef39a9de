"""The service manager's part of ``sd_notify(3)``: it hears what a service says of itself, or that it falls silent."""

import contextlib
import socket
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

_ALIVE = "WATCHDOG=1"
_GLANCE_S = 0.02


class Watchdog:
    """Waits for signs of life; a context manager.

    Parameters
    ----------
    path
        Path of the socket on which the service says how it is.
    limit_s
        After which silence it counts as hanging, in s.
    """

    def __init__(self, path: Path, limit_s: float) -> None:
        self._path = path
        self._limit_s = limit_s
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._heard: set[str] = set()

    def __enter__(self) -> Self:
        """Begin to listen."""
        self._socket.bind(str(self._path))
        self._socket.settimeout(0.0)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Listen no more."""
        self._socket.close()
        self._path.unlink(missing_ok=True)

    @property
    def environment(self) -> dict[str, str]:
        """What the service has to find in its environment."""
        return {"NOTIFY_SOCKET": str(self._path), "WATCHDOG_USEC": str(round(1e6 * self._limit_s))}

    def heard(self) -> set[str]:
        """Return what the service has said so far."""
        self._receive()
        return self._heard

    def wait_for_silence(self, longest_s: float, meanwhile: Callable[[], None] = lambda: None) -> bool:
        """Wait until the last sign of life is as old as the limit; return False if there is still one after so long.

        Parameters
        ----------
        longest_s
            How long to wait, in s.
        meanwhile
            Called again and again.
        """
        begun_s = heard_s = time.monotonic()
        while time.monotonic() < begun_s + longest_s:
            silent = time.monotonic() >= heard_s + self._limit_s
            if _ALIVE in self._receive():
                heard_s = time.monotonic()
            elif silent:
                return True
            meanwhile()
            time.sleep(_GLANCE_S)
        return False

    def _receive(self) -> list[str]:
        said: list[str] = []
        with contextlib.suppress(BlockingIOError):
            while True:
                said.append(self._socket.recv(4096).decode())
        self._heard.update(said)
        return said
