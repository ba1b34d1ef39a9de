"""The log: structlog events as lines, written by a thread, so that a stuck pipe or journal never delays a tick."""

import enum
import logging
import math
import queue
import sys
import threading
import time
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any, Final, TextIO

import structlog

from twostage_servo.printable import printable, printable_json, printable_line
from twostage_servo.service.journal import JournalStream, goes_to_the_journal

_END: Final = None
_OF_OURS: Final = ("event", "axis", "bus", "code", "now")
"""What tells kinds of events apart: words of this program, and names that the configuration gives."""
_OF_REQUESTS: Final = ("event", "op", "code")
"""The same where the event is about a request: the client has chosen all the rest."""
_OF_LIBRARIES: Final = ("room",)
"""The same for what libraries log, whose texts may have numbers in them."""
_MOST_KINDS: Final = 1000
_THE_REST: Final = ("the rest",)
"""One kind for all that would be more than that."""


class LogWriter:
    """Hands finished lines to a thread that writes them; when the queue is full, lines are dropped and counted.

    Attributes
    ----------
    dropped
        Lines that were lost; a line that has room again is followed by one that tells their number.
    """

    def __init__(
        self,
        stream: "TextIO | JournalStream",
        capacity: int = 1000,
        restore: Callable[[], None] = structlog.reset_defaults,
    ) -> None:
        self._stream = stream
        self._queue: queue.Queue[str | None] = queue.Queue(capacity)
        self.dropped = self._told = 0
        self._restore = restore
        self._thread = threading.Thread(target=self._write, name="log", daemon=True)
        self._thread.start()

    def msg(self, line: str) -> None:
        """Queue one line; never waits."""
        try:
            self._queue.put_nowait(line)
        except queue.Full:
            self.dropped += 1
            return
        if lost := self.dropped - self._told:
            self._told += lost
            structlog.get_logger().error("log lines were lost: the reader of the log does not keep up", lines=lost)

    log = debug = info = warning = error = critical = msg

    def close(self, timeout_s: float = 1.0) -> None:
        """Write what is waiting, for at most `timeout_s`, and give the process its former logging back."""
        self._restore()
        try:
            self._queue.put(_END, timeout=timeout_s)
        except queue.Full:
            return
        self._thread.join(timeout_s)
        if isinstance(self._stream, JournalStream) and not self._thread.is_alive():
            self._stream.close()

    def _write(self) -> None:
        while (line := self._queue.get()) is not _END:
            try:
                self._stream.write(line + "\n")
                self._stream.flush()
            except (OSError, ValueError, MemoryError):  # no reader, no stream, or no memory any more
                self.dropped += 1


class RateLimit:
    """Lets no event of one kind through more than so often: of a flood, the log has the beginning.

    Of one kind are events of the same text, axis, bus and code, and of the same new state; or of the same request and
    code, whatever else the request says: a flood of set-points hides nobody's reset, and nobody makes kinds by making
    up names. How many were left out is told with the next one of their kind, as ``left_out``.

    Parameters
    ----------
    burst
        Events of one kind that are let through in a window.
    window_s
        Length of a window, s; it begins with an event.
    clock
        Tells the time, s.
    """

    def __init__(self, burst: int = 100, window_s: float = 10.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._burst = burst
        self._window_s = window_s
        self._clock = clock
        self._kinds: dict[tuple[str, ...], _Window] = {}
        self._next_look_s = -math.inf

    def __call__(self, _: Any, method: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
        """Return the event, or leave it out.

        Raises
        ------
        structlog.DropEvent
            When there were too many of its kind.
        """
        now_s = self._clock()
        kind = self._known(_kind(method, event), now_s)
        window = self._kinds.get(kind)
        if window is None or now_s >= window.ends_s:
            left_out = 0 if window is None else window.left_out
            self._kinds[kind] = _Window(now_s + self._window_s)
            if left_out:
                event["left_out"] = left_out
            return event
        window.let_through += 1
        if window.let_through > self._burst:
            window.left_out += 1
            raise structlog.DropEvent
        return event

    def _known(self, kind: tuple[str, ...], now_s: float) -> tuple[str, ...]:
        """Return the kind, or the one that stands for all others when there are too many."""
        if kind in self._kinds or len(self._kinds) < _MOST_KINDS - 1:
            return kind
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + self._window_s
            self._kinds = {one: window for one, window in self._kinds.items() if now_s < window.ends_s}
        return kind if len(self._kinds) < _MOST_KINDS - 1 else _THE_REST


def _kind(method: str, event: MutableMapping[str, Any]) -> tuple[str, ...]:
    keys = _OF_LIBRARIES if event.get("library") else _OF_REQUESTS if "op" in event else _OF_OURS
    return method, *(str(event.get(key)) for key in keys)


@dataclass(slots=True)
class _Window:
    ends_s: float
    let_through: int = 1
    left_out: int = 0


def open_log(level: str, stream: TextIO | None = None, capacity: int = 1000) -> LogWriter:
    """Configure structlog for this process and return the writer, to be closed at the end.

    On a terminal a line is made for eyes; elsewhere it is JSON, which goes to systemd's journal as an entry with fields
    where that reads the stream. Floods are cut short, see :class:`RateLimit`.

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
    for_eyes = stream.isatty()
    render = _for_eyes if for_eyes else _as_json
    least = logging.getLevelNamesMapping()[level.upper()]
    outer = structlog.get_config() if structlog.is_configured() else None
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

    writer = LogWriter(JournalStream(stream) if goes_to_the_journal(stream) else stream, capacity, restore)
    structlog.configure(
        processors=[
            RateLimit(),
            _without_mark,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=not for_eyes),
            structlog.processors.format_exc_info,
            render,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(least),
        logger_factory=lambda *_: writer,
    )
    root.handlers[:] = [_FromStandardLibrary()]
    root.setLevel(max(least, logging.INFO))
    from_can.setLevel(logging.CRITICAL)  # it logs each error that it raises; the link reports it once, with what to do
    return writer


def _without_mark(_: Any, __: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    event.pop("library", None)
    return event


_CONSOLE: Final = structlog.dev.ConsoleRenderer(colors=True)
_JSON: Final = structlog.processors.JSONRenderer()


def _for_eyes(logger: Any, method: str, event: MutableMapping[str, Any]) -> str:
    """Return an event as a line whose colours are its only orders to the terminal, and its traceback below it."""
    shown = {key: _shown(key, value) for key, value in event.items()}
    return _CONSOLE(logger, method, shown)


def _shown(key: str, value: Any) -> Any:
    if not isinstance(value, str):
        return _without_enumerations(value)  # its repr has escapes
    return printable(value) if key == "exception" else printable_line(value)


def _without_enumerations(value: Any) -> Any:
    """Return what stands in a field with the values of enumerations, whose repr says more than a reader wants."""
    if isinstance(value, Mapping):
        return {_without_enumerations(key): _without_enumerations(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(map(_without_enumerations, value))
    return value.value if isinstance(value, enum.Enum) else value


def _as_json(logger: Any, method: str, event: MutableMapping[str, Any]) -> str:
    return printable_json(str(_JSON(logger, method, event)))


class _FromStandardLibrary(logging.Handler):
    """Passes what libraries log on to structlog."""

    def emit(self, record: logging.LogRecord) -> None:
        structlog.get_logger().log(
            record.levelno, record.getMessage(), room=record.name, library=True, exc_info=record.exc_info
        )
