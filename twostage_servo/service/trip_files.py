"""Trip files: what the service saw in the seconds before a trip, on disk, where the next shift finds it."""

import asyncio
import concurrent.futures
import contextlib
import json
import os
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import structlog

from twostage_servo.service.snapshot import ready_for_json

_ABANDONED_S = 60.0
"""Age at which an unfinished file is nobody's any more."""

Document = dict[str, Any]
Records = Sequence[Sequence[Any]]

KEPT = 50
"""Files kept in the folder; the oldest goes."""

_NAME = re.compile(r"\d{8}T\d{6}Z-\d+-\d+-.*\.json")
"""What a trip file is called: whatever else lies in the folder is not ours to remove."""


def default_folder() -> Path:
    """Return where trip files go if the configuration does not say: systemd's state directory, or the user's."""
    if directory := os.environ.get("STATE_DIRECTORY"):
        return Path(directory.partition(":")[0]) / "trips"
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "twostage-servo" / "trips"


class TripFiles:
    """Writes a file for each trip, outside the loop: neither a full disk nor a hanging one delays a tick.

    A file appears under its name only when it is whole and on the disk, so a power cut leaves the old state or the new.

    Parameters
    ----------
    folder
        Where; it is made when it is needed.
    writer
        Writes one; :func:`write_file` by default.

    Attributes
    ----------
    latest
        Path of the newest file of this run, or None.
    error
        Why the last one could not be written, or None.
    """

    def __init__(self, folder: Path, writer: Callable[[Path, Document, Records], None] | None = None) -> None:
        self.folder = folder
        self._write_file = writer or write_file
        self.latest: Path | None = None
        self.error: str | None = None
        self._number = 0
        # A thread of its own: a disk that hangs must not keep the bus from being opened again.
        self._writer_thread = concurrent.futures.ThreadPoolExecutor(1, "trip_files")
        self._writing: set[asyncio.Future[None]] = set()
        self._log = structlog.get_logger().bind(room="trip_files")

    def write(self, name: str, document: Document, records: Records) -> None:
        """Begin to write a file; ``name`` (axis and code) goes into its name after the time. Never waits."""
        self._number += 1
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        path = self.folder / f"{stamp}-{os.getpid()}-{self._number}-{_plain(name)}.json"
        future = asyncio.get_running_loop().run_in_executor(
            self._writer_thread, self._write_file, path, document, records
        )
        self._writing.add(future)
        future.add_done_callback(lambda done: self._written(done, path))

    def _written(self, future: "asyncio.Future[None]", path: Path) -> None:
        self._writing.discard(future)
        if future.cancelled():
            return
        if error := future.exception():
            self.error = f"{path} cannot be written: {error}"
            self._log.error("no trip file", error=self.error)
        else:
            self.latest, self.error = path, None
            self._log.info("trip file", path=str(path))


def _plain(name: str) -> str:
    return "".join(character if character.isalnum() or character in "-_" else "_" for character in name)


def write_file(path: Path, document: Document, records: Records) -> None:
    """Write a document with its records as JSON, whole or not at all; a number that is not finite becomes null.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
    document = document | {"records": [ready_for_json(record) for record in records]}
    unfinished = path.with_suffix(".part")
    try:
        with unfinished.open("w", encoding="utf-8") as file:
            json.dump(document, file, allow_nan=False)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            unfinished.unlink()
        raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)  # the name, too, survives a power cut
    finally:
        os.close(folder)
    others = [file for file in path.parent.iterdir() if _NAME.fullmatch(file.name) and file != path]
    for old in sorted(others)[: -(KEPT - 1)]:  # never the new one, whatever the clock has been set to
        old.unlink(missing_ok=True)
    for unfinished in path.parent.glob("*.part"):  # of a power cut
        if _NAME.fullmatch(unfinished.with_suffix(".json").name) and _age_s(unfinished) > _ABANDONED_S:
            unfinished.unlink(missing_ok=True)


def _age_s(path: Path) -> float:
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:  # its writer has finished it
        return 0.0
