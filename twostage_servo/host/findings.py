"""What `doctor` finds, and where it looks."""

import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any


class Status(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARN = "warn"
    """The service works, less punctually or less safely than it could."""
    FAIL = "fail"
    """The service cannot do what the configuration asks for."""
    SKIP = "skip"
    """Nothing was checked; `found` says why."""


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check.

    Attributes
    ----------
    name
        What was checked.
    status
        How it ended.
    found
        What is the case.
    remedy
        What to do about it, to be pasted where that is possible; empty where nothing needs to be done.
    """

    name: str
    status: Status
    found: str
    remedy: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the finding, ready for JSON."""
        return asdict(self)


def run_program(arguments: Sequence[str]) -> str:
    """Run a program of the system and return its output.

    Raises
    ------
    OSError
        If it is not installed, fails, or takes longer than 5 s.
    """
    try:
        done = subprocess.run(  # noqa: S603 - our own words, and no shell
            list(arguments), capture_output=True, text=True, timeout=5.0, check=False, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired as error:
        raise OSError(f"{arguments[0]} did not end within 5 s") from error
    if done.returncode != 0:
        raise OSError(done.stderr.strip() or f"{arguments[0]} ended with exit code {done.returncode}")
    return done.stdout


@dataclass(frozen=True, slots=True)
class Host:
    """Where the checks look; a test gives a folder of its own for each.

    Attributes
    ----------
    sys, proc
        Where sysfs and procfs are.
    run
        Runs a program and returns its output. Raises FileNotFoundError if it is not installed, and another OSError with
        what it said if it fails.
    """

    sys: Path = Path("/sys")
    proc: Path = Path("/proc")
    run: Callable[[Sequence[str]], str] = run_program

    def read(self, path: Path) -> str | None:
        """Return a small file's text without the spaces around it; None where it cannot be read."""
        try:
            return path.read_text("utf-8", errors="replace").strip()
        except OSError:
            return None
