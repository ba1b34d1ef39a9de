"""Result files that verbs write where the operator says: whole, or what was there before stays as it is."""

import contextlib
import csv
import io
import os
import stat
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from twostage_servo.cli.output import CommandError, ExitCode


def check_result(path: Path, name: str) -> None:
    """Tell before long work that its result could not be written.

    Raises
    ------
    CommandError
        As `write_result` does; a former file is as it was.
    """
    with _told(path, name):
        if _is_special(path):
            path.open("ab").close()
        else:
            unfinished = _unfinished(path)
            unfinished.open("xb").close()
            unfinished.unlink()


def write_result(path: Path, content: bytes, name: str) -> None:
    """Put a result in the place of what a file holds, or of none; a device or a pipe just gets it.

    Parameters
    ----------
    path
        Where the operator wants it.
    content
        What to write.
    name
        What it is, as in "the recording cannot be written"; also the code of the error.

    Raises
    ------
    CommandError
        If it cannot be written; a former file is as it was.
    """
    with _told(path, name):
        if _is_special(path):
            path.write_bytes(content)
        else:
            _replace(path, content)


def as_csv(rows: Iterable[Sequence[Any]]) -> bytes:
    """Return rows as comma-separated values (RFC 4180)."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(rows)
    return text.getvalue().encode()


@contextlib.contextmanager
def _told(path: Path, name: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        # The error names an unfinished file, which is gone by now.
        text = f"the {name} cannot be written: {path}: {error.strerror}; make room there or name another file"
        raise CommandError(ExitCode.FAILED, name, text) from error


def _is_special(path: Path) -> bool:
    """Whether it is a device, a pipe or a folder: nothing that can be replaced by a file."""
    return path.exists() and not path.is_file()


def _unfinished(path: Path) -> Path:
    file = path.resolve()  # what a symbolic link names, not the link
    return file.with_name(f".{file.name}.{os.urandom(4).hex()}.unfinished")


def _replace(path: Path, content: bytes) -> None:
    unfinished = _unfinished(path)
    try:
        with unfinished.open("xb") as file:
            with contextlib.suppress(FileNotFoundError):
                os.fchmod(file.fileno(), stat.S_IMODE(path.stat().st_mode))
            file.write(content)
        unfinished.replace(path.resolve())
    except BaseException:
        with contextlib.suppress(OSError):
            unfinished.unlink()
        raise
