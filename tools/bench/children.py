"""Child processes that never outlive the benchmark, whichever way it ends."""

import contextlib
import ctypes
import functools
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Final

from tools.bench.scheduling import run_at

ROOT: Final = Path(__file__).resolve().parents[2]
_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h
_LIBC: Final = ctypes.CDLL(None)
_PATIENCE_S: Final = 5.0


class ChildError(Exception):
    """A child did not do what it was for."""


def module(name: str, *arguments: object) -> list[str]:
    """Return the command that runs a module of this package in the present interpreter."""
    return [sys.executable, "-P", "-m", f"tools.bench.{name}", *map(str, arguments)]


def environment(extra: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return an environment in which this package and the one under test are found, and numpy uses one thread."""
    folders = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(folders), "OPENBLAS_NUM_THREADS": "1"} | dict(extra or {})


@contextlib.contextmanager
def child(
    command: Sequence[str],
    *,
    extra: Mapping[str, str] | None = None,
    stdout: int | IO[str] | None = subprocess.PIPE,
    stderr: int | IO[str] | None = None,
    priority: int = 0,
) -> Iterator["subprocess.Popen[str]"]:
    """Run a child beside the block, and end it with the block; the kernel ends it should this process be killed.

    Parameters
    ----------
    command
        The program and its arguments.
    extra
        Added to its environment.
    stdout, stderr
        As :class:`subprocess.Popen` takes them.
    priority
        Its SCHED_FIFO priority, which the caller has found to be permitted; 0 for the ordinary class.
    """
    with subprocess.Popen(  # noqa: S603 - our own words, and no shell
        command,
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        text=True,
        env=environment(extra),
        process_group=0,  # Ctrl-C is for this process, which then ends its children
        preexec_fn=functools.partial(_prepare, priority),  # noqa: PLW1509 - there are no threads here
    ) as process:
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(_PATIENCE_S)
            except BaseException:
                process.kill()
                raise


def output_of(
    command: Sequence[str], timeout_s: float, extra: Mapping[str, str] | None = None, priority: int = 0
) -> str:
    """Run a child to its end and return what it printed.

    Raises
    ------
    ChildError
        If it fails or takes too long; with the last line of its complaint.
    """
    with child(command, extra=extra, stderr=subprocess.PIPE, priority=priority) as process:
        try:
            output, complaint = process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired as error:
            raise ChildError(f"{_named(command)} did not end within {timeout_s:g} s") from error
    if process.returncode != 0:
        last = (complaint.strip().splitlines() or ["without a word"])[-1]
        raise ChildError(f"{_named(command)} ended with {process.returncode}: {last}")
    return output


def json_of(command: Sequence[str], timeout_s: float, priority: int = 0) -> Any:
    """Run a child to its end and return the JSON of the last line that it printed.

    Raises
    ------
    ChildError
        If it fails, takes too long, or prints none.
    """
    lines = output_of(command, timeout_s, priority=priority).strip().splitlines()
    if not lines:
        raise ChildError(f"{_named(command)} printed nothing")
    return json.loads(lines[-1])


def first_line(process: "subprocess.Popen[str]") -> str:
    """Wait for a child's first line: it says that the child is ready.

    Raises
    ------
    ChildError
        If it ends without one.
    """
    assert process.stdout is not None  # noqa: S101 - for the type checker: `child` opened it
    line = process.stdout.readline()
    if not line:
        raise ChildError(f"{process.args!r} ended before it was ready")
    return line.strip()


def _named(command: Sequence[str]) -> str:
    return " ".join([Path(command[0]).name, *command[1:4]])


def _prepare(priority: int) -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    run_at(priority)
