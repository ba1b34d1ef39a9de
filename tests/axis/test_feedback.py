"""Alive counters: fresh, doubled, overtaken, lost."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.axis.feedback import FeedbackMonitor


def accept(monitor: FeedbackMonitor, *counters: int | None) -> list[bool]:
    fresh = []
    for counter in counters:
        monitor.begin_tick(0)
        fresh.append(monitor.accept(counter))
    return fresh


def test_a_doubled_frame_is_not_fresh() -> None:
    monitor = FeedbackMonitor(16)
    assert accept(monitor, 3, 4, 4, 5) == [True, True, False, True]
    assert (monitor.doubled, monitor.reordered, monitor.lost) == (1, 0, 0)


def test_an_overtaken_frame_is_not_fresh() -> None:
    monitor = FeedbackMonitor(16)
    assert accept(monitor, 3, 5, 4, 6) == [True, True, False, True]
    assert (monitor.doubled, monitor.reordered, monitor.lost) == (0, 1, 1)


@given(start=st.integers(0, 15), steps=st.lists(st.integers(1, 8), max_size=40))
def test_losses_are_counted_through_the_wrap(start: int, steps: list[int]) -> None:
    monitor = FeedbackMonitor(16)
    counters = [start]
    for step in steps:
        counters.append((counters[-1] + step) % 16)
    assert all(accept(monitor, *counters))
    assert monitor.lost == sum(step - 1 for step in steps)


@pytest.mark.parametrize("counter", [0, 2, 4, 6, 15])
def test_after_a_long_silence_any_other_counter_is_fresh(counter: int) -> None:
    monitor = FeedbackMonitor(16)
    accept(monitor, 5)
    for _ in range(20):
        monitor.begin_tick(0)
    assert accept(monitor, counter) == [True]
    assert (monitor.doubled, monitor.reordered) == (0, 0)


def test_a_drive_that_repeats_itself_is_never_fresh() -> None:
    monitor = FeedbackMonitor(16)
    accept(monitor, 5)
    for _ in range(40):
        monitor.begin_tick(0)
        assert accept(monitor, 5) == [False]
    assert monitor.ticks_since_fresh == 80


def test_the_age_counts_missed_ticks() -> None:
    monitor = FeedbackMonitor(16)
    assert [monitor.ticks_since_fresh] == [None]
    accept(monitor, 1)
    assert monitor.ticks_since_fresh == 0
    monitor.begin_tick(4)
    assert monitor.ticks_since_fresh == 5
    monitor.forget()
    monitor.begin_tick(0)
    assert [monitor.ticks_since_fresh] == [None]


def test_a_drive_without_a_counter_is_always_fresh() -> None:
    assert accept(FeedbackMonitor(1), None, None, None) == [True, True, True]


@pytest.mark.parametrize("every", [1, 2, 5])
def test_how_far_apart_samples_come_is_that_of_the_last_two_until_all_is_forgotten(every: int) -> None:
    monitor = FeedbackMonitor(16)
    assert monitor.ticks_between_fresh == 0
    for tick in range(4 * every + 1):
        monitor.begin_tick(0)
        if tick % every == 0:
            monitor.accept(tick // every)
    assert monitor.ticks_between_fresh == every
    monitor.forget()
    assert monitor.ticks_between_fresh == 0
