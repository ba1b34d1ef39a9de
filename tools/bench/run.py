"""The benchmark: one run measures the service beside other Python loops, senders and filters on the same machine.

``python -m tools.bench.run [--quick] [--json] [--plot FILE.png] [--check]``. Progress goes to stderr, and the result to
stdout: a table, or one JSON object. Each contender has p50, p90, p99 and max. What could not be measured is in
``not_measured`` with the reason and, where a package is missing, the line that installs it. Nothing leaves the machine.
"""

import argparse
import contextlib
import json
import os
import platform
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from tools.bench import (
    budgets,
    clients,
    control_step,
    frame_jitter,
    lateness,
    processes,
    simulated_time,
    stop_latency,
    whole_tick,
)
from tools.bench.children import ChildError
from tools.bench.load import hogs, unloaded
from tools.bench.machine import Machine
from tools.bench.plan import FULL, QUICK, Plan
from tools.bench.scheduling import may_run_at
from twostage_servo import __version__
from twostage_servo.cli.output import CommandError

PARTS: Final = ("lateness", "frames", "step", "tick", "simulation", "processes", "clients", "millisecond", "stop")
_PART_OF: Final = {
    "tick_lateness_us": "lateness",
    "tick_lateness_us_loaded": "lateness",
    "frame_jitter_us": "frames",
    "frame_jitter_us_loaded": "frames",
    "control_step_us": "step",
    "whole_tick_us": "tick",
    "whole_tick_real_time_us": "tick",
    "marginal_cost_growth": "tick",
    "simulated_tick_cpu_us": "simulation",
    "memory_growth_mb": "simulation",
    "cpu_share": "processes",
    "startup_s": "processes",
    "status_s": "processes",
    "clients_lateness_us": "clients",
    "clients_cpu_share": "clients",
    "millisecond_missed_share": "millisecond",
    "stop_us": "stop",
    "stop_millisecond_us": "stop",
}
"""Which part measures a figure that a budget may be about."""

_TABLES_WITH_OTHERS: Final = frozenset(
    {"tick_lateness_us", "tick_lateness_us_loaded", "frame_jitter_us", "frame_jitter_us_loaded", "control_step_us"}
)
"""Those in which others stand as well, who may be missing."""

_ATTEMPTS: Final = 3
"""So often a budget has to be broken in a row: something else that ran on the machine just then is no regression."""
_NOT_QUICK: Final = "it takes too long for --quick"
_LOADS: Final = (("", unloaded), ("_loaded", hogs))
"""What runs beside the contenders; with the second one the last of them comes first."""
_Note = Callable[[str], None]


