"""Trip files: what the service saw in the seconds before a trip, on disk, where the next shift finds it."""

import asyncio
import contextlib
import errno
import fcntl
import json
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import structlog

from twostage_servo.api.fields import JsonObject
from twostage_servo.axis.trips import TripFile
from twostage_servo.printable import ready_for_json
from twostage_servo.worker_thread import WorkerThread

Document = JsonObject
Records = Sequence[Sequence[Any]]

KEPT = 50
"""Files kept in the folder; the one with the lowest number goes."""

_NUMBERED: Final = re.compile(r"(\d{6,18})-\d{8}T\d{6}Z-.*\.(json|part)")
"""What a trip file is called: whatever else lies in the folder is not ours to remove."""
_EARLIER: Final = re.compile(r"\d{8}T\d{6}Z-\d+-\d+-.*\.(json|part)")
"""What they were called before they had numbers: these are older than any that has one."""

_LOCK_ATTEMPTS: Final = 200
_LOCK_PAUSE_S: Final = 0.01
_LONGEST_END_S: Final = 5.0


def default_folder() -> Path:
    """Return where trip files go if the configuration does not say: systemd's state directory, or the user's."""
    if directory := os.environ.get("STATE_DIRECTORY"):
        return Path(directory.partition(":")[0]) / "trips"
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "twostage-servo" / "trips"


class TripFiles:
    """Writes a file for each trip, outside the loop: neither a full disk nor a hanging one delays a tick.

    A file appears under its name only when it is whole and on the disk, so a power cut leaves the old state or the new.
    Its name begins with a number that is one more than any in the folder: no clock, process or reboot decides which
    file is the newest, and none is written over.

    Parameters
    ----------
    folder
        Where; it is made when it is needed. A relative one is of the service's working directory, now.
    writer
        Writes one and returns its path; :func:`write_file` by default.

    Attributes
    ----------
    latest
        Path of the newest file of this run, or None.
    error
        Why the last one could not be written, or None.
    """

    def __init__(self, folder: Path, writer: Callable[[Path, str, Document, Records], Path] | None = None) -> None:
        self.folder = folder.absolute()  # of the service: whoever reads the path stands elsewhere
        self._write_file = writer or write_file
        self.latest: Path | None = None
        self.error: str | None = None
        # A thread of its own: a disk that hangs must not keep the bus from being opened again.
        self._thread = WorkerThread("trip_files")
        self._writing: set[asyncio.Future[Path]] = set()
        self._log = structlog.get_logger().bind(room="trip_files")

    def start(self) -> None:
        """Start the thread that writes, so that no trip has to.

        Raises
        ------
        RuntimeError
            If the system has no thread left.
        """
        self._thread.start()

    def write(
        self, axis: str, code: str, document: Document, records: Records, file: TripFile | None = None
    ) -> TripFile:
        """Begin to write a file; never waits, and never raises.

        Parameters
        ----------
        axis, code
            Which axis has tripped, and how: both go into the file's name.
        document, records
            What to write.
        file
            Is told what becomes of it.

        Returns
        -------
        TripFile
            `file`, or a new one.
        """
        file = TripFile() if file is None else file
        try:
            future = asyncio.get_running_loop().run_in_executor(
                self._thread, self._write_file, self.folder, _plain(f"{axis}-{code}"), document, records
            )
            self._writing.add(future)
            future.add_done_callback(lambda done: self._written(axis, code, done, file))
        except (RuntimeError, MemoryError) as error:
            self.fail(axis, code, error, file)
        return file

    def fail(self, axis: str, code: str, error: BaseException, file: TripFile) -> None:
        """Tell that a file could not be written, and why."""
        why = str(error) or ("out of memory" if isinstance(error, MemoryError) else type(error).__name__)
        self.error = f"no trip file can be written in {self.folder}: {why}"
        file.fail(self.error)
        self._log.error("no trip file", axis=axis, code=code, error=self.error)

    def close(self) -> None:
        """Let what is being written be written, and end the thread; a disk that hangs is not waited for."""
        if not self._thread.end(_LONGEST_END_S):
            self._log.error("a trip file is not written: its disk does not respond", folder=str(self.folder))

    def _written(self, axis: str, code: str, future: "asyncio.Future[Path]", file: TripFile) -> None:
        self._writing.discard(future)
        if future.cancelled():
            return
        if error := future.exception():
            self.fail(axis, code, error, file)
        else:
            self.latest, self.error = future.result(), None
            file.complete(str(self.latest))
            self._log.info("trip file", axis=axis, code=code, path=file.path)


