"""How long a `stop` takes, from the connection made for it to its answer, whatever others do meanwhile."""

import argparse
import contextlib
import json
import random
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from tools.bench import client_load, stop_load
from tools.bench.children import ChildError, child, first_line, json_of, module
from tools.bench.load import hogs
from tools.bench.machine import Machine
from tools.bench.plan import Plan
from tools.bench.summary import summarise
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.client.blocking import connect
from twostage_servo.client.errors import ServoError, Unreachable

CONTENDERS: Final = ("none", *client_load.KINDS, *stop_load.KINDS, "hogs", "eight_axes", "everything")
"""What runs beside the one who stops; ``everything`` is all of :mod:`tools.bench.stop_load`, the hogs and 8 axes."""
_SETTLING_S: Final = 1.0
_LONGEST_PAUSE_S: Final = 0.02
_LONGEST_ANSWER_S: Final = 5.0
_LONGEST_STOP_S: Final = 10.0


def measure(
    machine: Machine, of_many: Machine, plan: Plan, note: Callable[[str], None], *, tick_ms: float = 10.0
) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Return what a stop takes in µs beside each kind of load, and why some have none.

    Each figure has how many were ``lost``: not answered within 5 s, or without a connection; and how many had to be
    asked for again by the client, since their connection ended, which is in the time that they took.

    Parameters
    ----------
    machine, of_many
        With one axis, and with eight.
    plan
        How many stops.
    note
        Told of the progress.
    tick_ms
        The service's tick.
    """
    figures: dict[str, dict[str, Any]] = {}
    missing: dict[str, str] = {}
    for name in CONTENDERS:
        note(f"{name}, {tick_ms:g} ms")
        where = of_many if name in {"eight_axes", "everything"} else machine
        try:
            with where.service(f"service.tick_ms={tick_ms:g}") as service:
                where.send_afar(service)
                with _load(name, where):
                    time.sleep(_SETTLING_S)
                    command = module("stop_latency", "--socket", where.control_socket, "--count", plan.stops)
                    told = json_of(command, plan.stops * _LONGEST_STOP_S, min(1, where.priority))
        except ChildError as error:
            missing[name] = str(error)
            continue
        if told["us"]:
            figures[name] = {**summarise(told["us"]), "lost": told["lost"], "repeated": told["repeated"]}
        else:
            missing[name] = f"all {told['lost']} were lost"
    return figures, missing


@contextlib.contextmanager
def _load(name: str, machine: Machine) -> Iterator[None]:
    kinds = [*stop_load.KINDS] if name == "everything" else [name]
    with ExitStack() as stack:
        if name in {"hogs", "everything"}:
            stack.enter_context(hogs())
        for kind in kinds:
            if kind in stop_load.KINDS or kind in client_load.KINDS:
                source = "stop_load" if kind in stop_load.KINDS else "client_load"
                command = module(source, kind, "--socket", machine.control_socket)
                first_line(stack.enter_context(child(command)))
        yield


def ask(path: Path, count: int) -> dict[str, Any]:
    """Stop so many times, each time over a connection of its own; return what each took in µs.

    Also how many were lost, and how often the client had to ask again.

    Python is warm by then, and a refusal (of an axis that is at rest, or tripped) is an answer as well.
    """
    taken_us, lost, repeated = [], 0, 0
    for number in range(count + 1):
        time.sleep(random.uniform(0.0, _LONGEST_PAUSE_S))  # noqa: S311 - so that the ticks do not beat with it
        begun_s = time.monotonic()
        try:
            client = connect(path, timeout_s=_LONGEST_ANSWER_S)
        except ServoError as error:
            print(f"lost: {error}", file=sys.stderr)
            lost += 1
            continue
        try:
            client.stop(wait=False)
        except ServoError as error:
            if isinstance(error, Unreachable) or error.code == RefusalCode.TOO_MANY_CLIENTS:
                print(f"lost: {error}", file=sys.stderr)
                lost += 1
                continue
        finally:
            ended_s = time.monotonic()
            repeated += client.reconnected
            client.close()
        if number:
            taken_us.append(round(1e6 * (ended_s - begun_s), 1))
    return {"us": taken_us, "lost": lost, "repeated": repeated}


def main() -> None:
    """Print what each of so many stops took, as JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--socket", type=Path, required=True)
    parser.add_argument("--count", type=int, required=True)
    options = parser.parse_args()
    json.dump(ask(options.socket, options.count), sys.stdout)


if __name__ == "__main__":
    main()
