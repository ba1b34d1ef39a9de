"""What counts as an estimate that is wrong, by hand; and a change of the encoder just after a sample that was late."""

import itertools

import pytest

from tests.control.model_monitor.test_monitor import PLANT
from twostage_servo.control.model_monitor.monitor import ModelMonitor
from twostage_servo.control.model_monitor.surprise import _MADE_GOOD, Surprise
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain

HALF_KEPT = 0.5
DECIDES = 1.0
"""The square of the surprise below which nothing is decided, in mm²."""


class Window:
    """A window and the observer of a model; nothing moves but what the samples show."""

    def __init__(self, period_s: float = 0.01) -> None:
        model = PLANT.discretise(period_s)
        gain = kalman_gain(model, NoiseModel()).predictor
        self.observer, self.spare = DisturbanceObserver(model, gain), DisturbanceObserver(model, gain)
        self.window = Surprise(HALF_KEPT, self.observer, self.spare)

    def show(self, *surprises: float, square: float | None = None) -> Surprise:
        """Give it samples that surprise the model by so much, or by the square that is given."""
        for surprise in surprises:
            sample = self.observer.position + surprise
            self.observer.update(sample, 0.0)
            self.window.update(surprise**2 if square is None else square, sample, 0.0, 0.0, DECIDES)
        return self.window


def test_the_sum_forgets_and_begins_as_if_it_had_been_so_for_long() -> None:
    window = Window()
    assert (window.window.total, window.window.lasting) == (0.0, 0.0)
    window.show(0.9, 0.8)
    assert window.window.total == window.window.lasting == pytest.approx(0.405 + 0.64)
    window.window.start(2.0)
    assert (window.window.total, window.window.lasting) == (4.0, 4.0)
    window.show(0.9)
    assert window.window.total == window.window.lasting == pytest.approx(2.0 + 0.81)


@pytest.mark.parametrize("period_s", [0.002, 0.01, 0.02, 0.1])
@pytest.mark.parametrize("late", [-3.0, 1.1, 3.0])
def test_a_sample_that_was_late_does_not_last_nor_what_it_makes_of_the_estimates(late: float, period_s: float) -> None:
    """Until the next one has come it may be anything. The axis stands, and all but that sample show it at 0 mm."""
    window = Window(period_s)
    assert window.show(late).lasting == pytest.approx(late**2)
    for _ in range(20):
        window.show(-window.observer.position)
        assert window.window.lasting <= 2.0 * 0.1**2  # a tenth of what decides, in each sample of the window
    assert window.window.total > 0.0


def test_the_model_goes_on_from_where_it_would_be_without_the_late_sample() -> None:
    """Twice the same axis: to one of them nothing is shown in the tick in which the other is shown a late sample."""
    window, without = Window(), Window()
    for one in (window, without):
        one.observer.go_on_from(0.0, 50.0, 2.0)
    window.show(-3.0)
    without.observer.predict(0.0)
    spare, expected = window.spare, without.observer
    assert (spare.position, spare.velocity, spare.disturbance) == pytest.approx(
        (expected.position, expected.velocity, expected.disturbance)
    )


@pytest.mark.parametrize("least_square", [0.04, 1.0, 4.0])
@pytest.mark.parametrize(("share", "goes_on"), [(0.9, False), (1.1, True)])
def test_the_model_without_the_late_sample_is_kept_until_the_other_one_has_made_good(
    share: float, goes_on: bool, least_square: float
) -> None:
    """That is where it surprises by no more than a share of what decides, however much that is."""
    window = Window()
    window.window.update(9.0 * least_square, 0.0, 0.0, 0.0, least_square)
    square = share * _MADE_GOOD * _MADE_GOOD * least_square
    window.window.update(square, window.spare.position, 0.0, 0.0, least_square)
    window.window.predict(6.0)
    assert (window.spare.velocity != 0.0) is goes_on


def test_a_missing_sample_and_another_origin_take_the_model_without_the_late_one_along() -> None:
    window, without = Window(), Window()
    for one in (window, without):
        one.observer.go_on_from(0.0, 50.0, 2.0)
    window.show(-3.0)
    without.observer.predict(0.0)
    for one in (window, without):
        one.observer.predict(4.0)
        one.observer.shift(7.0)
    window.window.predict(4.0)
    window.window.shift(7.0)
    assert window.spare.position == pytest.approx(without.observer.position)
    assert window.spare.velocity == pytest.approx(without.observer.velocity)