class Run:
    """One run, whose result grows part by part.

    Attributes
    ----------
    result
        Ready for JSON.
    parts
        What has been measured.
    defective
        Those of them that failed for no reason that was foreseen.
    """

    def __init__(self, plan: Plan, priority: int, note: _Note) -> None:
        self.result: dict[str, Any] = {"machine": _machine(plan, priority), "not_measured": {}}
        self.parts: set[str] = set()
        self.defective: set[str] = set()
        self._plan = plan
        self._priority = priority
        self._note = note

    def do(self, part: str) -> None:
        """Measure one part, or measure it anew; what fails is noted as not measured."""
        self.parts.add(part)
        self.defective.discard(part)
        self.result["not_measured"] = {
            key: reason for key, reason in self.result["not_measured"].items() if part not in {key, _part_of(key)}
        }
        measure: Callable[[], None] = getattr(self, f"_{part}")
        try:
            measure()
        except (ChildError, CommandError, OSError, subprocess.SubprocessError) as error:
            self.result["not_measured"][part] = str(error)
        except Exception as error:  # noqa: BLE001 - the other parts have taken a quarter of an hour
            traceback.print_exc()
            self.defective.add(part)
            self.result["not_measured"][part] = f"a defect of the benchmark: {type(error).__name__}: {error}"

    def finish(self) -> None:
        """Add what the goals come to."""
        self.result["machine"]["load_average_after"] = _load_average()
        self.result["goals"] = [
            budgets.judge(goal, self.result).as_json() for goal in budgets.read("goal", self.result)
        ]

    def _lateness(self) -> None:
        for suffix, load in _LOADS:
            with load():
                figures, missing = lateness.measure(
                    self._plan, self._priority, self._named(f"lateness{suffix}"), backwards=bool(suffix)
                )
            self._take(f"tick_lateness_us{suffix}", figures, missing)

    def _frames(self) -> None:
        floors = {}
        with Machine.running(self._priority) as machine:
            self.result["machine"]["bus_at_real_time_priority"] = machine.apparatus_is_real_time
            for suffix, load in _LOADS:
                figures, missing = frame_jitter.measure(
                    machine, load, self._plan, self._named(f"frames{suffix}"), backwards=bool(suffix)
                )
                if floor := figures.pop(frame_jitter.FLOOR, None):
                    floors[suffix.removeprefix("_") or "unloaded"] = floor
                self._take(f"frame_jitter_us{suffix}", figures, missing)
        self.result["frame_jitter_floor_us"] = floors

    def _step(self) -> None:
        self._take("control_step_us", *control_step.measure(self._plan, self._priority, self._named("control step")))

    def _tick(self) -> None:
        result, not_measured = whole_tick.measure(self._plan, self._priority, self._named("whole tick"))
        self.result |= result
        self.result["not_measured"] |= not_measured

    def _simulation(self) -> None:
        self.result |= simulated_time.measure(self._plan, self._priority, self._named("simulated time"))

    def _processes(self) -> None:
        with Machine.running(self._priority) as machine:
            self.result |= processes.measure(machine, self._plan, self._named("processes"))

    def _clients(self) -> None:
        if not self._plan.client_rounds:
            self.result["not_measured"]["clients_lateness_us"] = _NOT_QUICK
            return
        with Machine.running(self._priority) as machine:
            figures, shares, missing = clients.measure(machine, self._plan, self._named("clients"))
        self._take("clients_lateness_us", figures, missing)
        self.result["clients_cpu_share"] = shares

    def _millisecond(self) -> None:
        if not self._plan.short_ticks_s:
            self.result["not_measured"]["millisecond_missed_share"] = _NOT_QUICK
            return
        with Machine.running(self._priority) as machine:
            self.result |= clients.measure_short_ticks(machine, self._plan, self._named("millisecond"))

    def _stop(self) -> None:
        if not self._plan.stops:
            self.result["not_measured"]["stop_us"] = _NOT_QUICK
            return
        with Machine.running(self._priority) as machine, Machine.running(self._priority, 8) as of_many:
            for key, tick_ms in (("stop_us", 10.0), ("stop_millisecond_us", 1.0)):
                figures, missing = stop_latency.measure(
                    machine, of_many, self._plan, self._named("stop"), tick_ms=tick_ms
                )
                self._take(key, figures, missing)

    def _take(self, key: str, figures: Mapping[str, Any], missing: Mapping[str, str]) -> None:
        self.result[key] = dict(figures)
        self.result["not_measured"] |= {f"{key}.{name}": reason for name, reason in missing.items()}

    def _named(self, name: str) -> _Note:
        return lambda text: self._note(f"{name}: {text}")


def _machine(plan: Plan, priority: int) -> dict[str, Any]:
    return {
        "version": __version__,
        "python": platform.python_version(),
        "kernel": platform.release(),
        "cpus": os.cpu_count(),
        "load_average_before": _load_average(),
        "priority": priority,
        "quick": plan is QUICK,
    }


def _load_average() -> float:
    return round(os.getloadavg()[0], 2)


