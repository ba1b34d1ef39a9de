"""What the scenarios act with: service and simulated drives as processes, their bus, and the control socket."""

import contextlib
import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[2]
PROGRAM: Final = Path(sys.executable).with_name("twostage-servo")
_ERROR_FLAG: Final = 0x20000000  # CAN_ERR_FLAG of linux/can.h
_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")
# An emulated processor on a machine that has other work to do stalls for tenths of a second. What is shown here is what
# happens, not how punctually.
_PATIENT: Final = {
    "innovation": 100.0, "innovation_time_ms": 100.0, "following_error_minimum": 200.0, "following_error_time_s": 5.0,
    "stale_feedback_ms": 2000.0, "heartbeat_ms": 10_000.0, "feedback_errors": 100, "missed_ticks": 200,
    "jam_effort": 24.0, "jam_time_ms": 5000.0, "effort_saturation_ms": 5000.0,
}  # fmt: skip
_SIMULATION: Final = """
[simulation]
gain = 180.0
pole = 14.0
cycle_ms = 5.0
command_timeout_ms = 1000.0
"""


def run(*arguments: str) -> str:
    """Run a program, and return what it printed."""
    done = subprocess.run(arguments, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    if done.returncode:
        raise AssertionError(f"`{' '.join(arguments)}` ended with {done.returncode}: {done.stdout}{done.stderr}")
    return done.stdout


class Bench:
    """Axis x on can0 with its drive on can1, axis y with its drive on vcan0 with CAN FD; one service.

    Parameters
    ----------
    folder
        Where configurations, logs and the socket go.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.socket = folder / "control.sock"
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._notices = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._notices.bind(str(folder / "notify.sock"))
        self._write_configuration()

    # Processes -------------------------------------------------------------------------------------------------------

    def start(self, name: str, *arguments: str) -> None:
        """Start a program, its output in a file of its name."""
        environment = os.environ | {"NOTIFY_SOCKET": str(self.folder / "notify.sock")} if name == "service" else None
        with (self.folder / f"{name}.log").open("ab") as log:
            self._children[name] = subprocess.Popen(
                arguments, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment
            )

    def start_service(self) -> None:
        """Start the service."""
        self.start("service", str(PROGRAM), "run", "--config", str(self.folder / "machine.toml"))

    def start_drive(self, axis: str, channel: str) -> None:
        """Start the simulated drive of an axis on an interface."""
        override = ("--set", f'bus.channel="{channel}"')
        self.start(f"drive_{axis}", str(PROGRAM), "drive", "--config", str(self.folder / f"{axis}.toml"), *override)

    def end(self, name: str, number: int = signal.SIGTERM) -> int:
        """End a program with a signal, and return its exit code."""
        child = self._children.pop(name)
        child.send_signal(number)
        return child.wait(60)

    def close(self) -> None:
        """End whatever still runs."""
        for child in self._children.values():
            child.kill()
            child.wait()
        self._notices.close()

    def log(self, name: str) -> str:
        """Return what a program has printed."""
        return (self.folder / f"{name}.log").read_text(errors="replace")

    def ready(self, longest_s: float) -> None:
        """Wait until the service has told the manager that it is ready."""
        self._notices.settimeout(longest_s)
        while b"READY=1" not in self._notices.recv(4096):
            pass

    def processor_share(self, seconds: float) -> float:
        """Return the share of a core that the service takes, over so many seconds, with all its threads."""
        path = Path(f"/proc/{self._children['service'].pid}/stat")

        def used() -> int:
            fields = path.read_text().rpartition(")")[2].split()
            return int(fields[11]) + int(fields[12])

        before, begun = used(), time.monotonic()
        time.sleep(seconds)
        return (used() - before) / _TICKS_PER_S / (time.monotonic() - begun)

    def open_files(self) -> int:
        """Return the number of files that the service has open."""
        return len(os.listdir(f"/proc/{self._children['service'].pid}/fd"))  # noqa: PTH208 - links that point nowhere

    # Operator --------------------------------------------------------------------------------------------------------

    def operate(self, *arguments: str) -> dict[str, Any]:
        """Give one of the operator's commands, and return its JSON."""
        out = run(str(PROGRAM), *arguments, "--socket", str(self.socket), "--json")
        answer: dict[str, Any] = json.loads(out.splitlines()[-1])
        return answer

    def ask(self, axis: str, **request: Any) -> dict[str, Any]:
        """Send a request over the control socket, and return the answer."""
        with socket.socket(socket.AF_UNIX) as client:
            client.settimeout(30.0)
            client.connect(str(self.socket))
            lines = client.makefile("rwb")
            answers = []
            for one in ({"op": "status", "axis": axis} | request, {"op": "release"}):
                lines.write(json.dumps(one).encode() + b"\n")
                lines.flush()
                answers.append(json.loads(lines.readline()))
        answer: dict[str, Any] = answers[0]
        return answer

    def until(self, axis: str, what: str, holds: Callable[[dict[str, Any]], bool], longest_s: float = 60.0) -> float:
        """Wait until something holds of an axis' snapshot; return how long that took, s."""
        begun = time.monotonic()
        while True:
            shown: dict[str, Any] = {}
            with contextlib.suppress(OSError):
                shown = self.ask(axis)
                if holds(shown):
                    return time.monotonic() - begun
            if time.monotonic() - begun > longest_s:
                parts = {key: shown.get(key) for key in ("axis", "move", "trip", "bus", "frames")}
                raise AssertionError(f"not within {longest_s:g} s: {what}; axis {axis} shows {parts}")
            time.sleep(0.1)

    # Bus -------------------------------------------------------------------------------------------------------------

    def error_frame(self, channel: str, classes: int, data: bytes) -> None:
        """Let an error frame come from an interface, as its driver would; see linux/can/error.h."""
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
            bus.bind((channel,))
            bus.send(struct.pack("=IB3x8s", _ERROR_FLAG | classes, 8, data))

    def _write_configuration(self) -> None:
        shipped = (ROOT / "config/socketcan.toml").read_text()
        for key, value in _PATIENT.items():
            shipped, count = re.subn(rf"^{key} = [\d.]+", f"{key} = {value}", shipped, flags=re.MULTILINE)
            assert count == 1, key  # noqa: S101 - a key that is gone would be set nowhere
        service = f'[service]\ntick_ms = 20.0\nsocket = "{self.socket}"\ntrip_folder = "{self.folder}"\n'
        for axis, channel, fd in (("x", "can0", "false"), ("y", "vcan0", "true")):
            text = shipped.replace('channel = "can0"', f'channel = "{channel}"\nfd = {fd}')
            text = text.replace('name = "x"', f'name = "{axis}"')
            (self.folder / f"{axis}.toml").write_text(service + text + _SIMULATION)
        machine = '[machine]\naxes = ["x.toml", "y.toml"]\nwhen_one_trips = "continue"\n'
        (self.folder / "machine.toml").write_text(service + machine)
