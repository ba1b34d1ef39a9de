"""Runs a whole campaign on the processor's cores, cell by cell."""

import concurrent.futures
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from twostage_servo.config.machine import load_machine
from twostage_servo.faults.campaign import Campaign
from twostage_servo.faults.cell import Cell, NotApplicable
from twostage_servo.faults.configuration import ConfigurationFaults
from twostage_servo.faults.phase import Phase
from twostage_servo.faults.table import PROCESS_FAULTS, TABLE
from twostage_servo.service.log import open_log
from twostage_servo.worker_process import InterruptibleProcesses

CONFIGURATION_FAULTS = (47, 48)

Report = Callable[[Cell, int, int], None]
"""Told each cell, how many are done, and how many there are."""

Wanted = Callable[[str, str, str], bool]
"""Whether the cell of an axis, a fault's name and a phase is wanted."""

_campaigns: dict[str, Campaign] = {}


@dataclass(frozen=True, slots=True)
class Result:
    """What a campaign came to.

    Attributes
    ----------
    cells
        One for each fault in each phase in which there can be one, on each axis.
    not_applicable
        Those that there cannot be, with the reason.
    units
        The axes' units, by name.
    """

    cells: list[Cell]
    not_applicable: list[NotApplicable]
    units: dict[str, str]


def run_campaign(
    path: Path | None,
    overrides: Sequence[str],
    seed: int,
    *,
    faults: Sequence[int] = (),
    phases: Sequence[Phase] = tuple(Phase),
    processes: bool = True,
    wanted: Wanted = lambda *_: True,
    report: Report = lambda *_: None,
) -> Result:
    """Run every fault that is asked for, in every phase in which it can happen, on every axis.

    Parameters
    ----------
    path, overrides
        The configuration, as for :func:`twostage_servo.config.machine.load_machine`.
    seed
        Of everything that is random.
    faults
        Numbers; all if empty.
    phases
        Phases.
    processes
        Whether to run those faults as well that need real processes.
    wanted
        Which of the cells to run: a share of them.
    report
        Told of each cell.

    Raises
    ------
    ConfigError
        If the configuration cannot be used.
    """
    machine = load_machine(path, overrides)
    names = [loaded.config.axis.name for loaded in machine.axes]
    campaigns = [Campaign(machine, seed, name) for name in names]
    asked = [fault for fault in TABLE if not faults or fault.number in faults]
    # By axis and phase, so that a process runs the move without a fault once and keeps it.
    tasks = sorted(
        (
            (campaign.axis, TABLE.index(fault), phase)
            for campaign in campaigns
            for fault, phase in campaign.cells(asked, phases)
            if wanted(campaign.axis, fault.name, phase.value)
        ),
        key=lambda task: (names.index(task[0]), tuple(Phase).index(task[2])),
    )
    missing = [one for campaign in campaigns for one in campaign.not_applicable(asked, phases)]
    hosted: list[tuple[int, Phase]] = []
    others: list[Cell] = []
    if machine.is_one_axis:
        whole = machine.axes[0].config.axis.name
        hosted = (
            [task for task in _hosted(faults, phases) if wanted(whole, str(task[0]), task[1].value)]
            if processes
            else []
        )
        if Phase.IDLE in phases and (not faults or set(faults) & set(CONFIGURATION_FAULTS)):
            others = [
                cell
                for cell in ConfigurationFaults(path, overrides).cells()
                if (not faults or cell.fault in faults) and wanted(whole, cell.name, cell.phase)
            ]
            missing += [
                one
                for one in ConfigurationFaults(path, overrides).not_applicable()
                if not faults or one.fault in faults
            ]
    else:
        missing += list(_of_one_axis(faults, phases))
    total = len(tasks) + len(hosted) + len(others)
    cells: list[Cell] = []

    def add(cell: Cell) -> None:
        cells.append(cell)
        report(cell, len(cells), total)

    for cell in others:
        add(cell)
    if tasks:
        for cell in _run_simulated(tasks, path, overrides, seed):
            add(cell)
    for cell in _run_hosted(hosted, path, overrides, seed):
        add(cell)
    units = {loaded.config.axis.name: loaded.config.axis.unit for loaded in machine.axes}
    return Result(sorted(cells, key=_order(names)), missing, units)


def _order(axes: Sequence[str]) -> Callable[[Cell], tuple[int, ...]]:
    phases = [phase.value for phase in Phase]
    faults = [fault.name for fault in TABLE]

    def order(cell: Cell) -> tuple[int, ...]:
        return (
            axes.index(cell.axis) if cell.axis in axes else 0,
            cell.fault,
            faults.index(cell.name) if cell.name in faults else 0,
            phases.index(cell.phase),
        )

    return order


def _of_one_axis(faults: Sequence[int], phases: Sequence[Phase]) -> Iterator[NotApplicable]:
    """Yield what is not run on a machine, since it does not depend on how many axes there are."""
    reason = "runs only on a single axis: use `faults --config` with one of the machine's files"
    for number in (*PROCESS_FAULTS, *CONFIGURATION_FAULTS):
        if (not faults or number in faults) and Phase.IDLE in phases:
            yield NotApplicable(number, "", Phase.IDLE.value, reason)


def _run_simulated(
    tasks: Sequence[tuple[str, int, Phase]], path: Path | None, overrides: Sequence[str], seed: int
) -> Iterator[Cell]:
    """Run cells on the processor's cores, each core with the moves without a fault that it needs."""
    workers = max(1, min(os.cpu_count() or 1, len(tasks)))
    with InterruptibleProcesses(workers, _begin, (path, tuple(overrides), seed)) as pool:
        for done in concurrent.futures.as_completed([pool.submit(_run, *task) for task in tasks]):
            yield done.result()


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

    given_up = threading.Event()
    with concurrent.futures.ThreadPoolExecutor(2 * (os.cpu_count() or 1)) as pool:
        futures = [pool.submit(run_hosted, fault, phase, path, overrides, seed, given_up) for fault, phase in tasks]
        try:
            for done in concurrent.futures.as_completed(futures):
                yield done.result()
        except BaseException:  # an error, or Ctrl-C: what has begun ends, and what has not shall not begin
            given_up.set()
            pool.shutdown(cancel_futures=True)
            raise


def _begin(path: Path | None, overrides: Sequence[str], seed: int) -> None:
    """Prepare a worker: its axes are designed once, and its service's log goes nowhere."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    machine = load_machine(path, overrides)
    for loaded in machine.axes:
        _campaigns[loaded.config.axis.name] = Campaign(machine, seed, loaded.config.axis.name)


def _run(axis: str, index: int, phase: Phase) -> Cell:
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        writer = open_log("critical", nowhere)
        try:
            return _campaigns[axis].run(TABLE[index], phase)
        finally:
            writer.close()
