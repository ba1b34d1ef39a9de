"""An encoder that has turned round where nothing jumped, told afresh; and loads that push as hard, which are not."""

from collections.abc import Callable
from math import isclose

import pytest

from twostage_servo.control.model_monitor.recent_reversal import RecentReversal
from twostage_servo.control.observer import NoiseModel
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01
MODEL = Plant(180.0, 14.0)
NOISE = NoiseModel((0.1, 0.1, 0.1), 0.01)
LEAST = 0.2


class Bench:
    """A watch on a plant that is driven tick by tick; what it sees is a function of the true position."""

    def __init__(self, plant: Plant = MODEL, sees: Callable[[float], float] = lambda position: position) -> None:
        self.watch = RecentReversal(MODEL, PERIOD_S, NOISE)
        self.sampled, self.sees = plant.discretise(PERIOD_S), sees
        self.position = self.velocity = self.before = self.shown = 0.0
        self.surprised = 0

    def tick(self, effort: float, load: float = 0.0, square: float = 0.09, *, surprised: bool = True) -> None:
        shown = self.sees(self.position)
        self.watch.update(shown, effort, self.before, square, is_surprised=surprised)
        self.before, self.shown = effort, shown
        plant, total = self.sampled, effort - load
        self.position += plant.a12 * self.velocity + plant.b1 * total
        self.velocity = plant.a22 * self.velocity + plant.b2 * total

    def runs_away(self, ticks: int, load: float = 0.0, *, surprised: bool = True) -> int | None:
        """Feed what it sees back, as a law does that holds 0; return the tick in which the watch is certain."""
        for index in range(ticks):
            velocity = (self.sees(self.position) - self.shown) / PERIOD_S
            self.tick(-3.0 * self.sees(self.position) - 0.05 * velocity + 0.5, load, surprised=surprised)
            if self.watch.is_certain(LEAST):
                return index
        return None


def test_an_encoder_that_is_turned_round_is_told_once_it_has_explained_more_for_50_ms() -> None:
    bench = Bench(sees=lambda position: -position)
    tick = bench.runs_away(30)
    assert tick is not None
    assert 5 <= tick <= 12
    reckoning = bench.watch.reckon()
    assert reckoning.velocity == pytest.approx(bench.velocity, rel=0.02)
    assert reckoning.disturbance == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("gain", [0.8, 0.9, 1.2])
def test_also_on_a_plant_that_is_off_its_model(gain: float) -> None:
    assert Bench(Plant(gain * MODEL.gain, MODEL.pole), lambda position: -position).runs_away(30) is not None


@pytest.mark.parametrize("load", [-8.0, -3.0, 3.0, 8.0])
def test_a_load_is_none(load: float) -> None:
    assert Bench().runs_away(100, load) is None


def test_nor_is_a_load_that_grows() -> None:
    bench = Bench()
    for index in range(60):
        bench.tick(-3.0 * bench.position + 0.5, load=0.2 * index)
        assert not bench.watch.is_certain(LEAST)


def test_it_does_nothing_while_nothing_surprises() -> None:
    assert Bench(sees=lambda position: -position).runs_away(60, surprised=False) is None


def test_it_is_idle_again_once_nothing_surprises_and_costs_nothing_then() -> None:
    bench = Bench()
    for _ in range(10):
        bench.tick(1.0)
    assert bench.watch._ticks > 0
    for _ in range(20):
        bench.tick(1.0, square=0.0, surprised=False)
    assert bench.watch._ticks == 0


def test_it_takes_the_accepted_plants_to_be_surprised_enough() -> None:
    """From 1.5 times the surprise below which nothing is decided, over what the window keeps of it."""
    for square, told in ((0.0, False), (1e-4, False), (0.09, True)):
        bench = Bench(sees=lambda position: -position)
        for _ in range(14):
            velocity = (bench.sees(bench.position) - bench.shown) / PERIOD_S
            bench.tick(-3.0 * bench.sees(bench.position) - 0.05 * velocity + 0.5, square=square)
        assert bench.watch.is_certain(LEAST) is told


def test_it_begins_anew_after_a_tick_without_a_sample() -> None:
    bench = Bench(sees=lambda position: -position)
    assert bench.runs_away(30) is not None
    bench.watch.start()
    assert not bench.watch.is_certain(LEAST)
    tick = bench.runs_away(30)
    assert tick is not None
    assert tick >= 5


def test_it_begins_from_the_last_three_samples() -> None:
    """An axis at 20 mm/s that slows by 1 mm/s a tick, reversed: the load is what this takes beside the effort."""
    watch = RecentReversal(MODEL, PERIOD_S, NOISE)
    for place in (0.0, 0.205, 0.4):  # 20.5 and 19.5 mm/s on the average
        watch.update(place, 1.0, 1.0, 0.04, is_surprised=True)
    watch.update(0.4 + 0.185, 1.0, 1.0, 0.04, is_surprised=True)
    # It goes on with an effort that has not changed: slower by 1 mm/s again, but for what its pole does.
    assert isclose(-watch.reckon().velocity, 17.0, rel_tol=0.01)
