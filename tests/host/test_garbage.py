import gc
from collections.abc import Iterator

import pytest

from twostage_servo.host.garbage import GarbageCollection
from twostage_servo.host.warm_up import warm_up


class Collector:
    """Collections that take the given time, of which the last goes on for ever."""

    def __init__(self, *durations_s: float) -> None:
        self.durations_s = list(durations_s)
        self.now_s = 0.0
        self.calls = 0
        self.count = 1000

    def collect(self) -> int:
        self.calls += 1
        self.now_s += self.durations_s.pop(0) if len(self.durations_s) > 1 else self.durations_s[0]
        return 0

    def garbage(self) -> GarbageCollection:
        return GarbageCollection(self.collect, lambda: self.count, lambda: self.now_s)


@pytest.fixture(autouse=True)
def given_back() -> Iterator[None]:
    yield
    gc.unfreeze()
    gc.enable()


def test_what_has_been_made_by_then_is_exempt_and_python_collects_no_more() -> None:
    garbage = GarbageCollection()
    assert garbage.begin() > 1000
    assert not gc.isenabled()
    garbage.end()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_it_collects_when_enough_has_been_made() -> None:
    collector = Collector(1e-4)
    garbage = collector.garbage()
    garbage.begin()
    before = collector.calls
    collector.count = 699
    garbage.after_tick(0.009, driven=True)
    assert collector.calls == before
    collector.count = 700
    garbage.after_tick(0.009, driven=True)
    assert (collector.calls, garbage.collections, garbage.postponed) == (before + 1, 1, 0)
    assert garbage.longest_s == pytest.approx(1e-4)


def test_one_that_would_not_fit_waits_unless_the_axis_is_at_rest() -> None:
    collector = Collector(1e-4)
    garbage = collector.garbage()
    garbage.begin()
    garbage.after_tick(2.9e-4, driven=True)
    assert (garbage.collections, garbage.postponed) == (0, 1)
    garbage.after_tick(2.9e-4, driven=False)
    assert garbage.collections == 1


def test_the_long_one_at_the_beginning_counts_for_nothing() -> None:
    collector = Collector(0.06, 1e-4)  # of all objects; of those that came after
    garbage = collector.garbage()
    garbage.begin()
    garbage.after_tick(0.009, driven=True)
    assert garbage.collections == 1


def test_one_slow_collection_puts_the_next_ones_off_but_not_for_ever() -> None:
    collector = Collector(1e-4, 1e-4, 8e-3, 1e-4)
    garbage = collector.garbage()
    garbage.begin()
    garbage.after_tick(0.009, driven=True)
    assert garbage.longest_s == pytest.approx(8e-3)
    for _ in range(50):
        garbage.after_tick(0.009, driven=True)
    assert garbage.postponed < 15
    assert garbage.collections > 30


def test_real_garbage_is_found() -> None:
    class Node:
        def __init__(self) -> None:
            self.myself = self

    garbage = GarbageCollection(count=lambda: 1000)
    garbage.begin()
    gc.collect()
    for _ in range(100):
        Node()
    assert sum(isinstance(one, Node) for one in gc.get_objects()) == 100
    garbage.after_tick(0.0, driven=False)
    assert sum(isinstance(one, Node) for one in gc.get_objects()) == 0


def test_warming_up_runs_the_step_and_tells_the_first_and_the_settled_duration() -> None:
    now_s, durations_s, steps = 0.0, iter([9.0, 3.0, 1.0, 2.0, 1.0]), 0

    def step() -> None:
        nonlocal now_s, steps
        now_s += next(durations_s)
        steps += 1

    assert warm_up(step, 5, lambda: now_s) == (9.0, 1.0)
    assert steps == 5


def test_warming_up_runs_at_least_twice() -> None:
    calls: list[None] = []
    warm_up(lambda: calls.append(None), 0)
    assert len(calls) == 2
