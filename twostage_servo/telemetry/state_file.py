"""A small file that is replaced whole: whatever ends the process or the power leaves the old one or the new one."""

import contextlib
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from twostage_servo.api.fields import JsonObject

_UNFINISHED: Final = ".part"
_ERASED: Final = ".erased"
"""Ending of an empty file beside one that counts as erased, since it could not be removed."""
_LARGEST_BYTES: Final = 65_536
"""Of a file that is read: what is larger is none of ours."""


class CountsAsErasedError(OSError):
    """A file could not be removed, but counts as erased from now on; its text says why it could not."""


def write_state(path: Path, document: JsonObject) -> None:
    """Put a document in the place of the one that a file holds, or of none.

    Parameters
    ----------
    path
        The file; its folder is made if it is not there.
    document
        What to write; its numbers are finite.

    Raises
    ------
    OSError, ValueError
        If it cannot be written; the file is as it was.
    """
    path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
    # A name that nobody else has: another service may write to the same folder.
    descriptor, unfinished = tempfile.mkstemp(_UNFINISHED, f"{path.name}.", path.parent)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            json.dump(document, file, allow_nan=False)
            file.flush()
            os.fchmod(descriptor, 0o644)  # as trip files have
            os.fsync(descriptor)
        os.replace(unfinished, path)  # noqa: PTH105 - what mkstemp gives is a string
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(unfinished)  # noqa: PTH108 - likewise
        raise
    _mark_of(path).unlink(missing_ok=True)  # it told of the former one
    _sync_folder(path.parent)


def read_state(path: Path) -> JsonObject | None:
    """Return the document that a file holds, or None if there is no file.

    Raises
    ------
    OSError, ValueError
        If it cannot be read, counts as erased, or holds something else.
    """
    if os.path.lexists(path) and os.path.lexists(mark := _mark_of(path)):
        raise ValueError(f"it counts as erased ({mark}), since it could not be removed: remove it")
    try:
        with open(path, "rb", opener=_open_without_waiting) as file:
            data = file.read(_LARGEST_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        return None
    if len(data) > _LARGEST_BYTES:
        raise ValueError(f"it has more than {_LARGEST_BYTES} bytes")
    try:
        document = json.loads(data.decode(), parse_constant=_refuse_constant)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(document, dict):
        raise ValueError("it holds no object of JSON")  # noqa: TRY004 - of its content, not of an argument
    return document


def erase_state(path: Path) -> None:
    """Remove a file, if there is one, so that it does not come back after a power cut.

    One that cannot be removed, such as another user's in a sticky folder, is marked: it is not read any more.

    Raises
    ------
    CountsAsErasedError
        If it is only marked.
    OSError
        If it cannot be marked either.
    """
    try:
        path.unlink()
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        _mark(path)
        raise CountsAsErasedError(str(error)) from error
    _sync_folder(path.parent)


def remove_remains(path: Path) -> None:
    """Remove what a process has left of a file that ended while it wrote, and the mark of a file that has gone.

    Raises
    ------
    OSError
        If that cannot be done.
    """
    for unfinished in _unfinished(path):
        unfinished.unlink(missing_ok=True)
    if not os.path.lexists(path):
        _mark_of(path).unlink(missing_ok=True)


def _mark_of(path: Path) -> Path:
    return path.with_name(path.name + _ERASED)


def _mark(path: Path) -> None:
    """Let a file count as erased, also after a power cut."""
    mark = _mark_of(path)
    if not os.path.lexists(mark):
        mark.touch(mode=0o644)
    _sync_folder(path.parent)


def _unfinished(path: Path) -> Iterator[Path]:
    if not path.parent.is_dir():
        return
    for one in path.parent.iterdir():
        if one.name.startswith(f"{path.name}.") and one.suffix == _UNFINISHED:
            yield one


def _sync_folder(folder: Path) -> None:
    """Let the names in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _open_without_waiting(path: str, flags: int) -> int:
    """Open a file; a pipe of this name would keep the service from starting."""
    return os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no number of JSON")
