"""Measures how punctual this host's ticks are, with the ticks and the loop that the service runs on."""

import math
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from twostage_servo.timing.ticks import Tick, Ticks, WakeMargin

GOOD_P99_SHARE: Final = 0.02
GOOD_WORST_SHARE: Final = 0.25
FAIR_P99_SHARE: Final = 0.2
"""Shares of the tick that lateness may take. It acts on the loop as a dead time that varies: 2 % of a tick is small
beside the whole tick of transport delay that the observer already allows for, 20 % begins to cost phase margin."""

PERCENTS: Final = (50.0, 90.0, 99.0, 99.9)
_STEPS: Final = (1.0, 2.0, 5.0)


class MeasuredMargin:
    """A margin that keeps every wake-up latency that it is told.

    Parameters
    ----------
    margin
        The margin that is really used; None without a busy-wait.

    Attributes
    ----------
    wake_latency_s : array of float
        Every latency, s.
    """

    __slots__ = ("_margin", "wake_latency_s")

    def __init__(self, margin: WakeMargin | None) -> None:
        self._margin = margin
        self.wake_latency_s = array("f")

    @property
    def margin_s(self) -> float:
        """The margin for the next tick, s."""
        return 0.0 if self._margin is None else self._margin.margin_s

    def learn(self, wake_latency_s: float) -> None:
        """Record one wake-up latency, s."""
        self.wake_latency_s.append(wake_latency_s)
        if self._margin is not None:
            self._margin.learn(wake_latency_s)


@dataclass(slots=True)
class Measurement:
    """What a run of ticks showed.

    Attributes
    ----------
    period_s
        Period of the ticks, s.
    lateness_s, wake_latency_s
        Of each tick: how long after its deadline it came; how long after the time asked for the timer woke the loop.
    missed, most_missed
        Deadlines that passed unserved; the most of them in one go.
    elapsed_s, cpu_s
        How long it took; what the loop's thread used of a processor in that time.
    margin_s
        The margin at the end.
    """

    period_s: float
    lateness_s: "array[float]" = field(default_factory=lambda: array("f"))
    wake_latency_s: "array[float]" = field(default_factory=lambda: array("f"))
    missed: int = 0
    most_missed: int = 0
    elapsed_s: float = 0.0
    cpu_s: float = 0.0
    margin_s: float = 0.0

    @property
    def cpu_share(self) -> float:
        """What the loop's thread used of one processor."""
        return self.cpu_s / self.elapsed_s if self.elapsed_s else 0.0

    def as_json(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "period_ms": 1e3 * self.period_s,
            "elapsed_s": round(self.elapsed_s, 3),
            "ticks": len(self.lateness_s),
            "missed": self.missed,
            "most_missed_in_one_go": self.most_missed,
            "lateness_us": summary_us(self.lateness_s),
            "wake_latency_us": summary_us(self.wake_latency_s),
            "margin_us": round(1e6 * self.margin_s, 1),
            "cpu_share": round(self.cpu_share, 5),
            "histogram": [{"up_to_us": edge, "ticks": count} for edge, count in histogram_us(self.lateness_s)],
        }


