"""A service with its simulated drive, each a process of its own, on a bus of their own over the loopback address."""

import contextlib
import json
import re
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from tools.bench.children import ROOT, ChildError, child, first_line, module
from tools.bench.plan import PATIENT
from twostage_servo.api.request_reading import read_request
from twostage_servo.api.requests import StatusRequest
from twostage_servo.client.connection import Connection
from twostage_servo.client.errors import ServoError

if TYPE_CHECKING:
    import subprocess

PROGRAM: Final = (sys.executable, "-P", "-c", "from twostage_servo.cli.main import entry_point; entry_point()")
_CONFIG: Final = ROOT / "config" / "two_processes.toml"
_PORT: Final = re.compile(r"port = \d+")
_OVERRIDES: Final = (*PATIENT, "simulation.command_timeout_ms=1000", "simulation.hub=false")
_LONGEST_START_S: Final = 60.0
_LONGEST_ANSWER_S: Final = 5.0
_FAR: Final = 2400.0
"""A set-point near the end of the travel: at 100 mm/s the axis is on its way for the whole measurement."""


class Machine:
    """A bus with a drive; the services on it are started and ended one after another.

    Attributes
    ----------
    port
        TCP port of the bus.
    priority
        SCHED_FIFO priority of those whose frames are compared; 0 for the ordinary class.
    apparatus_is_real_time
        Whether the hub got the real-time priority that it asked for.
    control_socket
        Where the service listens.
    """

    def __init__(self, folder: Path, port: int, priority: int, axes: int = 1, *, apparatus_is_real_time: bool) -> None:
        self.port = port
        self.priority = priority
        self.apparatus_is_real_time = apparatus_is_real_time
        self.control_socket = folder / "control.sock"
        self.environment = {
            "TWOSTAGE_SERVO_SOCKET": str(self.control_socket),
            "NOTIFY_SOCKET": str(folder / "notify.sock"),
            "XDG_STATE_HOME": str(folder / "state"),
        }
        self._folder = folder
        self._axes = [f"axis{number}" for number in range(axes)] if axes > 1 else []
        self._config = folder / ("machine.toml" if self._axes else "axis.toml")
        page = _PORT.sub(f"port = {port}", _CONFIG.read_text(encoding="utf-8"))
        for number, name in enumerate(self._axes):
            (folder / f"{name}.toml").write_text(_patient(page, name, number), encoding="utf-8")
        files = ", ".join(f'"{name}.toml"' for name in self._axes)
        self._config.write_text(
            f'[service]\nlog_level = "warning"\n\n[machine]\naxes = [{files}]\n' if self._axes else page,
            encoding="utf-8",
        )
        self._far = _FAR

    @classmethod
    @contextlib.contextmanager
    def running(cls, priority: int = 0, axes: int = 1) -> Iterator[Self]:
        """Run a bus and its drives while the block runs; the services on it shall have this priority."""
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-")))
            told = json.loads(first_line(stack.enter_context(child(module("bus_side", "hub")))))
            machine = cls(folder, told["port"], priority, axes, apparatus_is_real_time=told["real_time"])
            log = stack.enter_context((folder / "drive.log").open("w", encoding="utf-8"))
            stack.enter_context(child(machine.command("drive"), extra=machine.environment, stdout=log, stderr=log))
            yield machine

    def command(self, verb: str, *more: str) -> list[str]:
        """Return the command that starts the service or the drive, with more overrides."""
        common = () if self._axes else _OVERRIDES
        overrides = [word for override in (*common, *more) for word in ("--set", override)]
        return [*PROGRAM, verb, "--config", str(self._config), *overrides]

    @contextlib.contextmanager
    def service(self, *overrides: str) -> Iterator["Service"]:
        """Run a service while the block runs; it begins when the service has answered its first request."""
        notifications = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        path = Path(self.environment["NOTIFY_SOCKET"])
        with contextlib.ExitStack() as stack:
            stack.enter_context(notifications)
            path.unlink(missing_ok=True)
            notifications.bind(str(path))
            notifications.settimeout(_LONGEST_START_S)
            log_path = self._folder / "service.log"
            log = stack.enter_context(log_path.open("w", encoding="utf-8"))
            begun_s = time.monotonic()
            command = self.command("run", *overrides)
            process = stack.enter_context(
                child(command, extra=self.environment, stdout=log, stderr=log, priority=self.priority)
            )
            try:
                while b"READY=1" not in notifications.recv(4096):
                    pass
            except TimeoutError as error:
                raise ChildError(f"the service was not ready in time: {log_path.read_text()[-300:]}") from error
            client = stack.enter_context(contextlib.closing(Connection(self.control_socket, _LONGEST_ANSWER_S)))
            client.ask(StatusRequest())
            yield Service(process, client, time.monotonic() - begun_s)

    def send_afar(self, service: "Service") -> None:
        """Let the axis set out on a long move, from the end where it is to the other."""
        service.arm_once()
        where = {"positions": dict.fromkeys(self._axes, self._far)} if self._axes else {"position": self._far}
        service.insist(op="move", velocity=100.0, **where)
        self._far = -self._far


def _patient(page: str, name: str, number: int) -> str:
    """Return a configuration as that of one of several axes, with the overrides that an axis alone is given."""
    page = page.replace("[axis]", f"[protocol]\nidentifier_offset = {number}\n\n[axis]", 1)
    page = page.replace('name = "x"', f'name = "{name}"', 1)
    page = page.replace("[simulation]", "[simulation]\nhub = false", 1)
    for override in _OVERRIDES:
        key, _, value = override.rpartition("=")
        page = re.sub(
            rf"^{key.rpartition('.')[2]} = \S+", f"{key.rpartition('.')[2]} = {value}", page, flags=re.MULTILINE
        )
    return page


class Service:
    """A running service.

    Attributes
    ----------
    process
        Its process.
    start_s
        From the start of the process to its first answer, s.
    """

    def __init__(self, process: "subprocess.Popen[str]", client: Connection, start_s: float) -> None:
        self.process = process
        self.start_s = start_s
        self._is_armed = False
        self._client = client

    def ask(self, **request: Any) -> dict[str, Any]:
        """Ask for something once; return the answer.

        Raises
        ------
        ChildError
            If it is refused.
        """
        try:
            return self._client.ask(read_request(request))
        except ServoError as error:
            raise ChildError(f"the service refuses {request}: {error}") from error

    def arm_once(self) -> None:
        """Arm the axis, unless this was done before."""
        if not self._is_armed:
            self.insist(op="arm")
            self._is_armed = True

    def insist(self, **request: Any) -> None:
        """Ask for something until it is not refused any more: the drive may not have been heard yet.

        Raises
        ------
        ChildError
            If it is still refused after a long time.
        """
        end_s = time.monotonic() + _LONGEST_START_S
        while True:
            try:
                self._client.ask(read_request(request))
            except ServoError as error:
                if time.monotonic() > end_s:
                    raise ChildError(f"the service refuses {request}: {error}") from error
                time.sleep(0.05)
            else:
                return
