"""The thread that is there before it is needed."""

import asyncio
import gc
import threading
from typing import TYPE_CHECKING

import pytest

from twostage_servo.worker_thread import WorkerThread

if TYPE_CHECKING:
    from concurrent.futures import Future


def no_thread_left(*_: object) -> None:
    raise RuntimeError("can't start new thread")


def test_what_is_handed_over_is_carried_out_in_one_thread_and_in_order() -> None:
    worker = WorkerThread("worker")
    seen: list[tuple[int, threading.Thread]] = []

    def work(number: int) -> None:
        seen.append((number, threading.current_thread()))

    futures = [worker.submit(work, number) for number in range(100)]
    for future in futures:
        future.result(60)
    assert [number for number, _ in seen] == list(range(100))
    (thread,) = {thread for _, thread in seen}
    assert thread.name == "worker"
    assert thread.daemon
    assert worker.end(60)


def test_once_started_it_needs_no_other_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    worker = WorkerThread("worker")
    worker.start()
    monkeypatch.setattr(threading.Thread, "start", no_thread_left)
    worker.start()
    for _ in range(10):  # more work than there are threads
        assert worker.submit(divmod, 7, 2).result(60) == (3, 1)


def test_one_that_cannot_be_started_says_so_and_can_be_started_later(monkeypatch: pytest.MonkeyPatch) -> None:
    worker = WorkerThread("worker")
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", no_thread_left)
        with pytest.raises(RuntimeError, match="can't start new thread"):
            worker.submit(divmod, 7, 2)
    assert worker.submit(divmod, 7, 2).result(60) == (3, 1)


def test_no_error_ends_the_thread() -> None:
    worker = WorkerThread("worker")

    def fail(error: BaseException) -> None:
        raise error

    for error in (MemoryError(), SystemExit(3), KeyboardInterrupt()):
        assert worker.submit(fail, error).exception(60) is error
    assert worker.submit(divmod, 7, 2).result(60) == (3, 1)


def test_the_end_waits_for_the_work_but_for_no_longer_than_it_is_told() -> None:
    worker, hanging, let_go = WorkerThread("worker"), threading.Event(), threading.Event()

    def hang() -> bool:
        hanging.set()
        return let_go.wait(60)

    future: Future[bool] = worker.submit(hang)
    assert hanging.wait(60)
    assert not worker.end(0.0)
    let_go.set()
    assert worker.end(60)
    assert future.result() is True
    assert WorkerThread("never started").end(0.0)


def test_work_that_has_not_begun_can_be_cancelled() -> None:
    worker, let_go = WorkerThread("worker"), threading.Event()
    worker.submit(let_go.wait, 60)
    waiting = worker.submit(divmod, 7, 2)
    behind = worker.submit(divmod, 9, 2)
    assert waiting.cancel()
    worker.shutdown(wait=False, cancel_futures=True)
    let_go.set()
    worker.shutdown()
    assert waiting.cancelled()
    assert behind.cancelled()


def test_the_thread_of_an_executor_that_is_gone_ends() -> None:
    worker = WorkerThread("worker")
    thread = worker.submit(threading.current_thread).result(60)
    del worker
    gc.collect()
    thread.join(60)
    assert not thread.is_alive()


def test_a_loop_takes_it_for_an_executor() -> None:
    async def main() -> tuple[int, int]:
        return await asyncio.get_running_loop().run_in_executor(WorkerThread("worker"), divmod, 7, 2)

    assert asyncio.run(main()) == (3, 1)
