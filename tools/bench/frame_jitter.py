"""By how much the interval of the command frames differs from the period, as another process on the bus sees it."""

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from typing import Final

from tools.bench.bus_side import PRIORITY
from tools.bench.children import ChildError, child, first_line, module
from tools.bench.machine import Machine
from tools.bench.packages import what_is_missing
from tools.bench.plan import Plan
from tools.bench.senders import COMMAND, FLOOR, SENDERS, SYNC
from tools.bench.summary import Figures, summarise

__all__ = ["CONTENDERS", "FLOOR", "measure"]

CONTENDERS: Final = ("ours", *SENDERS)
Load = Callable[[], contextlib.AbstractContextManager[None]]


def measure(
    machine: Machine, load: Load, plan: Plan, note: Callable[[str], None], *, backwards: bool = False
) -> tuple[dict[str, Figures], dict[str, str]]:
    """Return the figures of one sender after another in µs, and why others have none.

    Parameters
    ----------
    machine
        The bus, and the drive that answers on it.
    load
        What else runs meanwhile.
    plan
        How many rounds, every other one in the opposite order, and how long each sender is listened to.
    note
        Told what is going on.
    backwards
        Whether the last sender comes first.

    Beside the contenders there is ``floor``: what the bus and the listener add to each of them.
    """
    not_measured = {name: reason for name in CONTENDERS if (reason := what_is_missing(name))}
    intervals: dict[str, list[float]] = {}
    for round_number in range(plan.frame_rounds):
        for name in CONTENDERS[:: -1 if (round_number % 2 == 1) != backwards else 1]:
            if name in not_measured:
                continue
            note(f"{name}, round {round_number + 1} of {plan.frame_rounds}")
            try:
                heard = (_ours if name == "ours" else _other)(name, machine, load, plan)
            except ChildError as error:
                not_measured[name] = str(error)
            else:
                intervals.setdefault(name, []).extend(heard)
    return {name: summarise(intervals[name]) for name in CONTENDERS if name in intervals}, not_measured


def _ours(_: str, machine: Machine, load: Load, plan: Plan) -> list[float]:
    """Listen to a service, alone on the bus with its drive; it has had time to learn how punctual the host is."""
    with machine.service() as service, load():
        machine.send_afar(service)
        time.sleep(plan.frame_settling_s)
        with _listening(machine, COMMAND, plan.frames_s) as intervals:
            return intervals()


def _other(name: str, machine: Machine, load: Load, plan: Plan) -> list[float]:
    with load(), _listening(machine, SYNC if name == "canopen_sync" else COMMAND, plan.frames_s) as intervals:
        command = module("senders", name, "--port", machine.port, "--seconds", plan.frames_s + 2.0)
        apparatus = name == FLOOR and machine.apparatus_is_real_time
        with child(command, priority=PRIORITY if apparatus else machine.priority):
            return intervals()


@contextlib.contextmanager
def _listening(machine: Machine, identifier: int, seconds: float) -> Iterator[Callable[[], list[float]]]:
    """Run a listener; what the block gets waits for what it has heard."""
    command = module("bus_side", "listen", "--port", machine.port, "--identifier", identifier, "--seconds", seconds)
    with child(command, priority=PRIORITY if machine.apparatus_is_real_time else 0) as listener:
        first_line(listener)

        def intervals() -> list[float]:
            output, _ = listener.communicate()
            if listener.returncode != 0:
                raise ChildError("it was not heard on the bus for long enough")
            values: list[float] = json.loads(output)
            return values

        yield intervals
