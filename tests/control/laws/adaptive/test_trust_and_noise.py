"""When a fit counts for the next moves, and what is noise of an encoder, by hand."""

from math import inf, pi, sin, sqrt
from types import SimpleNamespace
from typing import Any

import pytest

from tests.control.laws.adaptive.test_adaptive_law import task
from twostage_servo.control.laws.adaptive.encoder_noise import EncoderNoise
from twostage_servo.control.laws.adaptive.estimate import ControlEstimate
from twostage_servo.control.laws.adaptive.rules import LearningRules, Rules
from twostage_servo.control.laws.adaptive.trust import Trust
from twostage_servo.control.laws.rejection import Rejection, RejectionCode


def because(code: RejectionCode, *, degrades: bool = True) -> Rejection:
    return Rejection(code, "for a test", degrades=degrades)


FORM, GAIN = because(RejectionCode.FIT_RESIDUAL), because(RejectionCode.GAIN_OUT_OF_BOUNDS)


@pytest.mark.parametrize(
    ("why", "degraded", "has_no_plant"),
    [
        (FORM, True, True),
        (because(RejectionCode.UNEXPLAINED_MOTION), True, True),
        (GAIN, True, False),
        (because(RejectionCode.POLE_OUT_OF_BOUNDS, degrades=False), False, False),
        (because(RejectionCode.FAR_FROM_EXPECTED, degrades=False), False, False),
    ],
)
def test_what_a_rejection_says_of_the_plant(why: Rejection, degraded: bool, has_no_plant: bool) -> None:
    trust = Trust(20)
    assert (trust.is_degraded, trust.has_no_plant, trust.only_watches) == (False, False, False)
    trust.reject(why, 30, watched=False)
    assert trust.rejection == why
    assert (trust.is_degraded, trust.has_no_plant, trust.only_watches) == (degraded, has_no_plant, has_no_plant)


@pytest.mark.parametrize(("samples", "counts"), [(19, True), (20, False), (21, False)])
def test_once_the_form_is_known_to_be_right_a_fit_that_is_poor_says_nothing(samples: int, counts: bool) -> None:
    trust = Trust(20)
    trust.reject(GAIN, samples, watched=False)
    assert trust.counts(FORM) is counts
    assert trust.counts(GAIN)
    trust.reject(GAIN, 0, watched=False)  # fewer samples take nothing back
    assert trust.counts(FORM) is counts
    trust.forget()
    assert trust.counts(FORM)


def test_a_poor_fit_never_shows_that_the_form_is_right() -> None:
    trust = Trust(20)
    trust.reject(FORM, 100, watched=False)
    assert trust.counts(FORM)


def moves_until_accepted(trust: Trust) -> int:
    """Return how many healthy moves it takes until one of them is believed."""
    moves = 1
    while not trust.accept(watched=trust.only_watches):
        moves += 1
        assert moves < 1000
    assert trust.rejection is None
    return moves


def test_each_move_that_no_plant_fits_doubles_what_has_to_fit_after_it_up_to_sixty_four() -> None:
    trust, needed = Trust(20), []
    for _ in range(9):
        trust.reject(FORM, 9, watched=False)
        needed.append(moves_until_accepted(trust))
    assert needed == [1, 2, 4, 8, 16, 32, 32, 32, 32]  # the last of which is controlled by its fit


def test_one_that_was_only_watched_doubles_nothing_and_begins_the_count_anew() -> None:
    trust = Trust(20)
    for _ in range(3):
        trust.reject(FORM, 9, watched=False)
    assert not trust.accept(watched=True)
    trust.reject(FORM, 9, watched=True)
    assert moves_until_accepted(trust) == 4


def test_each_move_that_is_controlled_by_a_fit_takes_one_off_again() -> None:
    trust = Trust(20)
    for _ in range(3):
        trust.reject(FORM, 9, watched=False)
    assert moves_until_accepted(trust) == 4  # 8 until now, 7, 6, 5, 4 and 3 after the next moves
    for _ in range(5):
        assert trust.accept(watched=False)
    trust.reject(FORM, 9, watched=False)
    assert moves_until_accepted(trust) == 3


