"""The Python loops whose punctuality is compared, one a process: ``python -m tools.bench.loops NAME --seconds S``.

Each notes, as the first statement of a pass, how long its deadline has passed by its own clock, in µs.
"""

import argparse
import asyncio
import importlib
import json
import time
from collections.abc import Callable
from typing import Any, Final

from tools.bench.plan import PERIOD_S
from twostage_servo.timing.ticks import Ticks, real_time_loop
from twostage_servo.timing.wake_margin import wake_margin

Lateness = dict[str, list[float]]
"""What a loop has noted, in µs, pass by pass; under its name, and another one if it has two ways to look at it."""

_WARM_UP: Final = 20
"""Passes that come first and do not count."""


def punctual_ticks(period_s: float) -> Ticks:
    """Return the service's ticks as it uses them in real time, unless it is told otherwise."""
    return Ticks(period_s, margin=wake_margin("auto", period_s))


def ours(passes: int) -> Lateness:
    """Run the service's own ticks on its own event loop.

    A skipped deadline counts as one that was met late, and a pass that begins early as one that is late by as much.
    """
    lateness: list[float] = []

    async def main() -> None:
        ticks = punctual_ticks(PERIOD_S)
        async for tick in ticks:
            now_s = ticks.begin(tick)
            lateness.append(1e6 * (abs(now_s - tick.deadline_s) + tick.missed * PERIOD_S))
            if len(lateness) >= passes:
                break

    with asyncio.Runner(loop_factory=real_time_loop) as runner:
        runner.run(main())
    return {"ours": lateness}


def asyncio_sleep(passes: int) -> Lateness:
    """Sleep for a period after each pass, as most scripts do; what each pass takes adds up."""
    lateness = []

    async def main() -> None:
        clock = asyncio.get_running_loop().time
        begun_s = clock()
        for number in range(1, passes + 1):
            await asyncio.sleep(PERIOD_S)
            lateness.append(1e6 * (clock() - begun_s - number * PERIOD_S))

    asyncio.run(main())
    return {"asyncio_sleep": lateness}


def soft_realtime_loop(passes: int) -> Lateness:
    """Run NeuroLocoMiddleware's SoftRealtimeLoop, which sleeps until 0.1 ms before a deadline and then spins.

    It is timed by the wall clock, whose seconds since 1970 a float holds to 0.24 µs. `t1` is the next deadline.
    """
    loop_type: Any = importlib.import_module("NeuroLocoMiddleware.SoftRealtimeLoop").SoftRealtimeLoop
    lateness = []
    loop = loop_type(dt=PERIOD_S, report=False, fade=0.0)
    clock = time.time
    for _ in loop:
        lateness.append(1e6 * (clock() - (loop.t1 - PERIOD_S)))
        if len(lateness) >= passes:
            loop.stop()
    return {"soft_realtime_loop": lateness}


LOOPS: Final[dict[str, Callable[[int], Lateness]]] = {
    "ours": ours,
    "asyncio_sleep": asyncio_sleep,
    "soft_realtime_loop": soft_realtime_loop,
}


def main() -> None:
    """Run one loop and print its lateness, pass by pass, as JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("loop", choices=sorted(LOOPS))
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    lateness = LOOPS[options.loop](_WARM_UP + round(options.seconds / PERIOD_S))
    print(json.dumps({name: [round(value, 3) for value in values[_WARM_UP:]] for name, values in lateness.items()}))


if __name__ == "__main__":
    main()
