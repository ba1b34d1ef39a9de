"""Soak: months of operation in simulated time, on all cores, with random configurations, requests and faults by seed.

``python -m tools.soak.run axis --hours 1000`` runs axes with their drives, without a bus; ``service --hours 50`` runs
whole services over CAN frames, with clients at their socket. Each episode has a seed of its own, which decides on its
configuration as well, and can be run again alone: ``--first-seed N --episodes 1``. Progress goes to stderr; Ctrl-C ends
the run with what has been done so far. With ``--results FILE`` each episode is kept in that file, and those that it
has already are not run again: so a long run can be made in parts.
"""

import argparse
import concurrent.futures
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tools.soak.axis_soak import AxisSoak
from tools.soak.configurations import drawn_by
from tools.soak.invariants import BrokenInvariantError, resident_mb
from tools.soak.service_soak import ServiceSoak
from twostage_servo.service.log import open_log
from twostage_servo.worker_process import end_with_parent

EPISODE_TICKS = {"axis": 360_000, "service": 45_000}
"""Length of an episode: an hour, and seven and a half minutes, on a tick of 10 ms."""
MOST_GROWTH_MB = 8.0
"""Growth of a worker's memory after its first episode: its allocator's own, not a leak that grows with the episodes."""
FAULTS = {
    "axis": ("drive", "encoder"),
    "service": ("backlog", "clients", "descriptors", "drive", "encoder", "signals", "socket"),
}
"""Kinds of faults that can be left out."""

Result = dict[str, Any]


def episode(kind: str, seed: int, ticks: int, without: frozenset[str]) -> Result:
    """Run one episode; return what it came to."""
    started = time.perf_counter()
    result: Result = {"seed": seed, "broken": None}
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        writer = open_log("critical", nowhere)
        soak = AxisSoak(seed, without) if kind == "axis" else ServiceSoak(seed, without)
        try:
            soak.run(ticks)
        except BrokenInvariantError as broken:
            result["broken"] = str(broken)
        finally:
            writer.close()
    return result | {
        "configuration": soak.configuration.name,
        "process": os.getpid(),
        "simulated_s": soak.ticks * soak.configuration.tick_s,
        "seconds": time.perf_counter() - started,
        "requests": soak.requests,
        "refusals": soak.refusals,
        "trips": soak.trips,
        "moves_reached": soak.moves_reached,
        "encoder_faults": soak.encoder_faults,
        "travel_over_bound": soak.closest,
        "overrun_over_bound": soak.farthest,
        "resident_mb": resident_mb(),
    }


