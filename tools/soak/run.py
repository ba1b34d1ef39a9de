"""Soak: months of operation in simulated time, on all cores, with random requests, faults and loads by seed.

``python tools/soak/run.py axis --hours 1000`` runs axes with their plants, without a bus; ``service --hours 50`` runs
whole services over CAN frames. Each episode has a seed of its own and can be run again alone: ``--first-seed N
--episodes 1``. Progress goes to stderr; Ctrl-C ends the run with what has been done so far.
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

sys.path.insert(0, str(Path(__file__).parent))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from axis_soak import AxisSoak
from invariants import BrokenInvariantError, resident_mb
from service_soak import ServiceSoak

from twostage_servo.service.log import open_log

TICK_S = 0.01
EPISODE_S = {"axis": 7200.0, "service": 900.0}
"""Simulated length of an episode."""
MOST_GROWTH_MB = 8.0
"""Growth of a worker's memory after its first episode: its allocator's own, not a leak that grows with the episodes."""


def episode(kind: str, seed: int, simulated_s: float) -> dict[str, Any]:
    """Run one episode; return what it came to."""
    started = time.perf_counter()
    result: dict[str, Any] = {"seed": seed, "broken": None}
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        writer = open_log("critical", nowhere)
        soak: AxisSoak | ServiceSoak = AxisSoak(seed) if kind == "axis" else ServiceSoak(seed)
        try:
            if isinstance(soak, AxisSoak):
                soak.run(round(simulated_s / TICK_S))
            else:
                soak.run(simulated_s)
        except BrokenInvariantError as broken:
            result["broken"] = str(broken)
        finally:
            writer.close()
    return result | {
        "process": os.getpid(),
        "simulated_s": soak.invariants.ticks * TICK_S,
        "seconds": time.perf_counter() - started,
        "requests": soak.requests,
        "refusals": soak.refusals,
        "trips": soak.trips,
        "moves_reached": soak.moves_reached,
        "farthest": soak.invariants.farthest,
        "resident_mb": resident_mb(),
    }


def main() -> int:
    """Run the soak that the arguments describe; return 0 if nothing broke."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=sorted(EPISODE_S))
    parser.add_argument("--hours", type=float, default=1.0, help="simulated hours in all (default 1)")
    parser.add_argument("--episodes", type=int, help="number of episodes, in place of --hours")
    parser.add_argument("--first-seed", type=int, default=1, metavar="N")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    length_s = EPISODE_S[options.kind]
    count = options.episodes or max(1, round(3600.0 * options.hours / length_s))
    started = time.perf_counter()
    results: list[dict[str, Any]] = []
    seeds = range(options.first_seed, options.first_seed + count)
    try:
        for result in episodes(options.kind, seeds, length_s, options.jobs):
            results.append(result)
            show_progress(results, count)
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        if not results:
            return 130
    summary = summarise(results, time.perf_counter() - started, options.kind)
    print(json.dumps(summary) if options.json else as_text(summary))
    return 1 if summary["broken"] or summary["memory_growth_mb"] > MOST_GROWTH_MB else 0


def episodes(kind: str, seeds: Iterable[int], simulated_s: float, jobs: int) -> Iterator[dict[str, Any]]:
    """Run episodes on some cores and give what each came to as it ends; on the way out, give up those not yet begun."""
    pool = concurrent.futures.ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"))
    try:
        futures = [pool.submit(episode, kind, seed, simulated_s) for seed in seeds]
        for future in concurrent.futures.as_completed(futures):
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def show_progress(results: list[dict[str, Any]], count: int) -> None:
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


def summarise(results: list[dict[str, Any]], seconds: float, kind: str) -> dict[str, Any]:
    """Add the episodes up."""
    growth = 0.0
    for process in {r["process"] for r in results}:
        memory = [r["resident_mb"] for r in results if r["process"] == process]
        growth = max(growth, memory[-1] - memory[0])
    simulated_s = sum(r["simulated_s"] for r in results)
    return {
        "kind": kind,
        "seeds": [min(r["seed"] for r in results), max(r["seed"] for r in results)],
        "simulated_hours": simulated_s / 3600.0,
        "simulated_seconds_per_second": simulated_s / seconds,
        "per_core": simulated_s / sum(r["seconds"] for r in results),
        **{name: sum(r[name] for r in results) for name in ("requests", "refusals", "trips", "moves_reached")},
        "farthest_beyond_a_limit": max(r["farthest"] for r in results),
        "memory_growth_mb": growth,
        "broken": [{"seed": r["seed"], "what": r["broken"]} for r in results if r["broken"] is not None],
    }


def as_text(summary: dict[str, Any]) -> str:
    """Return the summary for people."""
    lines = [
        (
            f"{summary['simulated_hours']:.1f} simulated hours of the {summary['kind']}, seeds {summary['seeds'][0]} "
            f"to {summary['seeds'][1]}, {summary['simulated_seconds_per_second']:.0f} simulated seconds a second "
            f"({summary['per_core']:.0f} a core)"
        ),
        (
            f"{summary['requests']} requests, {summary['refusals']} refused, {summary['trips']} trips, "
            f"{summary['moves_reached']} moves reached; at most {summary['farthest_beyond_a_limit']:.2f} beyond a "
            f"position limit; memory grew by {summary['memory_growth_mb']:.1f} MB"
        ),
    ]
    lines += [f"BROKEN seed {one['seed']}: {one['what']}" for one in summary["broken"]]
    return "\n".join(lines if summary["broken"] else [*lines, "no invariant was broken"])


if __name__ == "__main__":
    sys.exit(main())
