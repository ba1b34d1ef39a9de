"""How punctual the service's ticks are while its clients ask much of it, and on a tick of a millisecond."""

import contextlib
import time
from collections.abc import Callable
from typing import Any, Final

from tools.bench.children import ChildError, child, first_line, module
from tools.bench.client_load import KINDS
from tools.bench.machine import Machine, Service
from tools.bench.plan import PERIOD_S, Plan
from tools.bench.processes import cpu_share
from tools.bench.summary import Figures, summarise

CONTENDERS: Final = ("none", *KINDS)
_SETTLING_S: Final = 1.0
_RECORDING: Final = "service.recording_s=100"
_SHORT_TICK_S: Final = 1e-3


def measure(
    machine: Machine, plan: Plan, note: Callable[[str], None]
) -> tuple[dict[str, Figures], dict[str, float], dict[str, str]]:
    """Return the lateness of the service's ticks in µs beside each kind of clients, and why some have none.

    Each kind has a service of its own in each round, every other round in the opposite order. Lateness is the tick's
    own, tick by tick, from the service's recording; a skipped deadline counts as one that was met late. Between the two
    stands the share of a core that the service took, the largest of the rounds.
    """
    lateness: dict[str, list[float]] = {}
    shares: dict[str, float] = {}
    not_measured: dict[str, str] = {}
    for round_number in range(plan.client_rounds):
        for name in CONTENDERS[:: -1 if round_number % 2 else 1]:
            note(f"{name}, round {round_number + 1} of {plan.client_rounds}")
            try:
                with machine.service(_RECORDING) as service, contextlib.ExitStack() as stack:
                    machine.send_afar(service)
                    if name != "none":
                        command = module("client_load", name, "--socket", machine.control_socket)
                        first_line(stack.enter_context(child(command)))
                    time.sleep(_SETTLING_S)
                    before = service.ask(op="status")["ticks"]
                    share = cpu_share(service.process.pid, plan.clients_s)
                    values = _lateness_us(service, before, PERIOD_S)  # first: a trip must not leave an empty list
                    lateness.setdefault(name, []).extend(values)
                    shares[name] = round(max(share, shares.get(name, 0.0)), 4)
            except ChildError as error:
                not_measured[name] = str(error)
    return {name: summarise(lateness[name]) for name in CONTENDERS if name in lateness}, shares, not_measured


def measure_short_ticks(machine: Machine, plan: Plan, note: Callable[[str], None]) -> dict[str, Any]:
    """Return how one axis fares on a tick of 1 ms.

    These are ``millisecond_missed_share``, ``millisecond_lateness_us`` and ``millisecond_cpu_share``.
    """
    note(f"a tick of 1 ms for {plan.short_ticks_s:g} s")
    with machine.service(_RECORDING, f"service.tick_ms={1e3 * _SHORT_TICK_S:g}") as service:
        machine.send_afar(service)
        time.sleep(_SETTLING_S)
        before = service.ask(op="status")["ticks"]
        share = cpu_share(service.process.pid, plan.short_ticks_s)
        after = service.ask(op="status")["ticks"]
        lateness_us = _lateness_us(service, before, _SHORT_TICK_S)
    served, missed = (after[key] - before[key] for key in ("count", "missed"))
    return {
        "millisecond_missed_share": round(missed / (served + missed), 6),
        "millisecond_lateness_us": summarise(lateness_us),
        "millisecond_cpu_share": round(share, 4),
    }


def _lateness_us(service: Service, before: dict[str, Any], period_s: float) -> list[float]:
    """Return the lateness of the ticks since a snapshot's, from the recording, in µs."""
    recording = service.ask(op="recording")
    tick, missed, lateness = (recording["fields"].index(name) for name in ("tick", "missed", "lateness_us"))
    since = before["count"] + before["missed"]
    records = [record for record in recording["records"] if record[tick] > since]
    if not records:  # what was recorded before a trip is kept
        trip = service.ask(op="status")["trip"] or {}
        raise ChildError(f"the axis has tripped: {trip.get('code')}, {trip.get('cause')}")
    return [record[lateness] + 1e6 * period_s * record[missed] for record in records]
