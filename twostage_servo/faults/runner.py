"""Runs a whole campaign on the processor's cores, cell by cell."""

import concurrent.futures
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from twostage_servo.config import load
from twostage_servo.faults.campaign import Campaign, Cell
from twostage_servo.faults.configuration import ConfigurationFaults
from twostage_servo.faults.table import TABLE, Phase
from twostage_servo.service.log import open_log

CONFIGURATION_FAULTS = (47, 48)

Report = Callable[[Cell, int, int], None]
"""Told each cell, how many are done, and how many there are."""

_campaign: Campaign | None = None


def run_campaign(
    path: Path | None,
    overrides: Sequence[str],
    seed: int,
    *,
    faults: Sequence[int] = (),
    phases: Sequence[Phase] = tuple(Phase),
    processes: bool = True,
    report: Report = lambda *_: None,
) -> list[Cell]:
    """Run every fault that is asked for, in every phase in which it can happen.

    Parameters
    ----------
    path, overrides
        The configuration, as for :func:`twostage_servo.config.load`.
    seed
        Of everything that is random.
    faults
        Numbers; all if empty.
    phases
        Phases.
    processes
        Whether to run those faults as well that need real processes.
    report
        Told of each cell.

    Raises
    ------
    ConfigError
        If the configuration cannot be used.
    """
    campaign = Campaign(load(path, overrides), seed)
    wanted = [fault for fault in TABLE if not faults or fault.number in faults]
    # By phase, so that a process runs the move without a fault once and keeps it.
    tasks = sorted(
        ((TABLE.index(fault), phase) for fault, phase in campaign.cells(wanted, phases)),
        key=lambda task: tuple(Phase).index(task[1]),
    )
    hosted = list(_hosted(faults, phases)) if processes else []
    others: list[Cell] = []
    if Phase.IDLE in phases and (not faults or set(faults) & set(CONFIGURATION_FAULTS)):
        others = [c for c in ConfigurationFaults(path, overrides).cells() if not faults or c.fault in faults]
    total = len(tasks) + len(hosted) + len(others)
    cells: list[Cell] = []

    def add(cell: Cell) -> None:
        cells.append(cell)
        report(cell, len(cells), total)

    for cell in others:
        add(cell)
    workers = max(1, min(os.cpu_count() or 1, len(tasks)))
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, context, _begin, (path, tuple(overrides), seed)) as pool:
        for done in concurrent.futures.as_completed([pool.submit(_run, *task) for task in tasks]):
            add(done.result())
    for cell in _run_hosted(hosted, path, overrides, seed):
        add(cell)
    order = [phase.value for phase in Phase]
    names = [fault.name for fault in TABLE]
    return sorted(
        cells,
        key=lambda cell: (cell.fault, names.index(cell.name) if cell.name in names else 0, order.index(cell.phase)),
    )


def _hosted(faults: Sequence[int], phases: Sequence[Phase]) -> Iterator[tuple[int, Phase]]:
    from twostage_servo.faults.processes import hosted_cells  # noqa: PLC0415 - only where they run

    for fault, phase in hosted_cells(phases):
        if not faults or fault in faults:
            yield fault, phase


def _run_hosted(
    tasks: Sequence[tuple[int, Phase]], path: Path | None, overrides: Sequence[str], seed: int
) -> Iterator[Cell]:
    """Run the faults with real processes, some at a time: each waits for its own clock most of the time."""
    if not tasks:
        return
    from twostage_servo.faults.processes import run_hosted  # noqa: PLC0415

    with concurrent.futures.ThreadPoolExecutor(2 * (os.cpu_count() or 1)) as pool:
        futures = [pool.submit(run_hosted, fault, phase, path, overrides, seed) for fault, phase in tasks]
        try:
            for done in concurrent.futures.as_completed(futures):
                yield done.result()
        except BaseException:  # an error, or Ctrl-C: what has not begun shall not begin
            pool.shutdown(cancel_futures=True)
            raise


def _begin(path: Path | None, overrides: Sequence[str], seed: int) -> None:
    """Prepare a worker: its axis is designed once, and its service's log goes nowhere."""
    global _campaign  # noqa: PLW0603 - a process of the pool has no other place for what all its tasks share
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _campaign = Campaign(load(path, overrides), seed)


def _run(index: int, phase: Phase) -> Cell:
    assert _campaign is not None  # noqa: S101 - the pool has begun
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        writer = open_log("critical", nowhere)
        try:
            return _campaign.run(TABLE[index], phase)
        finally:
            writer.close()
