"""What the scenarios act with: the service under systemd, its simulated drives, their buses, and the operators."""

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from twostage_servo.api.requests import ReleaseRequest, Request, StatusRequest
from twostage_servo.client.connection import Connection
from twostage_servo.client.errors import ServoError

ROOT: Final = Path(__file__).resolve().parents[2]
OPT: Final = Path("/opt/twostage-servo")
PROGRAM: Final = OPT / "bin/twostage-servo"
UNIT: Final = "twostage-servo.service"
GROUP: Final = "twostage-servo"
CONFIGURATION: Final = Path("/etc/twostage-servo")
SOCKET: Final = Path("/run/twostage-servo/control.sock")
OPERATOR: Final = 4711
_STRANGER: Final = 4712
_NOBODYS_GROUP: Final = 65534
_ERROR_FLAG: Final = 0x20000000  # CAN_ERR_FLAG of linux/can.h
_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")
# An emulated processor on a machine that has other work to do is suspended for tenths of a second. What is shown here
# is what happens, not how punctually.
_PATIENT: Final = {
    "innovation_gate": 100.0, "following_error_minimum": 200.0, "following_error_time_s": 5.0,
    "stale_feedback_ms": 2000.0, "heartbeat_ms": 10_000.0, "feedback_errors": 100, "missed_ticks": 200,
    "stall_effort": 24.0, "stall_time_ms": 5000.0, "effort_saturation_ms": 5000.0, "overspeed": 1000.0,
}  # fmt: skip
_UNDETECTED_TRAVEL: Final = 60.0
"""Of an encoder that is told late because of those limits, mm."""
_LONGEST_ANSWER_S: Final = 30.0
_ARMING_TIMEOUT_MS: Final = 5000.0
"""Arming waits for two fresh samples in a row."""
PATIENT_UNIT: Final = "[Service]\nTimeoutStartSec=300\nWatchdogSec=8\n"
_SERVICE: Final = '[service]\ntick_ms = 20.0\n\n[realtime]\nlock_memory = true\nspin = "off"\n'
_SIMULATION: Final = """
[simulation]
gain = 180.0
pole = 14.0
cycle_ms = 5.0
command_timeout_ms = 1000.0
"""


def run(*arguments: str) -> str:
    """Run a program, and return what it printed."""
    done = attempt(*arguments)
    if done.returncode:
        raise AssertionError(f"`{' '.join(arguments)}` ended with {done.returncode}: {done.stdout}{done.stderr}")
    return done.stdout