class Learns:
    """What has been learned in a move that something has disturbed: its rejection, and whether its model is kept."""

    is_known, is_late, active, contradicted = True, False, True, True

    def __init__(self, trust: Trust, *, only_watches: bool) -> None:
        self.trust, self.only_watches = trust, only_watches

    def update(self, *_: object) -> None:
        return None

    def give_up(self) -> bool:
        self.active = False
        return True


@pytest.mark.parametrize("why", [None, FORM, GAIN])
@pytest.mark.parametrize("only_watches", [False, True])
def test_an_estimate_is_misled_where_no_plant_fits_what_it_went_by(why: Rejection | None, only_watches: bool) -> None:
    estimate = ControlEstimate(task(), Rules(), LearningRules(), 0.0, learns=True)
    trust = Trust(20)
    if why is not None:
        trust.reject(why, 5, watched=False)
    estimate.learning = Learns(trust, only_watches=only_watches)  # type: ignore[assignment]
    estimate.update(0.0, 0.0)
    assert estimate.is_misled is (why is FORM and not only_watches)


def noise_of(samples: list[float | None], least: float = 0.0) -> float:
    noise = EncoderNoise(least)
    for sample in samples:
        noise.update(sample)
    return noise.deviation


def test_noise_is_the_root_of_a_sixth_of_the_square_of_second_differences() -> None:
    """+1, -1, +1 mm: second differences of 4 mm, 16/6 mm²; first ones of 2 mm, 4/2 mm². A sample weighs a fiftieth."""
    flips = [1.0 if index % 2 else -1.0 for index in range(100)]
    assert noise_of([*flips[:21]]) == 0.0  # 19 differences are too few
    by_hand = sqrt(16.0 / 6.0 * (1.0 - 0.98**20))
    assert noise_of([*flips[:22]]) == pytest.approx(by_hand)
    assert noise_of([*flips[:22]], least=1.1 * by_hand) == pytest.approx(1.1 * by_hand)
    assert noise_of([*flips[:22]], least=0.9 * by_hand) == pytest.approx(by_hand)


def test_a_sample_that_is_lost_or_another_place_leaves_no_difference() -> None:
    flips = [1.0 if index % 2 else -1.0 for index in range(22)]
    with_gap: list[float | None] = [*flips[:10], None, *(1000.0 + flip for flip in flips[:14])]
    assert noise_of(with_gap) == pytest.approx(noise_of(list(flips)))
    noise = EncoderNoise(0.0)
    for place in (0.0, 1000.0):
        for flip in flips[:12]:
            noise.update(place + flip)
        noise.clear()
    assert noise.deviation == pytest.approx(noise_of(list(flips)))


@pytest.mark.parametrize(("period", "is_noise"), [(3.0, True), (4.0, True), (6.0, False), (10.0, False)])
def test_what_goes_on_from_sample_to_sample_is_a_motion(period: float, is_noise: bool) -> None:
    """A sine of n samples makes 3/(2 sin(pi/n))² times as much of first differences as of second ones: 1, 1.5, 3, 8.

    Its first few samples do not show that yet, and are soon forgotten.
    """
    samples: list[float | None] = [sin(2.0 * pi * index / period) for index in range(200)]
    assert (noise_of(samples) > 0.3) is is_noise
    assert noise_of(samples) > 0.5 or not is_noise
    assert noise_of(samples) < 0.1 or is_noise


def test_the_spread_of_a_sample_is_its_noise_within_what_an_encoder_may_have() -> None:
    """A unit of noise is 0.18 mm here; a spread is 0.0185 of it at least, and thirty times that at most."""
    estimate = ControlEstimate(task(), Rules(), LearningRules(), 0.0, learns=True)
    assert estimate.spread == pytest.approx(0.0185 * 0.18)
    noise: Any = SimpleNamespace(deviation=0.05)
    estimate._noise = noise
    assert estimate.spread == 0.05
    noise.deviation = inf
    assert estimate.spread == pytest.approx(30.0 * 0.0185 * 0.18)
