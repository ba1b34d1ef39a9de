"""Starts the processes of the fault campaign, and ends them."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from twostage_servo.api.fields import JsonObject

LONGEST_S = 60.0
"""Ends a wait for something that never comes; nothing is measured against it."""

_NOT_INHERITED = frozenset({"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID", "JOURNAL_STREAM"})
"""Between the service manager and the campaign's own process."""


class GivenUpError(Exception):
    """The campaign was interrupted: nobody wants the result any more."""


class Child(subprocess.Popen[bytes]):
    """A module of this package in a process group of its own; what it prints is kept in a folder.

    Parameters
    ----------
    stack
        Ends it in the end, and already if the start is interrupted.
    folder, name
        Where that is kept, and under which name.
    command
        The module to run, and its arguments; the process id of this process comes before them.
    environment
        What is added to the environment.
    """

    def __init__(
        self,
        stack: ExitStack,
        folder: Path,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
    ) -> None:
        stack.callback(self.kill)
        self._printed, self._log = folder / f"{name}.out", folder / f"{name}.log"
        module, *arguments = command
        inherited = {key: value for key, value in os.environ.items() if key not in _NOT_INHERITED}
        # This very package, and no file of the working directory that is called like a module.
        package = str(Path(__file__).parents[2])
        inherited["PYTHONPATH"] = os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH"))))
        with self._printed.open("wb") as printed, self._log.open("wb") as log, _later_interrupted():
            super().__init__(
                [sys.executable, "-P", "-m", f"{__package__}.{module}", str(os.getpid()), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=log,
                env=inherited | {"OPENBLAS_NUM_THREADS": "1"} | dict(environment or {}),
                start_new_session=True,
            )

    @property
    def has_ended(self) -> bool:
        """Whether the process has ended."""
        return self.poll() is not None

    def log(self) -> str:
        """Return what it has logged."""
        return self._log.read_text(encoding="utf-8", errors="replace")

    def printed(self) -> JsonObject:
        """Return the JSON object that it has printed, empty if there is none."""
        lines = self._printed.read_text(encoding="utf-8").splitlines()
        result: JsonObject = json.loads(lines[-1]) if lines else {}
        return result

    def end(self, number: signal.Signals) -> int:
        """Send a signal and wait for the end; return the exit code, which is that of SIGKILL if it took too long."""
        self.send_signal(number)
        try:
            return self.wait(LONGEST_S)
        except subprocess.TimeoutExpired:
            self.kill()
            return self.wait()

    def kill(self) -> None:
        """End the process and whatever it has started."""
        if getattr(self, "pid", None) is None or self.returncode is not None:
            return  # never started; or its process id may be another's by now
        with contextlib.suppress(ProcessLookupError):
            try:
                os.killpg(self.pid, signal.SIGKILL)
            except ProcessLookupError:  # no group of its own yet
                os.kill(self.pid, signal.SIGKILL)
        self.wait()


@contextlib.contextmanager
def _later_interrupted() -> Iterator[None]:
    """Let an interruption from the keyboard wait until a block is done, in which a process would be lost."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is None:
        yield
        return
    interrupted = False

    def remember(*_: object) -> None:
        nonlocal interrupted
        interrupted = True

    before = signal.signal(signal.SIGINT, remember)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if interrupted:
            signal.raise_signal(signal.SIGINT)
