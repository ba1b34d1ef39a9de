import math
import random
from typing import TYPE_CHECKING

import pytest

from twostage_servo.timing.wake_margin import FixedMargin, LearnedMargin, wake_margin

if TYPE_CHECKING:
    from collections.abc import Callable

PERIOD_S = 0.01


def learn(margin: LearnedMargin, latency_s: float, until_s: float) -> int:
    """How many equal latencies it takes until the margin has passed a value."""
    above = margin.margin_s > until_s
    for count in range(1, 10_000):
        margin.learn(latency_s)
        if (margin.margin_s > until_s) is not above:
            return count
    raise AssertionError("it never does")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["normal", "uniform", "exponential"])
def test_it_covers_nineteen_of_twenty_latencies(kind: str, seed: int) -> None:
    source = random.Random(seed)  # noqa: S311
    draws: dict[str, Callable[[], float]] = {
        "normal": lambda: abs(source.gauss(150e-6, 30e-6)),
        "uniform": lambda: source.uniform(50e-6, 400e-6),
        "exponential": lambda: 60e-6 + source.expovariate(1 / 40e-6),
    }
    draw = draws[kind]
    margin = LearnedMargin(PERIOD_S)
    for _ in range(1000):
        margin.learn(draw())
    covered = 0
    for _ in range(20_000):
        latency_s = draw()
        covered += latency_s <= margin.margin_s
        margin.learn(latency_s)
    assert 0.94 <= covered / 20_000 <= 0.96


def test_it_follows_a_slower_host_at_once_and_a_quicker_one_in_seconds() -> None:
    margin = LearnedMargin(PERIOD_S)
    learn(margin, 150e-6, 150e-6)
    assert learn(margin, 450e-6, 449e-6) <= 13
    assert learn(margin, 150e-6, 151e-6) <= 230


def test_one_outlier_hardly_moves_it() -> None:
    margin = LearnedMargin(PERIOD_S)
    learn(margin, 150e-6, 150e-6)
    before_s = margin.margin_s
    margin.learn(0.9e-3)
    assert before_s < margin.margin_s < 1.1 * before_s


@pytest.mark.parametrize(("period_s", "cap_s"), [(0.001, 100e-6), (0.01, 1e-3), (0.1, 1e-3)])
def test_it_stays_within_its_cap_and_above_zero(period_s: float, cap_s: float) -> None:
    margin = LearnedMargin(period_s)
    for _ in range(1000):
        margin.learn(0.999 * cap_s)
        assert margin.margin_s <= cap_s
    assert margin.margin_s > 0.9 * cap_s
    for _ in range(10_000):
        margin.learn(0.0)
    assert margin.margin_s == 5e-6
    assert learn(margin, 50e-6, 50e-6) < 50


def test_a_latency_that_no_margin_could_cover_teaches_nothing() -> None:
    margin = LearnedMargin(PERIOD_S)
    before_s = margin.margin_s
    for latency_s in (1.1e-3, 5e-3, 3.0, math.inf):
        margin.learn(latency_s)
    assert margin.margin_s == before_s


def test_what_the_setting_asks_for() -> None:
    assert wake_margin("off", PERIOD_S) is None
    assert wake_margin(0.0, PERIOD_S) is None
    assert isinstance(wake_margin("auto", PERIOD_S), LearnedMargin)
    fixed = wake_margin(120, PERIOD_S)
    assert isinstance(fixed, FixedMargin)
    fixed.learn(0.1)
    assert fixed.margin_s == pytest.approx(120e-6)
    short = wake_margin(1000.0, 0.001)
    assert short is not None
    assert short.margin_s == 0.5e-3
