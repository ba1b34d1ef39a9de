"""A run as a list of independent jobs over all cores, with a bar that shows how far it is."""

import multiprocessing
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Final, TextIO, TypeVar

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")
_WIDTH: Final = 40


def run_jobs(
    work: Callable[[JobT], ResultT], jobs: Sequence[JobT], *, workers: int | None = None, show: bool = True
) -> list[ResultT]:
    """Return the results of all jobs, in their order.

    Parameters
    ----------
    work
        A function of a module: the workers are processes of their own.
    jobs
        What it is called with.
    workers
        How many processes; as many as there are cores if absent. With one, everything happens in this process.
    show
        Whether to show a bar on stderr.
    """
    count = min(workers or os.cpu_count() or 1, len(jobs))
    bar = _Bar(len(jobs), sys.stderr if show else None)
    if count <= 1:
        return [bar.passed(work(job)) for job in jobs]
    results: dict[int, ResultT] = {}
    # Spawned, not forked: numpy's threads do not survive a fork.
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        places = {pool.submit(work, job): place for place, job in enumerate(jobs)}
        for future in as_completed(places):
            results[places[future]] = bar.passed(future.result())
    return [results[place] for place in range(len(jobs))]


class _Bar:
    """How many jobs are done: a line that is written over on a terminal, else one at each tenth."""

    def __init__(self, total: int, stream: TextIO | None) -> None:
        self._total = total
        self._stream = stream
        self._done = 0

    def passed(self, result: ResultT) -> ResultT:
        """Count a job, and return its result."""
        self._done += 1
        stream, total = self._stream, self._total
        if stream is not None:
            filled = _WIDTH * self._done // total
            line = f"[{'#' * filled}{'.' * (_WIDTH - filled)}] {self._done}/{total} jobs"
            if stream.isatty():
                stream.write("\r" + line + ("\n" if self._done == total else ""))
            elif 10 * self._done // total > 10 * (self._done - 1) // total:
                stream.write(line + "\n")
            stream.flush()
        return result
