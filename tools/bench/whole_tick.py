"""What a whole tick takes, by number of axes and by phase: ``python -m tools.bench.whole_tick --axes 1 --ticks 20000``.

The real service with its drives on the bus inside the process. In simulated time one tick follows the other and finds
the processor's caches as it left them; in real time (``--real``) 10 ms have passed in which others used them.
"""

import argparse
import asyncio
import contextlib
import functools
import gc
import json
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from tools.bench.children import ChildError, json_of, module
from tools.bench.plan import Plan
from tools.bench.summary import percentile, summarise
from tools.bench.world import operate
from twostage_servo.service.log import open_log
from twostage_servo.service.servo_service import ServoService
from twostage_servo.timing.ticks import real_time_loop
from twostage_servo.timing.virtual_clock import run

AXES: Final = (1, 2, 4, 8, 16, 32, 64)
PHASES: Final = ("read", "update", "write", "publish")
_WARM_UP: Final = 50
"""Ticks that come first and do not count."""


def measure(plan: Plan, priority: int, note: Callable[[str], None]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the figures of whole ticks, and why some numbers of axes have none.

    These are ``whole_tick_us``, ``whole_tick_real_time_us``, ``phase_share``, and what :func:`fit` makes of the first.
    """
    result: dict[str, Any] = {"whole_tick_us": {}, "whole_tick_real_time_us": {}, "phase_share": {}}
    not_measured = {}
    for key, ticks, option in (
        ("whole_tick_us", plan.tick_count, []),
        ("whole_tick_real_time_us", plan.real_ticks, ["--real"]),
    ):
        if not ticks:
            not_measured[key] = "it takes too long for --quick"
            continue
        note(f"{', '.join(map(str, AXES))} axes, {ticks} ticks {' '.join(option)}")
        try:
            told = json_of(module("whole_tick", "--axes", *AXES, "--ticks", ticks, *option), 900.0, priority)
        except ChildError as error:
            not_measured[key] = str(error)
            continue
        result[key] = {axes: row["tick_us"] for axes, row in told.items()}
        if not option:
            result["phase_share"] = {axes: row["phase_share"] for axes, row in told.items()}
    return result | fit({int(axes): row["p50"] for axes, row in result["whole_tick_us"].items()}), not_measured


def fit(median_us: Mapping[int, float]) -> dict[str, float]:
    """Return what an axis more costs: the line through the medians by least squares, and how straight they lie.

    Parameters
    ----------
    median_us
        Median of the whole tick in µs, by number of axes.

    Returns
    -------
    dict
        ``whole_tick_of_no_axis_us`` and ``whole_tick_per_axis_us``: the line. The relative error counts, not the
        absolute one, so that few axes weigh as much as many. ``marginal_cost_growth``: what an axis costs between the
        two largest numbers, by what it costs between the smallest and the fourth. Empty with fewer than five numbers.
    """
    sizes = sorted(median_us)
    if len(sizes) < 5:
        return {}
    weights = [1.0 / median_us[size] for size in sizes]
    (intercept, slope), *_ = np.linalg.lstsq(
        np.array([[weight, weight * size] for weight, size in zip(weights, sizes, strict=True)]),
        np.ones(len(sizes)),
        rcond=None,
    )

    def marginal(few: int, many: int) -> float:
        return (median_us[many] - median_us[few]) / (many - few)

    return {
        "whole_tick_of_no_axis_us": round(float(intercept), 3),
        "whole_tick_per_axis_us": round(float(slope), 3),
        "marginal_cost_growth": round(marginal(*sizes[-2:]) / marginal(sizes[0], sizes[3]), 4),
    }


class Stopwatch:
    """Times the phases of each tick of a service, by wrapping its four methods.

    Parameters
    ----------
    ticks
        How many.
    clock
        Tells the time, s. In simulated time that of the thread on the processor: another process that interrupts a long
        tick more often than a short one must not seem to make many axes dearer.
    """

    def __init__(self, ticks: int, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.done: asyncio.Event = asyncio.Event()
        self._left = ticks + _WARM_UP
        self._begun_s = 0.0
        self._ticks_s: list[float] = []
        self._phases_s: dict[str, list[float]] = {name: [] for name in PHASES}

    def watch(self, service: ServoService) -> None:
        """Wrap the methods."""
        for name in PHASES:
            setattr(service, name, self._timed(name, getattr(service, name)))

    def _timed(self, name: str, phase: Callable[..., None]) -> Callable[..., None]:
        clock, durations = self._clock, self._phases_s[name]

        @functools.wraps(phase)
        def timed(*arguments: Any) -> None:
            begun_s = clock()
            phase(*arguments)
            ended_s = clock()
            durations.append(ended_s - begun_s)
            if name == "read":
                self._begun_s = begun_s
            elif name == "publish":
                self._ticks_s.append(ended_s - self._begun_s)
                self._left -= 1
                if self._left == 0:
                    self.done.set()

        return timed

    def figures(self) -> dict[str, Any]:
        """Return the time of a tick in µs, and the share of each phase in the sum of the phases' medians."""
        medians = {name: percentile(sorted(durations[_WARM_UP:]), 0.5) for name, durations in self._phases_s.items()}
        total = sum(medians.values())
        return {
            "tick_us": summarise([1e6 * duration for duration in self._ticks_s[_WARM_UP:]]),
            "phase_share": {name: round(median / total, 4) for name, median in medians.items()},
        }


def time_ticks(axes: int, ticks: int, *, real: bool) -> dict[str, Any]:
    """Run a service of so many axes for so many ticks, beside a warm-up, and return the stopwatch's figures."""

    async def main() -> dict[str, Any]:
        stopwatch = Stopwatch(ticks, time.perf_counter if real else time.thread_time)
        async with operate(axes) as loop:
            stopwatch.watch(loop.service)
            await stopwatch.done.wait()
        return stopwatch.figures()

    if not real:
        return run(main())
    with asyncio.Runner(loop_factory=real_time_loop) as runner:
        return runner.run(main())


def main() -> None:
    """Time what the arguments say and print JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--axes", type=int, nargs="+", default=[1])
    parser.add_argument("--ticks", type=int, default=20_000, help="in simulated time they are shared out to the axes")
    parser.add_argument("--real", action="store_true", help="in real time")
    options = parser.parse_args()
    result: dict[int, dict[str, Any]] = {}
    with contextlib.closing(open_log("error")):
        for axes in options.axes:
            gc.collect()  # what is left of the service before
            result[axes] = time_ticks(axes, options.ticks if options.real else options.ticks // axes, real=options.real)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