def main() -> int:
    """Run the soak that the arguments describe; return 0 if nothing broke."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=sorted(EPISODE_TICKS))
    parser.add_argument("--hours", type=float, default=1.0, help="simulated hours in all (default 1)")
    parser.add_argument("--episodes", type=int, help="number of episodes, in place of --hours")
    parser.add_argument("--first-seed", type=int, default=1, metavar="N")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--results", type=Path, metavar="FILE", help="keep the episodes here, and go on from there")
    parser.add_argument(
        "--without",
        nargs="+",
        default=[],
        metavar="FAULT",
        choices=sorted({fault for faults in FAULTS.values() for fault in faults}),
        help="kinds of faults to leave out: %(choices)s",
    )
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    started = time.perf_counter()
    before = kept_results(options.results)
    results = list(before)
    if options.episodes is not None:
        seeds = range(options.first_seed, options.first_seed + options.episodes)
    else:
        seeds = seeds_for(options.kind, 3600.0 * options.hours, options.first_seed)
    left = sorted(set(seeds) - {result["seed"] for result in results})
    try:
        for result in episodes(options.kind, left, options.jobs, frozenset(options.without)):
            results.append(result)
            keep(options.results, result)
            show_progress(results, len(left) + len(before))
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
    if not results:
        return 130
    summary = summarise(results, time.perf_counter() - started, options.kind, len(before))
    print(json.dumps(summary) if options.json else as_text(summary))
    return 1 if summary["broken"] or summary["memory_growth_mb"] > MOST_GROWTH_MB else 0


def seeds_for(kind: str, simulated_s: float, first: int) -> range:
    """Return the seeds whose episodes come to so much simulated time, each being as many ticks long."""
    last = first
    while simulated_s > 0.0:
        simulated_s -= EPISODE_TICKS[kind] * drawn_by(last)[0].tick_s
        last += 1
    return range(first, last)


def kept_results(path: Path | None) -> list[Result]:
    """Return the episodes that a file has."""
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def keep(path: Path | None, result: Result) -> None:
    """Add an episode to a file."""
    if path is not None:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(result) + "\n")


def episodes(kind: str, seeds: Iterable[int], jobs: int, without: frozenset[str]) -> Iterator[Result]:
    """Run episodes on some cores and give what each came to as it ends; on the way out, give up those not yet begun."""
    context = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(jobs, context, initializer=end_with_parent)
    try:
        futures = [pool.submit(episode, kind, seed, EPISODE_TICKS[kind], without) for seed in seeds]
        for future in concurrent.futures.as_completed(futures):
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def show_progress(results: list[Result], count: int) -> None:
    """Tell how far it is: on one line of a terminal, and ten times in all elsewhere."""
    done, terminal = len(results), sys.stderr.isatty()
    if not terminal and (10 * done) // count == (10 * (done - 1)) // count:
        return
    done_h = sum(r["simulated_s"] for r in results) / 3600.0
    broken = sum(r["broken"] is not None for r in results)
    text = f"{done} of {count} episodes, {done_h:.1f} h, {broken} broken"
    print(
        f"\r{text}" if terminal else text,
        end="\n" if done == count or not terminal else "",
        file=sys.stderr,
        flush=True,
    )


def summarise(results: list[Result], seconds: float, kind: str, before: int = 0) -> Result:
    """Add the episodes up; the first `before` of them were kept from an earlier run, which took time of its own."""
    growth = 0.0
    for process in {r["process"] for r in results}:
        memory = [r["resident_mb"] for r in results if r["process"] == process]
        growth = max(growth, memory[-1] - memory[0])
    simulated_s = sum(r["simulated_s"] for r in results)
    totals = ("requests", "refusals", "trips", "moves_reached", "encoder_faults")
    return {
        "kind": kind,
        "seeds": [min(r["seed"] for r in results), max(r["seed"] for r in results)],
        "episodes": len(results),
        "simulated_hours": simulated_s / 3600.0,
        "simulated_seconds_per_second": sum(r["simulated_s"] for r in results[before:]) / seconds,
        "per_core": simulated_s / sum(r["seconds"] for r in results),
        **{name: sum(r[name] for r in results) for name in totals},
        "travel_over_bound": max(r["travel_over_bound"] for r in results),
        "overrun_over_bound": max(r["overrun_over_bound"] for r in results),
        "memory_growth_mb": growth,
        "broken": [
            {"seed": r["seed"], "configuration": r["configuration"], "what": r["broken"]}
            for r in sorted(results, key=lambda result: int(result["seed"]))
            if r["broken"] is not None
        ],
    }


def as_text(summary: Result) -> str:
    """Return the summary for people."""
    lines = [
        (
            f"{summary['simulated_hours']:.1f} simulated hours of the {summary['kind']} in {summary['episodes']} "
            f"episodes, seeds {summary['seeds'][0]} to {summary['seeds'][1]}, "
            f"{summary['simulated_seconds_per_second']:.0f} simulated seconds a second "
            f"({summary['per_core']:.0f} a core)"
        ),
        (
            f"{summary['requests']} requests, {summary['refusals']} refused, {summary['trips']} trips, "
            f"{summary['moves_reached']} moves reached; {summary['encoder_faults']} wrong encoders, the axis went "
            f"up to {summary['travel_over_bound']:.0%} of what it may; beyond a position limit up to "
            f"{summary['overrun_over_bound']:.0%} of what it may; memory grew by {summary['memory_growth_mb']:.1f} MB"
        ),
    ]
    lines += [f"BROKEN seed {one['seed']}, {one['configuration']}: {one['what']}" for one in summary["broken"]]
    return "\n".join(lines if summary["broken"] else [*lines, "no invariant was broken"])


if __name__ == "__main__":
    sys.exit(main())
