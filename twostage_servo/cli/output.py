"""Exit codes, and how every verb reports: text for people, or one JSON object on stdout."""

import json
import sys
from enum import IntEnum
from typing import Any

from twostage_servo.printable import printable, printable_json, printable_line


class ExitCode(IntEnum):
    """What a script can rely on."""

    DONE = 0
    INTERNAL = 1
    """Output that cannot be written, or a defect of this program, with its traceback."""
    USAGE = 2
    """Bad usage or configuration."""
    FAILED = 3
    """The axis tripped, or did not do what was asked."""
    UNREACHABLE = 4
    """No service answers."""


class CommandError(Exception):
    """Ends a verb with an exit code and a text for the operator; `details` go into the JSON object."""

    def __init__(self, exit_code: ExitCode, code: str, message: str, details: dict[str, Any] | None = None) -> None:
        super().__init__(message)
        self.exit_code = exit_code
        self.code = code
        self.details = details or {}


def print_json(value: Any) -> None:
    """Print one JSON object on a line of its own."""
    print_line(printable_json(json.dumps(value, allow_nan=False)))


def print_line(text: str) -> None:
    """Print a line on stdout, at once."""
    try:
        sys.stdout.write(printable(text) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise CommandError(ExitCode.INTERNAL, "output", f"the result cannot be written: {error.strerror}") from error


def note(text: str) -> None:
    """Print a line on stderr, where it does not mix with results."""
    sys.stderr.write(printable(text) + "\n")
    sys.stderr.flush()


class Progress:
    """One live line on a terminal; nothing elsewhere."""

    def __init__(self, *, quiet: bool) -> None:
        self._live = not quiet and sys.stderr.isatty()

    def show(self, text: str) -> None:
        """Replace the line."""
        if self._live:
            sys.stderr.write("\r\x1b[K" + printable_line(text))
            sys.stderr.flush()

    def end(self) -> None:
        """Leave the last line standing."""
        if self._live:
            sys.stderr.write("\n")
            sys.stderr.flush()


def bar(share: float, width: int = 30) -> str:
    """Return a bar for a share from 0 to 1."""
    filled = round(width * min(1.0, max(0.0, share)))
    return "█" * filled + "░" * (width - filled)
