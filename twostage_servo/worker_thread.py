"""One thread that is there before it is needed, for work that may block."""

import concurrent.futures
import queue
import threading
from collections.abc import Callable
from typing import Any, Final, ParamSpec, TypeVar

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

_END: Final = None
_Work = tuple[concurrent.futures.Future[Any], Callable[[], Any]]


class WorkerThread(concurrent.futures.Executor):
    """An executor of a single thread, which never needs another one and keeps no process from ending.

    The executors of the standard library start a thread when there is work: at the first trip, on a host that has none
    left, there would be no file. They also wait for their threads at the end of the process, however long a disk hangs.

    Parameters
    ----------
    name
        Of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._work: queue.SimpleQueue[_Work | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread, if it does not run yet.

        Raises
        ------
        RuntimeError
            If the system has no thread left.
        """
        if self._thread is None:
            thread = threading.Thread(target=_carry_out, args=(self._work,), name=self._name, daemon=True)
            thread.start()
            self._thread = thread

    def submit(
        self, fn: Callable[_Parameters, _Result], /, *args: _Parameters.args, **kwargs: _Parameters.kwargs
    ) -> concurrent.futures.Future[_Result]:
        """Hand over a call; it is carried out behind those handed over before. Never waits.

        Raises
        ------
        RuntimeError
            If the thread has yet to be started, and the system has none left.
        """
        self.start()
        future: concurrent.futures.Future[_Result] = concurrent.futures.Future()
        self._work.put((future, lambda: fn(*args, **kwargs)))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the thread behind the work that it has; wait for that, if asked to."""
        if cancel_futures:
            while not self._work.empty():
                if (work := self._work.get()) is not None:
                    work[0].cancel()
        self.end(None if wait else 0.0)

    def end(self, timeout_s: float | None) -> bool:
        """End the thread behind the work that it has; wait for that, for so many s at most. Return whether it ended."""
        thread = self._thread
        if thread is None:
            return True
        self._work.put(_END)
        thread.join(timeout_s)
        return not thread.is_alive()

    def __del__(self) -> None:
        """Let the thread of an executor that nobody has any more end."""
        self._work.put(_END)


def _carry_out(handed_over: "queue.SimpleQueue[_Work | None]") -> None:
    while (work := handed_over.get()) is not _END:
        future, call = work
        if not future.set_running_or_notify_cancel():
            continue
        try:
            result = call()
        except BaseException as error:  # noqa: BLE001 - no memory as well: whoever waits gets it, and the thread goes on
            future.set_exception(error)
        else:
            future.set_result(result)
            del result
        # A thread that waits holds neither the last work nor its error, whose traceback holds much more.
        del work, future, call
