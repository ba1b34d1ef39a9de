"""How fast simulated time goes by, and what memory a long one takes: ``python -m tools.bench.simulated_time``.

Both with the whole service and its drive, moving, in a process of their own.
"""

import argparse
import asyncio
import contextlib
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tools.bench.children import json_of, module
from tools.bench.plan import PERIOD_S, Plan
from tools.bench.world import operate
from twostage_servo.service.log import open_log
from twostage_servo.timing.virtual_clock import run


def measure(plan: Plan, priority: int, note: Callable[[str], None]) -> dict[str, Any]:
    """Return what :func:`run_long` does, of a process of its own."""
    note(f"{plan.memory_ticks} ticks after {plan.memory_warm_up}")
    command = module("simulated_time", "--warm-up", plan.memory_warm_up, "--ticks", plan.memory_ticks)
    result: dict[str, Any] = json_of(command, 1800.0, priority)
    return result


def resident_mb() -> float:
    """Return the resident memory of this process, in MB of 10^6 bytes."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return 1e-6 * pages * os.sysconf("SC_PAGESIZE")


def run_long(warm_up: int, ticks: int) -> dict[str, Any]:
    """Run for so many ticks after a warm-up.

    Returns
    -------
    dict
        ``simulated_seconds_per_second``; ``simulated_tick_cpu_us``, the CPU time of a tick with its drive, which counts
        nothing of what else runs on the machine; ``memory_growth_mb``, and over how many ticks that was.
    """

    async def main() -> dict[str, Any]:
        async with operate(1):
            await asyncio.sleep(warm_up * PERIOD_S)
            before_mb, begun_cpu_s, begun_s = resident_mb(), time.process_time(), time.perf_counter()
            await asyncio.sleep(ticks * PERIOD_S)
            took_s, took_cpu_s = time.perf_counter() - begun_s, time.process_time() - begun_cpu_s
            after_mb = resident_mb()
        return {
            "simulated_seconds_per_second": round(ticks * PERIOD_S / took_s, 1),
            "simulated_tick_cpu_us": round(1e6 * took_cpu_s / ticks, 1),
            "memory_growth_mb": round(after_mb - before_mb, 3),
            "memory_ticks": ticks,
        }

    return run(main())


def main() -> None:
    """Run as long as the arguments say and print JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--warm-up", type=int, default=50_000)
    parser.add_argument("--ticks", type=int, default=1_000_000)
    options = parser.parse_args()
    with contextlib.closing(open_log("error")):
        print(json.dumps(run_long(options.warm_up, options.ticks)))


if __name__ == "__main__":
    main()
