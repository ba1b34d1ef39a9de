"""By how much the interval of the command frames differs from the period, as another process on the bus sees it."""

import contextlib
import json
from collections.abc import Callable, Iterator
from typing import Final

from bench.bus_side import PRIORITY
from bench.children import ChildError, child, first_line, module
from bench.machine import Machine, Service
from bench.packages import what_is_missing
from bench.plan import Plan
from bench.senders import COMMAND, FLOOR, SENDERS, SYNC
from bench.summary import Figures, summarise

__all__ = ["CONTENDERS", "FLOOR", "measure"]

CONTENDERS: Final = ("ours", *SENDERS)


def measure(
    machine: Machine, service: Service | None, plan: Plan, note: Callable[[str], None]
) -> tuple[dict[str, Figures], dict[str, str]]:
    """Return the figures of one sender after another in µs, and why others have none.

    Parameters
    ----------
    machine
        The bus, and the drive that answers on it.
    service
        The service that is listened to; None to listen to the other senders, so that only one sends at a time.
    plan
        How long each one is listened to.
    note
        Told what is going on.

    Beside the contenders there is ``floor``: what the bus and the listener add to each of them.
    """
    figures: dict[str, Figures] = {}
    not_measured: dict[str, str] = {}
    for name in CONTENDERS:
        if (name == "ours") != (service is not None):
            continue
        if reason := what_is_missing(name):
            not_measured[name] = reason
            continue
        note(name)
        try:
            with _listening(machine, SYNC if name == "canopen_sync" else COMMAND, plan.frames_s) as intervals:
                if service is not None:
                    machine.send_afar(service)
                    figures[name] = summarise(intervals())
                else:
                    command = module("senders", name, "--port", machine.port, "--seconds", plan.frames_s + 2.0)
                    apparatus = name == FLOOR and machine.apparatus_is_real_time
                    with child(command, priority=PRIORITY if apparatus else machine.priority):
                        figures[name] = summarise(intervals())
        except ChildError as error:
            not_measured[name] = str(error)
    return figures, not_measured


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
