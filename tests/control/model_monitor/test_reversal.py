"""Reversed signs over a short window, by hand: which evidence is enough, and what fades how fast."""

import pytest

from twostage_servo.control.model_monitor.reversal import ReversalWatch
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver
from twostage_servo.control.plant import Plant

LEAST = 0.125
STILL = 4.0


def signs(*innovations: float) -> list[DisturbanceObserver]:
    """Return observers whose latest sample has surprised them by so much, in mm."""
    observers = [DisturbanceObserver(Plant(-180.0, 14.0).discretise(0.01), NO_CORRECTION) for _ in innovations]
    for observer, innovation in zip(observers, innovations, strict=True):
        observer.innovation = innovation
    return observers


def after_one(accepted: float, own: float, still: float = 1e6) -> ReversalWatch:
    """Return what it knows after one sample, with sums of squares in mm²."""
    watch = ReversalWatch(signs(own**0.5, 1e3), 0.01)
    watch.update(accepted, still)
    return watch


@pytest.mark.parametrize(
    ("accepted", "own", "expected"),
    [
        (0.249, 0.0, False),  # less than (4 · 0.125)²
        (0.251, 0.0, True),
        (3.9, 3.9 / 19.9, False),  # twenty times
        (3.9, 3.9 / 20.1, True),
        (3.9, 3.9 / 8.1, False),  # less than (16 · 0.125)²
        (4.1, 4.1 / 7.9, False),  # eight times
        (4.1, 4.1 / 8.1, True),
    ],
)
def test_the_more_it_surprises_the_less_evidence_is_enough(accepted: float, own: float, expected: bool) -> None:
    assert after_one(accepted, own).is_certain(LEAST, STILL) is expected


@pytest.mark.parametrize(("still", "expected"), [(0.399, False), (0.401, True)])
def test_an_encoder_that_stands_still_must_not_explain_as_much(still: float, expected: bool) -> None:
    """A reversed sign leaves 0.1 mm², and has to be four times better."""
    assert after_one(5.0, 0.1, still).is_certain(LEAST, STILL) is expected


@pytest.mark.parametrize("period_s", [0.001, 0.002, 0.01, 0.02])
def test_a_surprise_fades_to_four_fifths_in_ten_ms(period_s: float) -> None:
    """Noise apart, all sums fade alike; so what was 1 mm² for the accepted plants is 0.25 mm² after 62 ms."""
    watch = ReversalWatch(signs(0.0), period_s)
    watch.update(1.0, 1.0)
    ticks_s = 0.0
    while watch.is_certain(LEAST, STILL):
        watch.update(0.0, 0.0)
        ticks_s += period_s
    assert ticks_s == pytest.approx(0.0621, abs=period_s)


def test_it_begins_as_if_all_samples_had_surprised_alike() -> None:
    """With weights of 0.8 the sum of squares of 0.2 mm² each is 1 mm², for the accepted plants and the signs."""
    watch = ReversalWatch(signs(0.0, 0.0), 0.01)
    watch.start(0.2)
    assert watch._accepted_sum == pytest.approx(1.0)
    assert watch._sums == pytest.approx([1.0, 1.0])
    watch.update(5.5, 1e6)
    assert watch._sums == pytest.approx([0.8, 0.8])
    assert not watch.is_certain(LEAST, STILL)  # 0.8 + 5.5 is less than eight times 0.8
    watch.update(0.0, 1e6)
    assert not watch.is_certain(LEAST, STILL)


def test_the_likeliest_is_the_one_that_is_surprised_the_least_of_late() -> None:
    observers = signs(3.0, 0.1)
    watch = ReversalWatch(observers, 0.01)
    watch.update(1.0, 1.0)
    assert watch.likeliest == 1
    observers[0].innovation, observers[1].innovation = 0.0, 3.0
    for _ in range(10):
        watch.update(1.0, 1.0)
    assert watch.likeliest == 0
