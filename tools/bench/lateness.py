"""How late a pass of a loop begins: the service's ticks beside cyclictest and the other loops, in turns."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from tools.bench.children import ChildError, json_of, module, output_of
from tools.bench.loops import LOOPS
from tools.bench.packages import what_is_missing
from tools.bench.plan import PERIOD_S, Plan
from tools.bench.summary import Figures, summarise, summarise_histogram

CONTENDERS: Final = ("ours", "cyclictest", *(name for name in LOOPS if name != "ours"))
_LARGEST_US: Final = 1_000_000
"""Where cyclictest's histogram ends."""


def measure(
    plan: Plan, priority: int, note: Callable[[str], None], *, backwards: bool = False
) -> tuple[dict[str, Figures], dict[str, str]]:
    """Return the figures of each loop in µs, and why others have none; `backwards` takes the last loop first."""
    not_measured = {name: reason for name in CONTENDERS if (reason := what_is_missing(name))}
    samples: dict[str, list[float]] = {}
    histograms: list[dict[str, Any]] = []
    for round_number in range(plan.lateness_rounds):
        for name in CONTENDERS[:: -1 if (round_number % 2 == 1) != backwards else 1]:
            if name in not_measured:
                continue
            note(f"{name}, round {round_number + 1} of {plan.lateness_rounds}")
            try:
                if name == "cyclictest":
                    histograms.append(_cyclictest(plan.lateness_s, priority))
                else:
                    command = module("loops", name, "--seconds", plan.lateness_s)
                    for kind, values in json_of(command, 10.0 * plan.lateness_s + 30.0, priority).items():
                        samples.setdefault(kind, []).extend(values)
            except ChildError as error:
                not_measured[name] = str(error)
    figures = {name: summarise(values) for name, values in samples.items()}
    if histograms:
        figures["cyclictest"] = _merged(histograms)
    return {name: figures[name] for name in CONTENDERS if name in figures}, not_measured


def _cyclictest(seconds: float, priority: int) -> dict[str, Any]:
    """Run cyclictest, one thread with the same period and priority; return its own report of that thread."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        scheduling = ["--policy=fifo", f"--priority={priority}"] if priority else ["--policy=other"]
        output_of(
            [
                "cyclictest", "--quiet", "--threads=1", f"--interval={round(1e6 * PERIOD_S)}",
                f"--loops={round(seconds / PERIOD_S)}", f"--histogram={_LARGEST_US}", f"--json={report}", *scheduling,
            ],
            10.0 * seconds + 30.0,
        )  # fmt: skip
        thread: dict[str, Any] = json.loads(report.read_text(encoding="utf-8"))["thread"]["0"]
    return thread


def _merged(threads: list[dict[str, Any]]) -> Figures:
    counts: dict[int, int] = {}
    for thread in threads:
        for value, count in thread["histogram"].items():
            counts[int(value)] = counts.get(int(value), 0) + count
    cycles = sum(thread["cycles"] for thread in threads)
    average = sum(thread["avg"] * thread["cycles"] for thread in threads) / cycles
    largest = float(max(thread["max"] for thread in threads))
    return summarise_histogram(counts) | {"max": largest, "avg": round(average, 3)}
