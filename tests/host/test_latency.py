import itertools
import signal
import subprocess
import sys
from array import array
from typing import Any

import pytest

from twostage_servo.host.latency import (
    MeasuredMargin,
    Measurement,
    Verdict,
    histogram_us,
    judge,
    measure,
    percentile,
    summary_us,
)
from twostage_servo.host.load import _HOG, processor_load
from twostage_servo.timing.ticks import Tick, Ticks
from twostage_servo.timing.virtual_clock import run
from twostage_servo.timing.wake_margin import FixedMargin

PERIOD_S = 0.01


def measurement(*lateness_us: float, missed: int = 0, most: int = 0) -> Measurement:
    return Measurement(PERIOD_S, array("f", (1e-6 * value for value in lateness_us)), missed=missed, most_missed=most)


def test_it_runs_the_ticks_for_the_time_asked_for_and_counts_what_they_say() -> None:
    seen: list[Tick] = []
    used_s = itertools.count(0.0, 0.02)
    ticks = Ticks(PERIOD_S, start_s=-0.035, margin=MeasuredMargin(None))
    result = run(measure(ticks, 1.0, seen.append, lambda: next(used_s)))
    assert len(result.lateness_s) == 98  # three deadlines lie before the beginning, and two of them were missed
    assert (result.missed, result.most_missed) == (2, 2)
    assert len(seen) == 97
    assert result.elapsed_s == pytest.approx(1.0)
    assert result.cpu_share == pytest.approx(0.02)
    assert len(result.wake_latency_s) == 97  # the first was overdue
    assert result.as_json()["lateness_us"]["max"] == pytest.approx(5000.0)


def test_the_shortest_measurement_is_one_tick() -> None:
    result = run(measure(Ticks(PERIOD_S), 1e-9))
    assert len(result.lateness_s) == 1
    assert result.as_json()["wake_latency_us"]["max"] == 0.0


def test_the_margin_is_used_and_told() -> None:
    margin = MeasuredMargin(FixedMargin(2e-4, PERIOD_S))
    assert margin.margin_s == 2e-4
    assert run(measure(Ticks(PERIOD_S, margin=margin), 0.1)).margin_s == 2e-4


@pytest.mark.parametrize(
    ("run_of_ticks", "level"),
    [
        (measurement(*[199.9] * 199, 2499.0), "good"),
        (measurement(*[201.0] * 100), "fair"),
        (measurement(*[1.0] * 199, 2501.0), "fair"),
        (measurement(*[1999.0] * 100, missed=9, most=2), "fair"),
        (measurement(*[1.0] * 100, missed=3, most=3), "poor"),
        (measurement(*[2001.0] * 100), "poor"),
    ],
)
def test_the_verdict_follows_from_the_tick(run_of_ticks: Measurement, level: str) -> None:
    verdict = judge(run_of_ticks, tolerated=2)
    assert verdict.level == level
    assert "2000 µs" in verdict.reason or level == "good"


def test_the_verdict_gives_its_figures() -> None:
    assert judge(measurement(*[0.25] * 99, 30.4), 2) == Verdict(
        "good",
        "no tick missed; 99 % came within 0.25 µs, the worst 30 µs late (good is none missed, 200 µs and 2500 µs)",
    )
    assert (
        "3 ticks missed, at most 2 in a row (the axis tolerates 2)"
        in judge(measurement(1.0, missed=3, most=2), 2).reason
    )


def test_percentiles_are_the_nearest_rank() -> None:
    assert percentile([], 50.0) == 0.0
    values = [float(n) for n in range(1, 101)]
    assert [percentile(values, percent) for percent in (0.0, 50.0, 99.0, 99.9, 100.0)] == [1, 50, 99, 100, 100]
    assert summary_us([2e-6, 1e-6]) == {"p50": 1.0, "p90": 2.0, "p99": 2.0, "p99.9": 2.0, "max": 2.0}


def test_the_histogram_has_every_bin_between_the_first_and_the_last() -> None:
    assert histogram_us([]) == []
    assert histogram_us([0.0, 0.9e-6, 3e-6, 40e-6]) == [(1, 2), (2, 0), (5, 1), (10, 0), (20, 0), (50, 1)]
    edges = [edge for edge, _ in histogram_us([0.0, 1.0])]
    assert edges == sorted(edges)
    for edge_us in edges:
        assert histogram_us([0.999 * 1e-6 * edge_us])[0][0] == edge_us


def test_the_busy_processes_end_with_the_measurement_whatever_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    class Popen(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr(subprocess, "Popen", Popen)

    def interrupted() -> None:
        with processor_load(2) as count:
            assert count == 2
            assert [hog.poll() for hog in started] == [None, None]
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [hog.returncode for hog in started] == [-signal.SIGKILL] * 2


def test_a_busy_process_that_has_lost_its_parent_ends_by_itself() -> None:
    subprocess.run([sys.executable, "-I", "-S", "-c", _HOG, "0"], check=True, timeout=60)  # noqa: S603