def _plain(name: str) -> str:
    return "".join(character if character.isalnum() or character in "-_" else "_" for character in name)


def write_file(folder: Path, name: str, document: Document, records: Records) -> Path:
    """Write a document with its records as JSON, whole or not at all; a number that is not finite becomes null.

    The trip in the document's snapshot, if there is one, is told the path of this very file.

    Parameters
    ----------
    folder
        Where; it is made if it is not there. Several services may share it.
    name
        What comes behind number and time in the file's name.
    document, records
        What to write.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    folder.mkdir(mode=0o750, parents=True, exist_ok=True)
    directory = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with _locked(directory):
            unfinished, descriptor = _new_file(folder, name)
        path = unfinished.with_suffix(".json")
        try:
            _write(descriptor, _with_own_path(document, path), records)
            with _locked(directory):
                unfinished.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                unfinished.unlink()
            raise
        finally:
            os.close(descriptor)
        os.fsync(directory)  # the name, too, survives a power cut
        with _locked(directory):
            _age_out(folder, path)
    finally:
        os.close(directory)
    return path


@contextlib.contextmanager
def _locked(directory: int) -> Iterator[None]:
    """Keep other services out of the folder meanwhile: each number is given once.

    One that was stopped while it had the folder is not waited for, and where a file system has no locks, this goes on
    without: what is lost then is the order of two files of the same moment.
    """
    for _ in range(_LOCK_ATTEMPTS):
        try:
            fcntl.flock(directory, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        except BlockingIOError:
            time.sleep(_LOCK_PAUSE_S)
        except OSError:
            break
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.flock(directory, fcntl.LOCK_UN)


def _new_file(folder: Path, name: str) -> tuple[Path, int]:
    """Make an unfinished file of the next number, marked as being written; return its path and descriptor."""
    number = 1 + max((_rank(file)[0] for file in folder.iterdir()), default=0)
    while True:
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        path = folder / f"{number:06d}-{stamp}-{name}.part"
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except FileExistsError:
            number += 1
            continue
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return path, descriptor


def _with_own_path(document: Document, path: Path) -> Document:
    snapshot = document.get("snapshot")
    if not snapshot or snapshot.get("trip") is None:
        return document
    return document | {"snapshot": snapshot | {"trip": snapshot["trip"] | {"file": str(path)}}}


def _write(descriptor: int, document: Document, records: Records) -> None:
    whole = document | {"records": [ready_for_json(record) for record in records]}
    with os.fdopen(descriptor, "w", encoding="utf-8", closefd=False) as file:
        json.dump(whole, file, allow_nan=False)
        file.flush()
        os.fsync(descriptor)


def _rank(file: Path) -> tuple[int, str]:
    """Return what files are put into order by, the oldest first: number, then name; 0 for what is no numbered one."""
    match = _NUMBERED.fullmatch(file.name)
    return (int(match[1]) if match else 0), file.name


def _age_out(folder: Path, newest: Path) -> None:
    """Remove the oldest files beyond the limit, and what a power cut has left unfinished."""
    ours = [file for file in folder.iterdir() if _NUMBERED.fullmatch(file.name) or _EARLIER.fullmatch(file.name)]
    whole = sorted((file for file in ours if file.suffix == ".json" and file != newest), key=_rank)
    for old in whole[: -(KEPT - 1)]:
        old.unlink(missing_ok=True)
    for unfinished in ours:
        if unfinished.suffix == ".part" and not _is_being_written(unfinished):
            unfinished.unlink(missing_ok=True)


def _is_being_written(unfinished: Path) -> bool:
    """Whether a process has the file: a lock ends with whoever had it, and no clock has to be believed."""
    try:
        descriptor = os.open(unfinished, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        return error.errno != errno.ENOENT
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False
