"""The service manager's notification protocol, as in systemd's ``sd_notify(3)``: one datagram a message.

Ours, because the packages for it are unmaintained or need libsystemd to build, and it is a few lines.
"""

import math
import os
import socket
from collections.abc import Mapping


class Notifier:
    """Tells the service manager how the service is; without one it does nothing.

    Parameters
    ----------
    environment
        Where ``NOTIFY_SOCKET`` and ``WATCHDOG_USEC`` are looked up.

    Attributes
    ----------
    watchdog_s
        How long the manager waits for a sign of life, in s; None if it does not.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._socket: socket.socket | None = None
        if address.startswith(("/", "@")):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.watchdog_s = self._watchdog_s(environment)
        self._next_sign_s = 0.0
        self._is_stopping = False

    @staticmethod
    def _watchdog_s(environment: Mapping[str, str]) -> float | None:
        wanted, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        if not wanted.isdecimal() or int(wanted) == 0 or process not in {"", str(os.getpid())}:
            return None
        return int(wanted) / 1e6

    def ready(self) -> None:
        """Say that the service has started."""
        self._send("READY=1")

    def stopping(self, longest_s: float) -> None:
        """Say, once, that the service is ending, and how long that may take, in s.

        A manager that has been told to wait for less kills it before the axes are at rest; systemd then waits for this
        time instead.
        """
        if not self._is_stopping:
            self._is_stopping = True
            self._send("STOPPING=1")
            self._send(f"EXTEND_TIMEOUT_USEC={math.ceil(1e6 * longest_s)}")

    def status(self, text: str) -> bool:
        """Show a line to whoever asks the manager; return whether it has been told, or there is none."""
        return self._send(f"STATUS={text}")

    def tick_completed(self, now_s: float) -> None:
        """Give a sign of life, four times in the time that the manager waits; ``now_s`` is the loop's time in s."""
        if self.watchdog_s is not None and now_s >= self._next_sign_s:
            self._next_sign_s = now_s + self.watchdog_s / 4.0
            self._send("WATCHDOG=1")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, message: str) -> bool:
        if self._socket is None:
            return True
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError:  # the manager is gone or busy; a sign of life that does not arrive is what its watchdog is for
            return False
        return True
