"""The log: structlog events as lines on stderr, written by a thread, so that a stuck pipe never delays a tick."""

import logging
import os
import queue
import sys
import threading
from typing import TYPE_CHECKING, Any, Final, TextIO

import structlog

if TYPE_CHECKING:
    from collections.abc import Callable

_PRIORITY: Final = {"debug": 7, "info": 6, "warning": 4, "error": 3, "critical": 2}
_END: Final = None


class LogWriter:
    """Hands finished lines to a thread that writes them; when the queue is full, lines are dropped and counted."""

    def __init__(self, stream: TextIO, capacity: int = 1000) -> None:
        self._stream = stream
        self._queue: queue.Queue[str | None] = queue.Queue(capacity)
        self.dropped = 0
        self.restore: Callable[[], None] = structlog.reset_defaults
        self._thread = threading.Thread(target=self._write, name="log", daemon=True)
        self._thread.start()

    def msg(self, line: str) -> None:
        """Take one line; never waits."""
        try:
            self._queue.put_nowait(line)
        except queue.Full:
            self.dropped += 1

    log = debug = info = warning = error = critical = msg

    def close(self, timeout_s: float = 1.0) -> None:
        """Write what is waiting, for at most `timeout_s`, and give the process its former logging back."""
        self.restore()
        try:
            self._queue.put(_END, timeout=timeout_s)
        except queue.Full:
            return
        self._thread.join(timeout_s)

    def _write(self) -> None:
        while (line := self._queue.get()) is not _END:
            try:
                self._stream.write(line + "\n")
                self._stream.flush()
            except (OSError, ValueError):  # the reader went away, or the stream was closed
                self.dropped += 1


def _with_journal_priority(_: Any, method: str, event: str) -> str:
    return f"<{_PRIORITY.get(method, 6)}>{event}"


def open_log(level: str, stream: TextIO | None = None, capacity: int = 1000) -> LogWriter:
    """Configure structlog for this process and return the writer, to be closed at the end.

    On a terminal a line is made for eyes; elsewhere it is JSON, and for journald behind the ``<N>`` prefix by which it
    tells the priority.

    Parameters
    ----------
    level
        Least severe level that is written.
    stream
        Where to; stderr by default.
    capacity
        Lines that may wait to be written; more are dropped and counted.
    """
    stream = stream or sys.stderr
    writer = LogWriter(stream, capacity)
    for_eyes = stream.isatty()
    renderers: list[Any] = (
        [structlog.dev.ConsoleRenderer(colors=True)]
        if for_eyes
        else [
            structlog.processors.JSONRenderer(),
            *([_with_journal_priority] if "JOURNAL_STREAM" in os.environ else []),
        ]
    )
    least = logging.getLevelNamesMapping()[level.upper()]
    outer = structlog.get_config() if structlog.is_configured() else None
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=not for_eyes),
            structlog.processors.format_exc_info,
            *renderers,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(least),
        logger_factory=lambda *_: writer,
        cache_logger_on_first_use=False,
    )
    root, from_can = logging.getLogger(), logging.getLogger("can")
    before = root.handlers[:], root.level, from_can.level

    def restore() -> None:
        structlog.reset_defaults()
        if outer is not None:
            structlog.configure(**outer)
        handlers, root_level, can_level = before
        root.handlers[:] = handlers
        root.setLevel(root_level)
        from_can.setLevel(can_level)

    writer.restore = restore
    root.handlers[:] = [_FromStandardLibrary()]
    root.setLevel(max(least, logging.INFO))
    from_can.setLevel(logging.CRITICAL)  # it logs each error that it raises; the link reports it once, with what to do
    return writer


class _FromStandardLibrary(logging.Handler):
    """Passes what libraries log on to structlog."""

    def emit(self, record: logging.LogRecord) -> None:
        structlog.get_logger().log(record.levelno, record.getMessage(), room=record.name, exc_info=record.exc_info)
