"""What laws have learned of their plants, on disk: one small file an axis, for the service's next run."""

import asyncio
import contextlib
import functools
import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import structlog

from twostage_servo.api.fields import JsonObject
from twostage_servo.telemetry.state_file import (
    CountsAsErasedError,
    erase_state,
    read_state,
    remove_remains,
    write_state,
)
from twostage_servo.worker_thread import WorkerThread

_LONGEST_END_S: Final = 2.0
_PLAIN: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_DIGEST_LETTERS: Final = 12


class LearnedFile:
    """What became of the file of one axis.

    Attributes
    ----------
    error
        Why it could not be written or erased, and what to do; None if it is as it should be.
    would_return
        Whether the service's next run would use what was forgotten.
    """

    __slots__ = ("error", "would_return")

    def __init__(self) -> None:
        self.error: str | None = None
        self.would_return = False

    def succeed(self) -> None:
        """Tell that it was written, or erased."""
        self.error, self.would_return = None, False

    def fail(self, error: str, *, would_return: bool = False) -> None:
        """Tell why it could not be; that what was forgotten would return matters more than all that follows."""
        if would_return or not self.would_return:
            self.error, self.would_return = error, would_return


class LearnedFiles:
    """Reads files as the service starts, and writes and erases them outside the loop: no disk delays a tick.

    Files are written and erased in the order in which that was asked for, each whole or not at all. A folder that
    cannot be written is told once, until it can be again.

    Parameters
    ----------
    folder
        Where; it is made when it is needed. A relative one is of the service's working directory, now.
    writer
        Writes one; :func:`~twostage_servo.telemetry.state_file.write_state` by default.
    """

    def __init__(self, folder: Path, writer: Callable[[Path, JsonObject], None] = write_state) -> None:
        self.folder = folder.absolute()
        self._write_file = writer
        # A thread of its own: a disk that hangs must not keep a trip file waiting, if it is another one.
        self._thread = WorkerThread("learned_files")
        self._pending: set[asyncio.Future[None]] = set()
        self._failing: set[str] = set()  # axes whose last file could not be written
        self._log = structlog.get_logger().bind(room="learned_files")

    def start(self) -> None:
        """Start the thread that writes.

        Raises
        ------
        RuntimeError
            If the system has no thread left.
        """
        self._thread.start()

    def path(self, axis: str) -> Path:
        """Return the file of an axis; axes of different names have different ones."""
        if _PLAIN.fullmatch(axis):
            return self.folder / f"learned-{axis}.json"
        digest = hashlib.sha256(axis.encode("utf-8", "surrogatepass")).hexdigest()
        return self.folder / f"learned-{digest[:_DIGEST_LETTERS]}.json"

    def exists(self, axis: str) -> bool:
        """Whether there is a file of an axis, or may be one that cannot be seen."""
        try:
            self.path(axis).lstat()
        except FileNotFoundError:
            return False
        except OSError as error:
            return not isinstance(error, NotADirectoryError)
        return True

    def read(self, axis: str) -> JsonObject | None:
        """Return what the file of an axis holds, None without one; waits for the disk.

        Raises
        ------
        OSError, ValueError
            If it cannot be read.
        """
        path = self.path(axis)
        with contextlib.suppress(OSError):
            remove_remains(path)
        return read_state(path)

    def write(self, axis: str, document: JsonObject, file: LearnedFile) -> None:
        """Begin to write the file of an axis; never waits, and never raises."""
        path = self.path(axis)
        ended = functools.partial(self._written, axis, path, file)
        self._begin(functools.partial(self._write_file, path, document), ended)

    def erase(self, axis: str, file: LearnedFile) -> None:
        """Begin to erase the file of an axis; never waits, and never raises."""
        path = self.path(axis)
        self._begin(functools.partial(erase_state, path), functools.partial(self._erased, axis, path, file))

    async def settled(self) -> bool:
        """Wait until what was begun has ended, but not for a disk that hangs; return whether it has."""
        return not self._pending or not (await asyncio.wait(self._pending, timeout=_LONGEST_END_S))[1]

    async def close(self) -> None:
        """Let what was begun end, and the thread with it; a disk that hangs is not waited for."""
        if not await self.settled():
            self._log.error("what a law has learned is not written: the disk does not respond", folder=str(self.folder))
        self._thread.end(0.0)

    def _begin(self, work: Callable[[], None], ended: Callable[[BaseException | None], None]) -> None:
        try:
            future = asyncio.get_running_loop().run_in_executor(self._thread, work)
        except (RuntimeError, MemoryError) as error:  # no thread, or no memory left
            ended(error)
            return
        self._pending.add(future)
        future.add_done_callback(functools.partial(self._finish, ended))

    def _finish(self, ended: Callable[[BaseException | None], None], future: "asyncio.Future[Any]") -> None:
        self._pending.discard(future)
        if not future.cancelled():
            ended(future.exception())

    def _written(self, axis: str, path: Path, file: LearnedFile, error: BaseException | None) -> None:
        if error is None:
            self._failing.discard(axis)
            file.succeed()
            return
        file.fail(f"{path} cannot be written ({_reason(error)}): what was learned since ends with the service")
        if axis not in self._failing:
            self._failing.add(axis)
            text = "what a law has learned cannot be written, and ends with the service"
            told = {"folder": str(self.folder), "error": _reason(error), "key": "axis.law.memory"}
            self._log.warning(text, axis=axis, **told)

    def _erased(self, axis: str, path: Path, file: LearnedFile, error: BaseException | None) -> None:
        before = file.error
        if error is None:
            file.succeed()
        elif isinstance(error, CountsAsErasedError):
            file.succeed()
            file.fail(f"{path} cannot be erased ({error}), and is not used any more: remove it")
            if file.error != before:
                text = "what a law has learned cannot be erased, and is not used any more: remove the file"
                self._log.warning(text, axis=axis, path=str(path), error=_reason(error))
        else:
            advice = "and the next start of the service would use it: remove it before"
            file.fail(f"{path} cannot be erased ({_reason(error)}), {advice}", would_return=True)
            if file.error != before:
                text = "what a law has learned cannot be erased: remove the file before the service starts again"
                self._log.error(text, axis=axis, path=str(path), error=_reason(error))


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__