def attempt(*arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run a program, whatever comes of it."""
    return subprocess.run(arguments, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)


class Bench:
    """Axis x on can0 with its drive on can1, axis y with its drive on vcan0 with CAN FD; one service, under systemd.

    Parameters
    ----------
    folder
        Where the logs of all but the service go.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._drives = folder / "drives/machine.toml"
        self._children: dict[str, subprocess.Popen[bytes]] = {}

    # Service ---------------------------------------------------------------------------------------------------------

    def install(self) -> list[str]:
        """Install as the documentation says, with a configuration of two axes; return the paths that were written."""
        put_into_opt(Path(sys.prefix))
        placed = json.loads(run(str(PROGRAM), "install-service", "--bit-rate", "500000", "--json"))
        run("systemd-sysusers")
        dropped_in = Path(f"/etc/systemd/system/{UNIT}.d/emulated.conf")
        dropped_in.parent.mkdir()
        dropped_in.write_text(PATIENT_UNIT)
        run("systemctl", "daemon-reload")
        run("udevadm", "control", "--reload")
        CONFIGURATION.mkdir()
        self._write_configuration()
        return [file["path"] for file in placed["files"]]

    def uninstall(self) -> None:
        """Remove what :meth:`install` has placed."""
        run(str(PROGRAM), "install-service", "--uninstall")
        run("systemctl", "daemon-reload")

    def start_without_check(self) -> None:
        """Let the starts that follow leave ExecStartPre out, which takes the guest half a minute each time."""
        dropped_in = Path(f"/run/systemd/system/{UNIT}.d/no-check.conf")
        dropped_in.parent.mkdir(parents=True, exist_ok=True)
        dropped_in.write_text("[Service]\nExecStartPre=\n")
        run("systemctl", "daemon-reload")

    def service(self, verb: str, *options: str) -> None:
        """Have systemd do something with the service: start, stop, ..."""
        run("systemctl", verb, *options, UNIT)

    def signal_service(self, number: signal.Signals) -> None:
        """Send a signal to the service's process."""
        self.service("kill", f"--signal={number.name}", "--kill-who=main")

    def shown(self, name: str) -> str:
        """Return a property of the unit, as ``systemctl show`` has it."""
        return run("systemctl", "show", f"--property={name}", "--value", UNIT).strip()

    @property
    def pid(self) -> int:
        """The service's main process."""
        return int(self.shown("MainPID"))

    @property
    def restarts(self) -> int:
        """How often systemd has restarted the service so far."""
        return int(self.shown("NRestarts"))

    def restarted(self, times: int, longest_s: float = 120.0) -> float:
        """Wait until systemd has restarted the service so many times in all, and it is ready; return how long, s."""
        begun = time.monotonic()
        while (self.restarts, self.shown("ActiveState")) != (times, "active"):
            if time.monotonic() - begun > longest_s:
                state = run("systemctl", "show", "--property=NRestarts,ActiveState,SubState,Result", UNIT)
                raise AssertionError(f"not restarted for the {times}. time within {longest_s:g} s: {state}")
            time.sleep(0.5)
        return time.monotonic() - begun

    def journal(self) -> list[dict[str, Any]]:
        """Return what the journal has of the unit, its manager's words included."""
        lines = run("journalctl", f"--unit={UNIT}", "--output=json").splitlines()
        return [json.loads(line) for line in lines]

    # Other processes -------------------------------------------------------------------------------------------------

    def start(self, name: str, *arguments: str) -> None:
        """Start a program, its output in a file of its name."""
        with (self.folder / f"{name}.log").open("ab") as log:
            self._children[name] = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def start_drives(self) -> None:
        """Start the simulated drives, in one process of their own: a second one would only cost time."""
        self.start("drives", str(PROGRAM), "drive", "--config", str(self._drives))

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

    def log(self, name: str) -> str:
        """Return what a program has printed; the service's is the journal's messages."""
        if name == "service":
            return "\n".join(str(entry.get("MESSAGE")) for entry in self.journal())
        return (self.folder / f"{name}.log").read_text(errors="replace")

    def processor_share(self, seconds: float) -> float:
        """Return the share of a core that the service takes, over so many seconds, with all its threads."""
        path = Path(f"/proc/{self.pid}/stat")

        def used() -> int:
            fields = path.read_text().rpartition(")")[2].split()
            return int(fields[11]) + int(fields[12])

        before, begun = used(), time.monotonic()
        time.sleep(seconds)
        return (used() - before) / _TICKS_PER_S / (time.monotonic() - begun)

    def open_files(self) -> int:
        """Return the number of files that the service has open for good: the fewest within some seconds."""
        folder = f"/proc/{self.pid}/fd"
        seen = []
        for _ in range(20):
            seen.append(len(os.listdir(folder)))  # noqa: PTH208 - links that point nowhere
            time.sleep(0.1)
        return min(seen)

    # Operator --------------------------------------------------------------------------------------------------------

    def operate(self, *arguments: str) -> dict[str, Any]:
        """Give a command as an ordinary user of the operators' group, and return its JSON."""
        out = run(*_as_user(OPERATOR, GROUP), str(PROGRAM), *arguments, "--json")
        answer: dict[str, Any] = json.loads(out.splitlines()[-1])
        return answer

    def as_stranger(self, *arguments: str) -> "subprocess.CompletedProcess[str]":
        """Give a command as a user of no group that matters."""
        return attempt(*_as_user(_STRANGER, str(_NOBODYS_GROUP)), str(PROGRAM), *arguments)

    def ask(self, axis: str) -> dict[str, Any]:
        """Return the status of an axis, as its JSON."""
        return self.request(StatusRequest(axis=axis))

    def request(self, request: Request) -> dict[str, Any]:
        """Send a request over the control socket, and return the answer.

        Raises
        ------
        ServoError
            If it is refused, or no service answers.
        """
        with contextlib.closing(Connection(SOCKET, _LONGEST_ANSWER_S)) as connection:
            try:
                return connection.ask(request)
            finally:
                connection.ask(ReleaseRequest())

    def until(self, axis: str, what: str, holds: Callable[[dict[str, Any]], bool], longest_s: float = 60.0) -> float:
        """Wait until something holds of an axis' snapshot; return how long that took, s."""
        begun = time.monotonic()
        while True:
            shown: dict[str, Any] = {}
            with contextlib.suppress(ServoError):
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
        shipped = patient((ROOT / "config/socketcan.toml").read_text())
        for axis, channel, fd in (("x", "can0", "false"), ("y", "vcan0", "true")):
            text = shipped.replace('channel = "can0"', f'channel = "{channel}"\nfd = {fd}')
            text = text.replace('name = "x"', f'name = "{axis}"')
            (CONFIGURATION / f"{axis}.toml").write_text(text)
        machine = '[machine]\naxes = ["x.toml", "y.toml"]\nfault_reaction = "continue"\n'
        (CONFIGURATION / "servo.toml").write_text(_SERVICE + machine)
        self._drives.parent.mkdir()
        self._drives.write_text(_SERVICE + machine)
        for path in CONFIGURATION.glob("?.toml"):
            text = path.read_text().replace('channel = "can0"', 'channel = "can1"')
            (self._drives.parent / path.name).write_text(text)


def patient(shipped: str) -> str:
    """Return the shipped configuration of an axis with limits that suit an emulated machine, and a simulated drive."""
    for key, value in _PATIENT.items():
        shipped, count = re.subn(rf"^{key} = [\d.]+", f"{key} = {value}", shipped, flags=re.MULTILINE)
        assert count == 1, key  # noqa: S101 - a key that is gone would be set nowhere
    # A gate so wide leaves an encoder that turns round to the model's tests alone, and they take longer in a stop.
    shipped = shipped.replace("[axis.limits]\n", f"[axis.limits]\nundetected_travel = {_UNDETECTED_TRAVEL}\n")
    shipped = shipped.replace("[axis]\n", f"[axis]\narming_timeout_ms = {_ARMING_TIMEOUT_MS}\n")
    return _SERVICE + shipped + _SIMULATION


def put_into_opt(environment: Path) -> None:
    """Let a virtual environment be seen at /opt as well, where the service can see it; in this guest alone."""
    if environment == OPT:
        return
    interpreter = Path(sys.executable).resolve()
    if any(parent.stat().st_mode & 0o005 != 0o005 for parent in interpreter.parents):
        raise SystemExit(
            f"{interpreter} lies in a folder that only its owner may enter, so the service cannot start it: make the "
            "environment with the system's own Python, /usr/bin/python3 -m venv"
        )
    OPT.mkdir(parents=True)
    shutil.copytree(environment / "bin", OPT / "bin", symlinks=True)
    shutil.copy(environment / "pyvenv.cfg", OPT)
    PROGRAM.write_text(re.sub(r"\A#!.*", f"#!{OPT}/bin/python3", PROGRAM.read_text()))
    (OPT / "lib").mkdir()
    run("mount", "--bind", str(environment / "lib"), str(OPT / "lib"))


def _as_user(user: int, group: str) -> Sequence[str]:
    return "setpriv", f"--reuid={user}", f"--regid={group}", "--clear-groups", "--"