def test_it_takes_a_sample_by_its_own_velocity_and_under_the_effort_that_acted() -> None:
    window, without = Window(), Window()
    for one in (window, without):
        one.observer.go_on_from(0.0, 50.0, 2.0)
    window.show(-3.0)
    without.observer.predict(0.0)
    sample, velocity = without.observer.position + 0.2, without.observer.velocity
    window.observer.update(sample, 4.0)
    window.window.update(9.0, sample - 0.003 * velocity, 4.0, 0.003, DECIDES)
    without.observer.update(sample, 4.0)
    assert window.window.lasting == pytest.approx(0.2**2)
    assert window.spare.velocity == pytest.approx(without.observer.velocity)


@pytest.mark.parametrize(("second", "is_late"), [(0.99, True), (-0.99, True), (1.01, False), (-1.01, False)])
def test_it_was_not_late_where_the_next_one_surprises_as_well(second: float, is_late: bool) -> None:
    """It surprises the model that has not taken the first: then both count, each with its age."""
    window = Window()
    window.show(3.0)
    shown = window.spare.position + second - window.observer.position
    window.show(shown)
    expected = second**2 if is_late else HALF_KEPT * 9.0 + shown**2
    assert window.window.lasting == pytest.approx(min(expected, window.window.total))


def test_no_more_lasts_than_surprises() -> None:
    """The model without the late sample is surprised by 0.9 mm, an accepted plant only by the root of 0.5 mm."""
    window = Window()
    window.show(3.0)
    window.show(window.spare.position + 0.9 - window.observer.position, square=0.5)
    assert window.window.lasting == pytest.approx(0.5)


def test_as_much_as_decides_is_no_late_sample() -> None:
    window = Window()
    window.show(1.0)
    window.show(-window.observer.position)
    assert window.window.lasting == window.window.total


@pytest.mark.parametrize(("square", "is_over"), [(0.0099, True), (0.0101, False)])
def test_it_ends_where_both_have_come_together(square: float, is_over: bool) -> None:
    """At a tenth of 1 mm, squared: from there on what surprises the accepted plants counts again."""
    window = Window()
    window.show(3.0)
    window.show(window.spare.position - window.observer.position, square=square)
    window.show(window.spare.position - window.observer.position, square=0.5)
    assert window.window.lasting == pytest.approx(0.5 if is_over else 0.0)


def test_a_start_forgets_that_a_sample_was_left_out() -> None:
    window = Window()
    window.show(3.0)
    window.window.start(0.0)
    assert window.window.lasting == 0.0
    window.show(0.9)
    assert window.window.lasting == pytest.approx(0.81)


def ticks_until_told(factor: float, period_s: float, late: float, between: int) -> int:
    """Return how many samples of a cruise at 100 mm/s it takes to tell a change that comes so long after a late one.

    Parameters
    ----------
    factor
        What the encoder counts after it.
    period_s
        The tick, in s.
    late
        By how much of a tick the late sample lies behind; 0 for none.
    between
        Samples between it and the change.
    """
    model = PLANT.discretise(period_s)
    observer = DisturbanceObserver(model, kalman_gain(model, NoiseModel()).predictor)
    monitor = ModelMonitor(PLANT, period_s, NoiseModel())
    effort = 100.0 * PLANT.pole / PLANT.gain
    observer.correct(100.0, 0.0)
    monitor.start(observer, effort)
    step = 100.0 * period_s
    shown = 0.0
    for tick in itertools.count():
        changed = tick >= 200 + between
        sample = shown - late * step * (tick == 200 - 1)
        observer.update(sample, effort)
        monitor.update(sample, effort, observer, 0.0)
        if monitor.better_factor is not None:
            assert changed
            assert monitor.better_factor == factor
            return tick - 200 - between
        if tick >= 300 + between:
            break
        shown += step * (factor if changed else 1.0)
    pytest.fail(f"{factor} is not told")


@pytest.mark.parametrize("period_s", [0.002, 0.01, 0.02])
@pytest.mark.parametrize("factor", [-1.0, 0.5, 2.0])
@pytest.mark.parametrize("late", [0.4, 0.75, 1.0])
def test_a_late_sample_hides_no_change_of_the_encoder_after_it(factor: float, period_s: float, late: float) -> None:
    """It is told within two samples of when it is without: the law soon makes a new scale its own."""
    usual = ticks_until_told(factor, period_s, 0.0, 10)
    for between in range(2, 15):
        assert ticks_until_told(factor, period_s, late, between) <= usual + 2, between
