"""The bench: a drive, its service and an operator as processes of their own, in real time, on a loopback bus.

Each bench has a folder and a port to itself, and leaves neither a process nor a file behind.
"""

import json
import select
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from twostage_servo.canbus.link import LinkError
from twostage_servo.config.loader import Config, LoadedConfig, load
from twostage_servo.faults.frames import compile_profile
from twostage_servo.faults.launch import LONGEST_S, Child, GivenUpError
from twostage_servo.faults.listening import Listener, Operator, Snapshot

_GLANCE_S = 0.005
"""Pause between two looks at what has come."""
_REST_S = 0.2
"""A place that is kept for so long is rest."""


class BenchError(Exception):
    """The processes did not come so far that a fault could be injected."""


class Bench:
    """Drive, service and operator of one axis; a context manager.

    Parameters
    ----------
    path
        The configuration; None for the embedded one.
    overrides
        ``KEY=VALUE`` arguments that belong to it.
    environment
        Of the service, beside its folder's path.
    given_up
        Is set where nobody wants the result any more: each wait then ends.

    Attributes
    ----------
    folder
        Where all files are.
    loaded
        The configuration that the processes run on.
    drive, service, listener, operator
        The parties.
    """

    def __init__(
        self,
        path: Path | None,
        overrides: Sequence[str],
        environment: Callable[[Path], Mapping[str, str]] = lambda _: {},
        given_up: threading.Event | None = None,
    ) -> None:
        self.drive: Child
        self.service: Child
        self.listener: Listener
        self.operator: Operator
        self.loaded: LoadedConfig[Config]
        self._path = path
        self._overrides = list(overrides)
        self._environment = environment
        self._given_up = given_up or threading.Event()
        self._stack = ExitStack()
        self._services = 0
        self._hear: Callable[[], None] = lambda: None

    def __enter__(self) -> Self:
        """Start all, up to an axis that could be armed."""
        with ExitStack() as stack:
            self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="twostage-servo-")))
            self._stack = stack
            self._prepare()
            self.drive = self._start("drive", "drive", {})
            # Only a drive that serves this port shows that nobody else's bus is behind it.
            self.wait(lambda: "on the bus" in self.drive.log(), "the drive to be on the bus")
            try:
                self.listener = Listener(self.loaded.config.bus, self.profile)
            except LinkError as error:
                raise BenchError(str(error)) from error
            stack.callback(self.listener.close)
            self._hear = self.listener.read_frames
            self.start_service()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """End all."""
        self._stack.close()

    def start_service(self) -> None:
        """Start the service, also after an earlier one has ended, and take the operator's place."""
        self._services += 1
        self.service = self._start("run", f"service-{self._services}", self._environment(self.folder))

        def connect() -> bool:
            if self.service.has_ended:
                raise BenchError(f"the service has ended:\n{self.service.log()[-1000:]}")
            try:
                self.operator = Operator(self.socket)
            except OSError:
                return False
            return True

        self.wait(connect, "the service's control socket")
        self._stack.callback(self.operator.close)
        self.watch(lambda now: now["bus"]["open"] and now["axis"]["position"] is not None, "the drive's feedback")

    # Waiting ---------------------------------------------------------------------------------------------------------

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until a condition holds.

        Raises
        ------
        BenchError
            If it never does.
        """
        end_s = time.monotonic() + LONGEST_S
        while not condition():
            self._check(end_s, what)
            self.read_frames()
            time.sleep(_GLANCE_S)

    def watch(self, condition: Callable[[Snapshot], bool], what: str) -> Snapshot:
        """Look at one snapshot after the other until a condition holds; return that one.

        Raises
        ------
        BenchError
            If it never does.
        """
        end_s = time.monotonic() + LONGEST_S
        while True:
            alive = self.operator.read_snapshots()
            self.read_frames()
            while self.operator.unread:
                if condition(snapshot := self.operator.unread.popleft()):
                    return snapshot
            if not alive:
                raise BenchError(f"the service ended while waiting for {what}:\n{self.service.log()[-1000:]}")
            self._check(end_s, what)
            select.select([self.operator], [], [], _GLANCE_S)

    def read_frames(self) -> None:
        """Read the frames that have arrived on the bus; every wait does so again and again.

        Raises
        ------
        BenchError
            If the bus is gone.
        GivenUpError
            If nobody wants the result any more.
        """
        if self._given_up.is_set():
            raise GivenUpError
        try:
            self._hear()
        except LinkError as error:
            raise BenchError(f"the bus is gone: {error}") from error

    def wait_for_rest(self, since_s: float, longest_s: float) -> bool:
        """Wait until the axis has come to rest after a time in s; return False if it goes on for longer than that."""
        listener = self.listener
        begun = len(listener.reports)
        rested = False

        def done() -> bool:
            nonlocal rested
            rested = listener.rests(since_s, _REST_S, self.tolerance)
            goes_on = listener.reports[-1].time_s > since_s + longest_s and len(listener.reports) > begun + 100
            return rested or goes_on

        self.wait(done, "the axis to come to rest")
        return rested

    @property
    def tolerance(self) -> float:
        """How far the reports of an axis at rest may differ, in axis unit."""
        config = self.loaded.config
        step = max(self.profile.traits.position_quantum, config.simulation.quantum)
        return max(1e-3 * config.axis.cruise_velocity * _REST_S, 1.5 * step)

    def _check(self, end_s: float, what: str) -> None:
        if self.drive.has_ended:
            raise BenchError(f"the drive ended while waiting for {what}:\n{self.drive.log()[-1000:]}")
        if time.monotonic() > end_s:
            raise BenchError(f"waited {LONGEST_S:g} s in vain for {what}")

    # Starting --------------------------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        own = load(self._path, self._overrides)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.socket = self.folder / "control.sock"
        self._overrides += bench_overrides(own.config, port, self.folder)
        self.loaded = load(self._path, self._overrides)
        self.profile = compile_profile(self.loaded)

    def _start(self, verb: str, name: str, environment: Mapping[str, str]) -> Child:
        path = self._path or self.loaded.folder / "demo.toml"  # what None stands for has to be named on a command line
        command = ["child", verb, str(path), *self._overrides]
        return Child(self._stack, self.folder, name, command, environment)


def bench_overrides(config: Config, port: int, folder: Path) -> list[str]:
    """Return what a configuration needs to run on a bench, as ``KEY=VALUE`` arguments.

    Service and drive share a machine with whatever else runs there. A limit that tells a late host from a fault is
    therefore widened: which of them trips on a busy day is not what the bench is for. The drive reports the true
    position, as what its travel is measured by.
    """
    limits = config.axis.limits
    widened = {
        "axis.limits.stale_feedback_ms": max(limits.stale_feedback_ms, 150.0),
        "axis.limits.missed_ticks": max(limits.missed_ticks, 20),
        "axis.limits.heartbeat_ms": max(limits.heartbeat_ms, 1000.0),
        "axis.limits.feedback_errors": 100,
        # Not by innovation_time_ms, which would hide an encoder that is wrong, and is refused for that.
        "axis.limits.innovation_gate": limits.innovation_gate + 0.1 * limits.velocity,
        "axis.limits.following_error_time_s": max(limits.following_error_time_s, 1.0),
        "simulation.command_timeout_ms": max(config.simulation.command_timeout_ms, 250.0),
        "simulation.noise_std": 0.0,
        "simulation.frame_loss": 0.0,
        "simulation.hub": "true",
        "service.socket": json.dumps(str(folder / "control.sock")),
        "service.trip_folder": json.dumps(str(folder / "trips")),
        "service.log_level": "info",
    }
    most = config.bus.max_frames_per_tick
    table = (
        f'bus={{ interface = "socketcand", channel = "can0", options = {{ host = "127.0.0.1", port = {port} }}, '
        f"{'' if most is None else f'max_frames_per_tick = {most}, '}reopen_interval_ms = 100.0 }}"
    )
    return [table, *(f"{key}={value}" for key, value in widened.items())]