def as_text(result: Mapping[str, Any]) -> str:
    """Return the figures as a table."""
    lines = []
    for key, value in result.items():
        if key in {"machine", "not_measured", "goals", "phase_share", "budgets"}:
            continue
        if not isinstance(value, Mapping):
            lines.append(f"{key:32} {value}")
            continue
        for name, row in value.items() if "p50" not in value else [("", value)]:
            if not isinstance(row, Mapping):
                lines.append(f"{key:26} {name:22} {row}")
                continue
            figures = "  ".join(f"{column} {row[column]:>11}" for column in ("p50", "p90", "p99", "max"))
            lines.append(f"{key:26} {name:22} {figures}" + (f"  avg {row['avg']}" if "avg" in row else ""))
    lines += [f"phases with {axes} axes: {shares}" for axes, shares in result.get("phase_share", {}).items()]
    lines += [f"not measured: {name}: {reason}" for name, reason in result["not_measured"].items()]
    words = {"kept": "met", "broken": "MISSED"}
    lines += [
        f"goal {words.get(goal['state'], goal['state'])}: {goal['name']}: {goal['text']}" for goal in result["goals"]
    ]
    return "\n".join(lines)


def check(run: Run) -> bool:
    """Hold a run against the budgets, and return whether all were kept; the broken ones are named on stderr.

    What a broken one concerns is measured anew, all of its contenders in turns as before. One whose figure should have
    been measured, and was not, counts as broken.
    """
    for attempt in range(1, _ATTEMPTS + 1):
        verdicts = [budgets.judge(budget, run.result) for budget in budgets.read("budget", run.result)]
        broken = [one for one in verdicts if one.state == "broken" or any(_failed(run, path) for path in _paths(one))]
        for verdict in verdicts:
            if verdict.state != "kept":
                print(f"budget {verdict.state}: {verdict.budget.name}: {verdict.text}", file=sys.stderr)
        if not broken or attempt == _ATTEMPTS:
            break
        parts = {_part_of(path) for verdict in broken for path in _paths(verdict)}
        for part in PARTS:
            if part in parts:
                run.do(part)
    run.result["budgets"] = [verdict.as_json() for verdict in verdicts]
    return not broken


def _paths(verdict: budgets.Verdict) -> list[str]:
    return [path for path in (verdict.budget.figure, verdict.budget.of) if path]


def _failed(run: Run, path: str) -> bool:
    """Return whether a figure of ours is missing without being left out, for --quick or by --only."""
    if budgets.look_up(run.result, path) is not None or _part_of(path) not in run.parts:
        return False
    table, contender, *_ = *path.split("."), ""
    if table in _TABLES_WITH_OTHERS and contender != "ours":
        return False
    return bool(run.result["not_measured"].get(table) != _NOT_QUICK)


def _part_of(path: str) -> str | None:
    return _PART_OF.get(path.split(".", maxsplit=1)[0])


def main() -> int:
    """Measure what the arguments say; return 1 if a budget is broken, or the benchmark is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="under 50 s, for a first look and for --check")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the figures")
    parser.add_argument("--check", action="store_true", help="hold the figures against budgets.toml")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="measure these parts alone")
    parser.add_argument(
        "--priority", type=int, default=0, metavar="N", help="SCHED_FIFO priority of all that is measured"
    )
    options = parser.parse_args()
    if not may_run_at(options.priority):
        parser.error(f"SCHED_FIFO priority {options.priority} is not permitted here: leave it out, or run as root")
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also where a shell has it ignored, as in the background
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the children are ended on this way out, too
    begun_s = time.monotonic()

    def note(text: str) -> None:
        print(f"{time.monotonic() - begun_s:6.1f} s  {text}", file=sys.stderr)

    run = Run(QUICK if options.quick else FULL, options.priority, note)
    with contextlib.suppress(KeyboardInterrupt):
        for part in options.only:
            run.do(part)
        kept = check(run) if options.check else True
        run.finish()
        print(json.dumps(run.result) if options.json else as_text(run.result))
        if options.plot is not None:
            from tools.bench import plot  # noqa: PLC0415 - matplotlib takes a second

            plot.draw(run.result, options.plot)
        note("done")
        return 0 if kept and not run.defective else 1
    return 130


if __name__ == "__main__":
    sys.exit(main())
