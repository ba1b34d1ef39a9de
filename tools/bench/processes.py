"""The service as a process: how soon it is ready, what it takes of a core, and how soon `status` answers."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from tools.bench.children import output_of
from tools.bench.machine import PROGRAM, Machine
from tools.bench.plan import Plan
from tools.bench.summary import summarise

_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")
_LONGEST_STATUS_S: Final = 60.0


def measure(machine: Machine, plan: Plan, note: Callable[[str], None]) -> dict[str, Any]:
    """Return ``startup_s``, ``status_s`` and ``cpu_share``."""
    starts = []
    for number in range(plan.starts):
        note(f"start {number + 1} of {plan.starts}")
        with machine.service() as service:
            starts.append(service.start_s)
            if number < plan.starts - 1:
                continue
            note("status")
            asked = [_ask(machine) for _ in range(plan.asks)]
            machine.send_afar(service)
            note("share of a core")
            share = cpu_share(service.process.pid, plan.cpu_s)
    return {"startup_s": summarise(starts), "status_s": summarise(asked), "cpu_share": round(share, 4)}


def cpu_share(process: int, seconds: float) -> float:
    """Return a process' share of a core over a time, from /proc: its threads, in user and kernel mode."""
    before_s, begun_s = _cpu_s(process), time.monotonic()
    time.sleep(seconds)
    return (_cpu_s(process) - before_s) / (time.monotonic() - begun_s)


def _cpu_s(process: int) -> float:
    text = Path(f"/proc/{process}/stat").read_text(encoding="ascii")
    fields = text.rpartition(")")[2].split()  # from the third one of proc(5) on: a program's name may hold anything
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


def _ask(machine: Machine) -> float:
    begun_s = time.monotonic()
    output_of([*PROGRAM, "status", "--json"], _LONGEST_STATUS_S, machine.environment, machine.priority)
    return time.monotonic() - begun_s
