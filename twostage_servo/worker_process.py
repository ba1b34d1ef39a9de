"""Processes that compute a share of something, and must not stay when the one that began them is gone."""

import concurrent.futures
import contextlib
import multiprocessing
import os
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from multiprocessing.connection import wait
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypeVar

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

_ORPHANED: Final = 1
"""Exit code of a process whose parent is gone; nobody is there to read it."""


def end_with_parent() -> None:
    """End this process as soon as the one that began it has ended, in whatever way; a pool's ``initializer``.

    A worker of a pool waits for its next task on a pipe of which it holds the other end as well: where its parent is
    killed, it would wait for ever.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_outlive, args=(parent.sentinel,), name="parent", daemon=True).start()


def _outlive(parent: int) -> None:
    wait([parent])
    os._exit(_ORPHANED)


class InterruptibleProcesses(concurrent.futures.ProcessPoolExecutor):
    """Worker processes that end at once, and without a word, where an error or Ctrl-C ends the block.

    A terminal's Ctrl-C goes to every process of its group, and a worker that raised it would print a traceback and take
    the next task. The workers therefore do not hear it. The executor of the standard library would then wait for all
    that they have begun. These are killed, and the temporary files that they leave are removed with their folder.

    Parameters
    ----------
    workers
        How many.
    initializer, arguments
        Is called in each worker as it begins.
    """

    def __init__(self, workers: int, initializer: Callable[..., object], arguments: tuple[Any, ...] = ()) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="twostage-servo-")
        self._begun: set[BaseProcess] = set()
        context = multiprocessing.get_context("spawn")  # not forked: numpy's threads do not survive that
        super().__init__(workers, context, _begin, (self._folder.name, initializer, arguments))

    def submit(
        self, fn: Callable[_Parameters, _Result], /, *args: _Parameters.args, **kwargs: _Parameters.kwargs
    ) -> concurrent.futures.Future[_Result]:
        """Hand over a call; as long as there are fewer workers than wanted, this begins one."""
        before = set(multiprocessing.active_children())
        with _interrupted_later():
            future = super().submit(fn, *args, **kwargs)
            self._begun |= set(multiprocessing.active_children()) - before
        return future

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Wait for the workers, or end them."""
        if kind is not None:
            for process in self._begun:
                process.kill()
        self.shutdown(cancel_futures=kind is not None)
        self._folder.cleanup()


def _begin(folder: str, initializer: Callable[..., object], arguments: tuple[Any, ...]) -> None:
    end_with_parent()
    tempfile.tempdir = folder
    initializer(*arguments)


@contextlib.contextmanager
def _interrupted_later() -> Iterator[None]:
    """Hold SIGINT back during a block; a process that is begun in it holds it back for good."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
