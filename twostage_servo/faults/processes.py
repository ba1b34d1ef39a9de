"""The faults that need real processes: a service that is stopped, killed, ended or hangs, and a power cut.

The rest of the campaign is in simulated time; these run on the machine's clock. A machine that is busy holds processes
up, which travels as well. So a cell that is not met while frames came late is run again; the verdict is that of a run
in which they did not.
"""

import subprocess
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from random import Random
from typing import NamedTuple

from twostage_servo.faults.bench import BenchError
from twostage_servo.faults.cell import Cell
from twostage_servo.faults.hosted import HostedRun
from twostage_servo.faults.hosted_verdict import ENDED, HUNG, KILLED, STOPPED
from twostage_servo.faults.launch import LONGEST_S, Child, GivenUpError
from twostage_servo.faults.listening import RefusalError
from twostage_servo.faults.phase import ALL, Phase
from twostage_servo.faults.simulated_approach import NotOperableError
from twostage_servo.faults.table import TOLERATED

POWER_CUT = 54
POWER_CUTS = 20

_POWER_CUT_NAME = "power cut while a trip file is written"

_GLANCE_S = 0.02
_ATTEMPTS = 6
_TROUBLES = 4
"""So many runs in which the fault could not even begin are no accident."""


class HostedFault(NamedTuple):
    """A fault by its number, and the phase in which it begins."""

    fault: int
    phase: Phase


def hosted_cells(phases: Iterable[Phase]) -> list[HostedFault]:
    """Return what there is to run in some phases."""
    wanted = list(phases)
    cells = [HostedFault(fault, phase) for fault in (STOPPED, KILLED, ENDED, HUNG) for phase in ALL if phase in wanted]
    return cells + [HostedFault(POWER_CUT, Phase.IDLE)] * (Phase.IDLE in wanted)


def run_hosted(
    fault: int,
    phase: Phase,
    config: Path | None,
    overrides: Sequence[str],
    seed: int,
    given_up: threading.Event | None = None,
) -> Cell:
    """Run one cell. It takes seconds; several may run at the same time, in threads as in processes.

    Parameters
    ----------
    fault, phase
        One of :func:`hosted_cells`.
    config
        Path of the configuration; None for the embedded one.
    overrides
        ``KEY=VALUE`` arguments that belong to it.
    seed
        Of the length of the move, and of the moment of the fault in it.
    given_up
        Is set where nobody wants the cell any more.

    Raises
    ------
    GivenUpError
        If nobody does.
    ConfigError
        If the configuration cannot be used.
    NotOperableError
        If the axis does not even come so far that the fault could begin.
    """
    given_up = given_up or threading.Event()
    if fault == POWER_CUT:
        return _cut_power(seed, given_up)
    troubles: list[str] = []
    for attempt in range(_ATTEMPTS):
        try:
            run = HostedRun(fault, phase, Random(f"{seed} {phase}"), given_up)  # noqa: S311
            cell, held_up = run.play(config, overrides)
        except (BenchError, RefusalError, OSError) as error:
            troubles.append(str(error))
            if len(troubles) >= _TROUBLES:
                break
            continue
        if cell.met or not held_up or attempt == _ATTEMPTS - 1:
            return cell
    raise NotOperableError(f"fault {fault}, {phase.value}: {troubles[-1]}")


def _cut_power(seed: int, given_up: threading.Event) -> Cell:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="twostage-servo-")))
        trips = folder / "trips"
        child = Child(stack, folder, "power_cut", ["power_cut", str(trips), str(seed), str(POWER_CUTS)])
        end_s = time.monotonic() + POWER_CUTS * LONGEST_S
        while not child.has_ended:
            if given_up.wait(_GLANCE_S):
                raise GivenUpError
            if time.monotonic() > end_s:
                raise subprocess.TimeoutExpired(child.args, POWER_CUTS * LONGEST_S)
        wrong = child.printed().get("damaged", [f"it failed: {child.log()[-1000:]}"])
    return Cell(POWER_CUT, _POWER_CUT_NAME, Phase.IDLE.value, TOLERATED, TOLERATED, "", 0.0, 0.0, "; ".join(wrong))
