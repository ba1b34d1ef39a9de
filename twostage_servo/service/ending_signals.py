"""Signals that would end the process: each of them brings the axes to rest first, and none leaves a drive enabled.

A window that is closed sends SIGHUP, a keyboard SIGQUIT, a limit of the processor's time SIGXCPU, and anybody with the
same user any of them. By default each ends a process at once, in mid-move and without a word to the drive.
"""

import contextlib
import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Final, Self

import structlog

if TYPE_CHECKING:
    import asyncio

_FAULTS: Final = frozenset(
    {signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV, signal.SIGSYS, signal.SIGTRAP}
)
"""What the processor or a library says of a program that cannot go on; SIGABRT is also how a service manager ends one
that hangs. As with SIGKILL, the drive's own time-out has to stop the axis."""

_HARMLESS: Final = frozenset({signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH})
"""Which end no process by default."""

_OF_A_BACKGROUND_JOB: Final = frozenset({signal.SIGTTIN, signal.SIGTTOU})
_JOB_CONTROL: Final = frozenset({signal.SIGTSTP, *_OF_A_BACKGROUND_JOB})

_USUAL: Final = frozenset({signal.SIGTERM, signal.SIGINT})
"""How one asks a service to end: that is no failure."""

_FROM_A_SHELL: Final = 128

ENDING: Final = frozenset(
    number
    for number in signal.valid_signals()
    if number not in {signal.SIGKILL, signal.SIGSTOP, *_FAULTS, *_HARMLESS, *_JOB_CONTROL}
)
"""All that can be caught and would end the process, the real-time signals among them."""


class EndingSignals:
    """Catches them; a context manager, to be entered before anything that takes long.

    Until there is something to bring to rest, one ends the program at once, like SIGINT with KeyboardInterrupt. From
    :meth:`call` on the first one calls, in the loop, what ends the service, and any other is as if it had not come:
    nothing cuts the braking short. A suspended controller is dead to its drive, so SIGTSTP is refused, and SIGTTIN and
    SIGTTOU are ignored. What was ignored or caught before, as SIGHUP is under nohup, stays so.

    Attributes
    ----------
    received
        Number of the first one that ends the program, or None.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._end: Callable[[], None] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._before = contextlib.ExitStack()

    def __enter__(self) -> Self:
        """Begin to catch."""
        if threading.current_thread() is not threading.main_thread():  # which alone can
            return self
        with contextlib.ExitStack() as stack:
            for number in (*ENDING, *_JOB_CONTROL):
                before = signal.getsignal(number)
                is_usual = number in _USUAL and before in {signal.SIG_IGN, signal.default_int_handler}
                if before is signal.SIG_DFL or is_usual:
                    handler = signal.SIG_IGN if number in _OF_A_BACKGROUND_JOB else self._catch
                    stack.callback(signal.signal, number, before)
                    signal.signal(number, handler)
            self._before = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Give the process its former handlers back."""
        self._before.close()

    def call(self, end: Callable[[], None], loop: "asyncio.AbstractEventLoop") -> None:
        """Call this, in the loop, in place of ending the program at once."""
        self._loop, self._end = loop, end
        if self.received is not None:  # while something swallowed what it raised
            loop.call_soon(self._begin_to_end, self.received)

    @property
    def exit_code(self) -> int:
        """What the program has to end with: 0, or 128 and the number, as a shell says that a signal has ended it."""
        if self.received is None or self.received in _USUAL:
            return 0
        return _FROM_A_SHELL + self.received

    def _catch(self, number: int, _: FrameType | None) -> None:
        loop = self._loop
        if number == signal.SIGTSTP:
            if loop is not None and not loop.is_closed():
                loop.call_soon_threadsafe(_refuse_to_be_suspended)
            return
        is_first = self.received is None
        if is_first:
            self.received = number
        if loop is None:
            if number == signal.SIGINT:
                raise KeyboardInterrupt
            raise SystemExit(self.exit_code)
        if is_first and not loop.is_closed():
            loop.call_soon_threadsafe(self._begin_to_end, number)

    def _begin_to_end(self, number: int) -> None:
        level = "info" if number in _USUAL else "warning"
        getattr(structlog.get_logger(), level)("ending on a signal", signal=_name(number))
        if self._end is not None:
            self._end()


def _refuse_to_be_suspended() -> None:
    text = "not suspended: a suspended service cannot control its drives; end it with SIGTERM or Ctrl-C"
    structlog.get_logger().warning(text, signal="SIGTSTP")


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # a real-time signal between the first and the last
        return f"SIGRTMIN+{number - signal.SIGRTMIN}"
