"""The processes of a run with hostile clients: a drive, the service behind a gate to its hub, and crews of clients."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from tools.soak.hub_gate import HubGate, Mode
from twostage_servo.api.requests import ReloadRequest, Request
from twostage_servo.client.async_connection import AsyncConnection
from twostage_servo.config.loader import load
from twostage_servo.faults.bench import bench_overrides

LONGEST_ANSWER_S: Final = 10.0

_ROOT: Final = Path(__file__).parents[2]
_LONGEST_START_S: Final = 60.0


class BrokenError(Exception):
    """What the service does not do any more."""


class HostileProcesses:
    """A context that kills what it has started.

    Parameters
    ----------
    folder
        For all files.

    Attributes
    ----------
    socket : Path
        The control socket.
    gate : HubGate
        What stands between the service and its hub, from :meth:`start` on.
    service : subprocess.Popen
        The service, from :meth:`start` on.
    clients : subprocess.Popen or None
        The crew that is there.
    """

    def __init__(self, folder: Path) -> None:
        self.socket = folder / "runtime" / "control.sock"
        self.gate: HubGate
        self.service: subprocess.Popen[bytes]
        self.clients: subprocess.Popen[bytes] | None = None
        self._folder = folder
        self._report = folder / "report.json"
        self._crews = 0
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    async def start(self) -> None:
        """Start the drive and the service, and wait until both are ready."""
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            hub_port = probe.getsockname()[1]
        self.gate = HubGate(hub_port)
        await self.gate.set_mode(Mode.OPEN)
        config = load(None).config
        own = [f"service.socket={json.dumps(str(self.socket))}", "axis.limits.stale_feedback_ms=300.0"]
        self._child("drive", ["-m", "twostage_servo.faults.child"], "drive", config, hub_port, [])
        await until(lambda: "on the bus" in self.log("drive"), "the drive to be on the bus")
        measured = ["-m", "tools.soak.measured_service"]
        self.service = self._child("service", measured, "run", config, self.gate.port, own)
        await until(self.socket.exists, "the control socket")
        await self.ask(ReloadRequest())  # whose thread stays

    def new_clients(self, seed: int) -> None:
        """Start a crew of clients that makes the choices of a seed."""
        self._crews += 1
        counts = self._folder / f"counts-{self._crews}.json"
        command = ["-m", "tools.soak.hostile_clients", str(os.getpid()), str(self.socket), str(seed), str(counts)]
        self.clients = self._spawn("clients", command)

    def end_clients(self) -> None:
        """Kill the crew that is there."""
        if self.clients is not None:
            _kill(self.clients)
            self.clients = None

    async def ask(self, request: Request) -> None:
        """Ask the service, as a fresh client."""
        connection = AsyncConnection(self.socket, LONGEST_ANSWER_S)
        try:
            await connection.open(LONGEST_ANSWER_S)
            await connection.ask(request)
        finally:
            connection.close()

    async def holds(self) -> dict[str, Any]:
        """Return what the service says that it holds now."""
        before = self._reported().get("number", 0)
        self.service.send_signal(signal.SIGUSR2)
        await until(lambda: self._reported().get("number", 0) > before, "the service's report")
        return self._reported()

    def counts(self) -> dict[str, int]:
        """Return how often the clients have done what, as far as they could tell."""
        total: Counter[str] = Counter()
        for path in self._folder.glob("counts-*.json"):
            total.update(json.loads(path.read_text(encoding="utf-8")))
        return dict(sorted(total.items()))

    def log_levels(self) -> dict[str, int]:
        """Return how many lines of each level the service has logged."""
        lines = self.log("service").splitlines()
        return dict(Counter(json.loads(line)["level"] for line in lines if line.startswith("{")))

    def log(self, name: str) -> str:
        """Return what one of the processes has logged."""
        path = self._folder / f"{name}.log"
        return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""

    def _child(
        self, name: str, program: list[str], verb: str, config: Any, port: int, own: list[str]
    ) -> subprocess.Popen[bytes]:
        overrides = [*bench_overrides(config, port, self._folder), *own]
        demo = str(_ROOT / "config" / "demo.toml")
        if verb == "drive":
            return self._spawn(name, [*program, str(os.getpid()), verb, demo, *overrides])
        options = [argument for override in overrides for argument in ("--set", override)]
        command = [*program, str(os.getpid()), str(self._report), verb, "--config", demo, *options, "--json"]
        return self._spawn(name, command)

    def _spawn(self, name: str, command: list[str]) -> subprocess.Popen[bytes]:
        with (self._folder / f"{name}.log").open("ab") as log, (self._folder / f"{name}.out").open("wb") as out:
            process = subprocess.Popen(  # noqa: S603 - our own programs
                [sys.executable, "-P", *command],
                stdin=subprocess.DEVNULL, stdout=out, stderr=log, start_new_session=True,
                env=os.environ | {"PYTHONPATH": str(_ROOT), "OPENBLAS_NUM_THREADS": "1"},
            )  # fmt: skip
        self._stack.callback(_kill, process)
        return process

    def _reported(self) -> dict[str, Any]:
        try:
            report: dict[str, Any] = json.loads(self._report.read_text(encoding="ascii"))
        except FileNotFoundError:
            return {}
        return report


async def until(condition: Callable[[], bool], what: str) -> None:
    """Wait until a condition holds.

    Raises
    ------
    BrokenError
        When it does not in 60 s.
    """
    end_s = time.monotonic() + _LONGEST_START_S
    while not condition():
        if time.monotonic() > end_s:
            raise BrokenError(f"waited {_LONGEST_START_S:g} s in vain for {what}")
        await asyncio.sleep(0.05)


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait()
