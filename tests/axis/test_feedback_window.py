"""What the monitor of the feedback counts: its window, frames rejected on the way, half a modulus of silence."""

import pytest

from twostage_servo.axis.feedback import FeedbackMonitor


def one_with(*counters: int | None) -> FeedbackMonitor:
    monitor = FeedbackMonitor(16)
    for counter in counters:
        monitor.begin_tick(0)
        monitor.accept(counter)
    return monitor


@pytest.mark.parametrize("last", [4, 3, 5 + 1])
def test_an_error_counts_at_once_and_for_a_hundred_ticks(last: int) -> None:
    """Repeated, overtaken, or one lost before it."""
    monitor = one_with(3, 4, last)
    assert monitor.recent_errors == 1
    for _ in range(99):
        monitor.begin_tick(0)
        assert monitor.recent_errors == 1
    monitor.begin_tick(0)
    monitor.begin_tick(0)
    assert monitor.recent_errors == 0


def test_errors_add_up_within_a_tick_and_over_ticks() -> None:
    monitor = one_with(1)
    for expected in (2, 4, 6):
        monitor.begin_tick(0)
        monitor.reject()
        monitor.doubt()
        assert monitor.recent_errors == expected
    assert (monitor.rejected, monitor.implausible) == (3, 3)
    monitor.begin_tick(0)
    assert monitor.recent_errors == 6


def test_each_kind_of_error_is_counted_by_itself() -> None:
    monitor = one_with(3, 3, 3, 4, 3, 2, 6)
    monitor.reject()
    assert (monitor.doubled, monitor.reordered, monitor.lost, monitor.rejected) == (2, 2, 1, 1)
    assert monitor.recent_errors == 6


def test_a_frame_that_was_rejected_is_not_lost_a_second_time() -> None:
    """Two are missing between 3 and 6, and one of them was seen, if broken: two errors, not three."""
    monitor = one_with(3)
    monitor.reject()
    monitor.begin_tick(0)
    monitor.accept(6)
    assert monitor.lost == 2
    assert monitor.recent_errors == 2
    # What has been rejected before a fresh frame excuses nothing after it.
    monitor.begin_tick(0)
    monitor.accept(8)
    assert monitor.recent_errors == 3


def test_every_frame_that_was_rejected_excuses_one_that_is_missing() -> None:
    """Three are missing between 3 and 7, and two of them were seen: three errors."""
    monitor = one_with(3)
    monitor.reject()
    monitor.reject()
    monitor.begin_tick(0)
    monitor.accept(7)
    assert (monitor.lost, monitor.recent_errors) == (3, 3)


def test_more_rejected_than_missing_is_no_merit() -> None:
    monitor = one_with(3)
    for _ in range(3):
        monitor.reject()
    monitor.begin_tick(0)
    monitor.accept(4)
    assert monitor.recent_errors == 3


@pytest.mark.parametrize(("step", "fresh"), [(7, True), (8, True), (9, False)])
def test_half_a_round_ahead_is_new_and_more_is_old(step: int, fresh: bool) -> None:
    monitor = one_with(0)
    monitor.begin_tick(0)
    assert monitor.accept(step) is fresh
    assert (monitor.lost, monitor.reordered) == ((step - 1, 0) if fresh else (0, 1))


@pytest.mark.parametrize(("ticks", "fresh"), [(8, False), (9, True)])
def test_after_more_than_half_a_round_of_silence_any_other_frame_is_new(ticks: int, fresh: bool) -> None:
    monitor = one_with(5)
    monitor.begin_tick(ticks - 1)
    assert monitor.accept(4) is fresh
    assert monitor.reordered == (0 if fresh else 1)
    assert monitor.lost == 0


def test_missed_ticks_make_the_feedback_older_all_the_same() -> None:
    monitor = one_with(5)
    monitor.begin_tick(2)
    assert monitor.ticks_since_fresh == 3
    monitor.begin_tick(0)
    assert monitor.ticks_since_fresh == 4


def test_a_frame_that_is_not_new_does_not_make_the_feedback_fresh() -> None:
    monitor = one_with(5)
    monitor.begin_tick(0)
    assert not monitor.accept(5)
    assert monitor.ticks_since_fresh == 1


def test_a_bus_that_was_reopened_starts_afresh_but_keeps_its_totals() -> None:
    monitor = one_with(3, 3)
    monitor.reject()
    monitor.forget()
    assert monitor.recent_errors == 0
    for _ in range(100):
        monitor.begin_tick(0)
        assert monitor.recent_errors == 0
    assert (monitor.doubled, monitor.rejected) == (1, 1)
    assert monitor.accept(9)
    assert (monitor.lost, monitor.recent_errors) == (0, 0)


def test_several_errors_of_one_tick_add_up() -> None:
    for counters, errors in (((3, 3, 3), 2), ((3, 2, 1), 2), ((3, 3, 2, 5), 3)):
        monitor = FeedbackMonitor(16)
        for counter in counters:
            monitor.accept(counter)
        monitor.reject()
        assert monitor.recent_errors == errors + 1


def test_a_frame_may_be_rejected_before_any_was_taken() -> None:
    monitor = FeedbackMonitor(16)
    monitor.reject()
    assert monitor.recent_errors == 1
    assert monitor.accept(3)
    assert (monitor.lost, monitor.recent_errors) == (0, 1)


def test_a_rejected_frame_and_a_loss_in_one_tick() -> None:
    """Three are missing between 3 and 7, and one of them was rejected in the same tick: that one and two more."""
    monitor = one_with(3)
    monitor.begin_tick(0)
    monitor.reject()
    monitor.accept(7)
    assert monitor.recent_errors == 3


def test_a_frame_without_a_counter_is_new() -> None:
    monitor = one_with(3)
    assert monitor.accept(None)


def test_an_error_counts_for_a_hundred_ticks_the_present_one_included() -> None:
    monitor = one_with(3)
    monitor.begin_tick(0)
    monitor.reject()
    for _ in range(99):
        assert monitor.recent_errors == 1
        monitor.begin_tick(0)
    assert monitor.recent_errors == 1
    monitor.begin_tick(0)
    assert monitor.recent_errors == 0