async def measure(
    ticks: Ticks,
    seconds: float,
    after_tick: Callable[[Tick], object] = lambda _: None,
    cpu_time: Callable[[], float] = time.thread_time,
) -> Measurement:
    """Run the ticks without a motion and without a bus, and keep how late each of them came.

    Parameters
    ----------
    ticks
        The ticks; with a :class:`MeasuredMargin` the wake-up latency is kept as well.
    seconds
        How long.
    after_tick
        Called in each tick.
    cpu_time
        What this thread has used of a processor so far, s.
    """
    result = Measurement(ticks.period_s)
    last = max(1, round(seconds / ticks.period_s))
    begun_s = cpu_time()
    async for tick in ticks:
        ticks.begin(tick)
        result.lateness_s.append(tick.lateness_s)
        result.missed += tick.missed
        result.most_missed = max(result.most_missed, tick.missed)
        if tick.index >= last:
            result.elapsed_s = tick.index * ticks.period_s + tick.lateness_s
            break
        after_tick(tick)
    result.cpu_s = cpu_time() - begun_s
    result.margin_s = ticks.margin_s
    if isinstance(ticks.margin, MeasuredMargin):
        result.wake_latency_s = ticks.margin.wake_latency_s
    return result


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the measurement means for a servo loop, and by which thresholds."""

    level: Literal["good", "fair", "poor"]
    reason: str


def judge(measurement: Measurement, tolerated: int) -> Verdict:
    """Judge a measurement by the period of its ticks.

    Good: no tick was missed, 99 % came within 2 % of the tick, all within a quarter. Fair: no more were missed in one
    go than the axis tolerates, 99 % came within a fifth of the tick. Poor: anything else.

    Parameters
    ----------
    measurement
        What was measured.
    tolerated
        Ticks that may be missed in one go before the axis trips (``axis.limits.missed_ticks``).
    """
    period_us = 1e6 * measurement.period_s
    ordered = sorted(measurement.lateness_s)
    p99_us, worst_us = 1e6 * percentile(ordered, 99.0), 1e6 * percentile(ordered, 100.0)
    missed = f"{measurement.missed or 'no'} tick{'s' if measurement.missed > 1 else ''} missed"
    if measurement.missed:
        missed += f", at most {measurement.most_missed} in a row (the axis tolerates {tolerated})"
    figures = f"{missed}; 99 % came within {_rounded(p99_us)} µs, the worst {_rounded(worst_us)} µs late"
    good = f"good is none missed, {GOOD_P99_SHARE * period_us:g} µs and {GOOD_WORST_SHARE * period_us:g} µs"
    fair = f"fair is {FAIR_P99_SHARE * period_us:g} µs for 99 %, and no trip for missed ticks"
    if measurement.missed == 0 and p99_us <= GOOD_P99_SHARE * period_us and worst_us <= GOOD_WORST_SHARE * period_us:
        return Verdict("good", f"{figures} ({good})")
    if measurement.most_missed <= tolerated and p99_us <= FAIR_P99_SHARE * period_us:
        return Verdict("fair", f"{figures} ({good}; {fair})")
    return Verdict("poor", f"{figures} ({fair})")


def _rounded(value_us: float) -> str:
    return f"{value_us:.0f}" if value_us >= 10.0 else f"{value_us:.2g}"


def percentile(ordered: Sequence[float], percent: float) -> float:
    """Return the smallest of the ordered values that so many per cent of them do not exceed; 0 if there are none."""
    if not ordered:
        return 0.0
    return ordered[max(0, math.ceil(percent / 100.0 * len(ordered)) - 1)]


def summary_us(values_s: Sequence[float]) -> dict[str, float]:
    """Return percentiles and maximum in µs."""
    ordered = sorted(values_s)
    summary = {f"p{percent:g}": round(1e6 * percentile(ordered, percent), 2) for percent in PERCENTS}
    return {**summary, "max": round(1e6 * percentile(ordered, 100.0), 2)}


def histogram_us(values_s: Sequence[float]) -> list[tuple[float, int]]:
    """Count values in bins of 1, 2, 5, 10, ... µs.

    Returns
    -------
    list of tuple
        Upper edge in µs and count, from the first bin that holds a value to the last.
    """
    counts: dict[int, int] = {}
    for value_s in values_s:
        bin_index = _bin(1e6 * value_s)
        counts[bin_index] = counts.get(bin_index, 0) + 1
    if not counts:
        return []
    return [(_edge_us(index), counts.get(index, 0)) for index in range(min(counts), max(counts) + 1)]


def _edge_us(bin_index: int) -> float:
    decade, step = divmod(bin_index, len(_STEPS))
    return float(_STEPS[step] * 10**decade)


def _bin(value_us: float) -> int:
    if value_us <= _STEPS[0]:
        return 0
    bin_index = len(_STEPS) * int(math.log10(value_us))
    while value_us > _edge_us(bin_index):
        bin_index += 1
    return bin_index
