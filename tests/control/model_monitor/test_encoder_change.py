"""One hypothesis that the encoder has changed: which samples it expects, and when it is certain; by hand.

An axis of gain 180 and pole 14 in 1/s is at 10 mm, runs at 50 mm/s, unless another speed is given, and is pushed by
2 V. A hypothesis that expects exactly the samples that come is surprised by nothing: its sum stays at zero.
"""

import pytest

from twostage_servo.control.model_monitor.encoder_change import EncoderChange
from twostage_servo.control.model_monitor.hypotheses import ACCEPTED, Deviation, deviating, slow_observer
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

PLANT = Plant(180.0, 14.0)
NOISE = NoiseModel()
MODEL = ACCEPTED.index(Deviation(1.0, 1.0))
STRONG = ACCEPTED.index(Deviation(1.3, 0.7))
EFFORTS = [6.0, 1.0, -3.0, 8.0, 4.0, -9.0]
NEVER = float("inf")
LEAST = 0.125
"""The surprise below which nothing is decided, in mm."""


def estimate(velocity: float = 50.0, deviation: Deviation = ACCEPTED[0], period_s: float = 0.01) -> DisturbanceObserver:
    """Return what is known of the axis, as the free model of a plant that goes on from there."""
    free = DisturbanceObserver(deviating(PLANT, deviation).discretise(period_s), NO_CORRECTION)
    free.position, free.velocity, free.disturbance = 10.0, velocity, 2.0
    return free


def change(factor: float, origin: DisturbanceObserver, plant: int = MODEL, period_s: float = 0.01) -> EncoderChange:
    """Return a change of an accepted plant that comes with the next sample."""
    one = EncoderChange(factor, ACCEPTED[plant], PLANT, period_s, NOISE)
    one.begin(origin)
    return one


def show(
    one: EncoderChange,
    sample: float,
    effort: float,
    lag_s: float = 0.0,
    *,
    origin: DisturbanceObserver | None = None,
    square: float = 1.0,
    opens: float = NEVER,
    noise: float = 0.0,
) -> None:
    """Give it a sample that surprises the accepted plants by 1 mm, unless another square is given."""
    one.update(sample, effort, lag_s, origin or estimate(), square, opens, LEAST, noise)


@pytest.mark.parametrize("period_s", [0.002, 0.01, 0.02])
@pytest.mark.parametrize("plant", [MODEL, STRONG])
@pytest.mark.parametrize("lag_s", [0.0, 0.004])
@pytest.mark.parametrize("factor", [-1.0, 0.0, 0.5, 2.0])
def test_an_encoder_that_has_changed_in_the_period_before_surprises_its_hypothesis_by_nothing(
    factor: float, lag_s: float, plant: int, period_s: float
) -> None:
    """It shows f times the way since, that of the first period too, a12 v; an older sample shows what was then."""
    truth = estimate(50.0, ACCEPTED[plant], period_s)
    one = change(factor, truth, plant, period_s)
    begun_at, a12 = truth.position, truth.plant.a12
    first = begun_at - (1.0 - factor) * a12 * 50.0
    kept = 0.93 ** (period_s / 0.01)
    accepted = 0.0
    for ticks, effort in enumerate(EFFORTS, start=1):
        shown = first + factor * (truth.position - begun_at)
        show(one, shown - factor * truth.velocity * lag_s, effort, lag_s)
        truth.predict(effort)
        accepted = kept * accepted + 1.0
        assert one.own_sum == pytest.approx(0.0, abs=1e-18)
        assert one.accepted_sum == pytest.approx(accepted)
        assert one.evidence() == pytest.approx(accepted)
        assert one.ticks == ticks
        assert one.reckon().velocity == pytest.approx(truth.velocity)


@pytest.mark.parametrize("plant", [MODEL, STRONG])
@pytest.mark.parametrize("factor", [-1.0, 0.0, 2.0])
def test_neither_a_missing_sample_nor_another_origin_surprises_it(factor: float, plant: int) -> None:
    truth = estimate(50.0, ACCEPTED[plant])
    one = change(factor, truth, plant)
    begun_at, first = truth.position, truth.position - (1.0 - factor) * truth.plant.a12 * 50.0
    for tick, effort in enumerate(EFFORTS):
        if tick == 3:
            one.predict(effort)
        else:
            show(one, first + factor * (truth.position - begun_at), effort)
        truth.predict(effort)
        if tick == 1:
            one.shift(300.0)
            first += 300.0
        assert one.own_sum == pytest.approx(0.0, abs=1e-18)
        assert one.reckon().velocity == pytest.approx(truth.velocity)
    assert one.ticks == 5  # a sample that is missing explains nothing


@pytest.mark.parametrize("factor", [-1.0, 2.0])
def test_it_follows_its_samples_as_slowly_as_every_hypothesis(factor: float) -> None:
    """A step of 0.3 mm in what is shown, weighed by hand with an observer of the scaled plant."""
    truth = estimate()
    one = change(factor, truth)
    by_hand = slow_observer(Plant(factor * 180.0, 14.0), 0.01, NOISE)
    by_hand.continue_from(truth)
    by_hand.position -= (1.0 - factor) * truth.plant.a12 * 50.0
    by_hand.velocity = factor * 50.0
    total = 0.0
    for effort in EFFORTS:
        sample = by_hand.position + 0.3
        show(one, sample, effort)
        by_hand.update(sample, effort)
        total = 0.93 * total + 0.3**2
        assert one.own_sum == pytest.approx(total)


@pytest.mark.parametrize("lag_s", [0.0, 0.004])
def test_an_encoder_that_stands_still_is_followed_by_the_gain_for_a_place_off_by_noise(lag_s: float) -> None:
    """Whatever it shows, it has no speed, so that older samples show the same."""
    truth = estimate()
    one = change(0.0, truth)
    shown = truth.position - truth.plant.a12 * 50.0 + 0.3
    for _ in range(2):
        show(one, shown, 5.0, lag_s)
    left = 0.3 * (1.0 - kalman_gain(truth.plant, NOISE).current[0])
    assert one.own_sum == pytest.approx(0.93 * 0.3**2 + left**2)


@pytest.mark.parametrize("plant", [MODEL, STRONG])
def test_where_it_explains_no_more_it_begins_anew_from_the_estimate_of_its_plant(plant: int) -> None:
    one = change(2.0, estimate(), plant)
    expected = 10.0 + estimate(50.0, ACCEPTED[plant]).plant.a12 * 50.0
    show(one, expected + 0.5, 6.0, origin=estimate(70.0), square=0.26)
    assert one.ticks == 1  # a square of 0.25 is less than 0.26
    show(one, -40.0, 6.0, origin=estimate(90.0), square=0.26)
    assert (one.ticks, one.own_sum, one.accepted_sum) == (0, 0.0, 0.0)
    assert one.reckon().velocity == 90.0
    friction = 14.0 / 180.0 * (1.0 - ACCEPTED[plant].pole / ACCEPTED[plant].gain)
    assert one.reckon().disturbance == pytest.approx(2.0 + friction * 90.0)


def test_a_change_is_at_rest_until_it_begins() -> None:
    one = EncoderChange(0.5, ACCEPTED[STRONG], PLANT, 0.01, NOISE)
    assert (one.factor, one.ticks, one.own_sum, one.accepted_sum) == (0.5, 0, 0.0, 0.0)
    assert one.reckon() == (0.0, 0.0)


def first_sample(
    factor: float, velocity: float, share: float, *, period_s: float = 0.01, lag_s: float = 0.0, square: float = 1.0
) -> EncoderChange:
    """Return a change whose first sample shows all but a share of it; a square above 0.9 lets it be a part.

    A change shows (1 - f) a12 v in its first sample, of a period of 10 ms or of a longer one.
    """
    truth = estimate(velocity, period_s=period_s)
    one = change(factor, truth, period_s=period_s)
    jump = (1.0 - factor) * PLANT.discretise(max(0.01, period_s)).a12 * velocity
    expected = 10.0 - (1.0 - factor) * truth.plant.a12 * velocity
    sample = expected + share * jump - factor * velocity * lag_s
    show(one, sample, 0.0, lag_s, square=square, opens=0.9)
    return one


def is_certain_after(one: EncoderChange, ticks: int) -> bool:
    """Whether so many samples are enough where nothing else is wanting."""
    one.ticks, one.accepted_sum, one.own_sum = ticks, 1.0, 0.0
    return one.is_certain(LEAST, 1.0, 0.0)


@pytest.mark.parametrize("period_s", [0.002, 0.01, 0.02])
@pytest.mark.parametrize("velocity", [50.0, -50.0])
@pytest.mark.parametrize("lag_s", [0.0, 0.004])
@pytest.mark.parametrize("factor", [-1.0, 0.5, 2.0])
@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_a_first_sample_may_show_any_part_of_a_change_which_then_has_to_explain_six(
    period_s: float, velocity: float, lag_s: float, factor: float, share: float
) -> None:
    one = first_sample(factor, velocity, share, period_s=period_s, lag_s=lag_s)
    assert one.own_sum == pytest.approx(0.0, abs=1e-18)
    assert not is_certain_after(one, 5)
    assert is_certain_after(one, 6)


@pytest.mark.parametrize(
    ("factor", "velocity", "share", "square"),
    [
        (-1.0, 50.0, -0.05, 1.0),  # more than the whole
        (-1.0, 50.0, 1.05, 1.0),  # the other way
        (2.0, -50.0, 1.05, 1.0),
        (-1.0, -50.0, -0.05, 1.0),
        (-1.0, 50.0, 0.5, 0.8),  # no accepted plant is surprised enough
    ],
)
def test_what_is_no_part_of_a_change_is_left_as_it_is(
    factor: float, velocity: float, share: float, square: float
) -> None:
    one = first_sample(factor, velocity, share, square=square)
    missed = share * (1.0 - factor) * PLANT.discretise(0.01).a12 * velocity
    assert one.own_sum == pytest.approx(missed**2)
    assert not is_certain_after(one, 2)
    assert is_certain_after(one, 3)


def test_an_encoder_that_stands_still_shows_no_part_of_it() -> None:
    one = first_sample(0.0, 50.0, 0.5)
    assert one.own_sum == pytest.approx((0.5 * PLANT.discretise(0.01).a12 * 50.0) ** 2)
    assert not is_certain_after(one, 4)
    assert is_certain_after(one, 5)


def test_a_second_sample_shows_no_part_of_a_change() -> None:
    truth = estimate()
    one = change(-1.0, truth)
    show(one, 10.0 - 2.0 * truth.plant.a12 * 50.0, 0.0, opens=0.9)
    truth.predict(0.0)
    mirrored = 10.0 - 2.0 * estimate().plant.a12 * 50.0 - (truth.position - 10.0)
    show(one, mirrored + 0.2, 0.0, opens=0.9)
    assert one.own_sum == pytest.approx(0.2**2)
    assert is_certain_after(one, 3)


def test_a_change_that_begins_anew_has_shown_no_part() -> None:
    one = first_sample(-1.0, 50.0, 0.5)
    one.begin(estimate())
    assert is_certain_after(one, 3)


@pytest.mark.parametrize("period_s", [0.002, 0.01, 0.02])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("factor", "needed"), [(-1.0, 0.25), (0.0, 1.0), (0.5, 1.0), (2.0, 0.5)])
def test_a_scale_has_to_jump_by_half_of_the_surprise_that_decides_and_a_standing_encoder_by_all_of_it(
    factor: float, needed: float, sign: float, period_s: float
) -> None:
    """At v the jump is ``|1 - f| a12 v`` with the a12 of 10 ms, or of a longer tick; 0.125 mm is what decides."""
    velocity = sign * needed * LEAST / PLANT.discretise(max(0.01, period_s)).a12
    ticks = 4 if factor else 25
    assert not is_certain_after(change(factor, estimate(0.999 * velocity), period_s=period_s), ticks)
    assert is_certain_after(change(factor, estimate(1.001 * velocity), period_s=period_s), ticks)


@pytest.mark.parametrize(("factor", "expected"), [(-1.0, True), (0.0, False), (0.5, False), (2.0, False)])
@pytest.mark.parametrize(("period_s", "ticks"), [(0.002, 25), (0.01, 5), (0.02, 5)])
def test_an_encoder_that_turns_round_at_standstill_is_told_by_fifty_ms_and_five_samples_and_no_other(
    factor: float, expected: bool, period_s: float, ticks: int
) -> None:
    assert not is_certain_after(change(factor, estimate(0.0), period_s=period_s), ticks - 1)
    assert is_certain_after(change(factor, estimate(0.0), period_s=period_s), ticks) is expected


@pytest.mark.parametrize(("accepted", "expected"), [(0.249, False), (0.251, True)])
def test_at_standstill_it_takes_four_times_the_surprise_that_decides(accepted: float, expected: bool) -> None:
    """Squared, as the sum is: (4 · 0.125 mm)² = 0.25 mm². A change that jumps takes (0.125 mm)²."""
    at_rest, moving = change(-1.0, estimate(0.0)), change(-1.0, estimate(50.0))
    at_rest.ticks = moving.ticks = 5
    at_rest.accepted_sum = moving.accepted_sum = accepted
    assert at_rest.is_certain(LEAST, accepted, 0.0) is expected
    assert moving.is_certain(LEAST, accepted, 0.0)


@pytest.mark.parametrize(("factor", "patience"), [(-1.0, 3.0), (0.5, 0.0), (2.0, 0.0)])
def test_an_encoder_that_turns_round_may_explain_a_little_less_for_a_while_and_then_has_to_be_answered(
    factor: float, patience: float
) -> None:
    """By three times (0.125 mm)²; it is certain again after 50 ms, and five samples, whatever has jumped."""

    def after(less: float) -> EncoderChange:
        one = change(factor, estimate(50.0))
        expected = 10.0 - (1.0 - factor) * estimate().plant.a12 * 50.0
        show(one, expected, 0.0)
        one.own_sum, one.accepted_sum = 0.5, 0.5 - less / 0.93
        show(one, one._observer.position, 0.0, square=0.0)
        return one

    if patience:
        in_doubt = after(0.99 * patience * LEAST**2)
        assert in_doubt.ticks == 2
        assert not is_certain_after(in_doubt, 4)
        assert is_certain_after(in_doubt, 5)
        in_doubt.begin(estimate(50.0))
        assert is_certain_after(in_doubt, 3)
    assert after(1.01 * patience * LEAST**2).ticks == 0
    assert after(-1e-9).ticks == 2


@pytest.mark.parametrize(("period_s", "ticks"), [(0.002, 25), (0.01, 5), (0.02, 5)])
def test_an_encoder_that_stands_still_has_to_explain_fifty_ms_and_five_samples(period_s: float, ticks: int) -> None:
    assert not is_certain_after(change(0.0, estimate(100.0), period_s=period_s), ticks - 1)
    assert is_certain_after(change(0.0, estimate(100.0), period_s=period_s), ticks)


def test_the_jump_is_that_of_the_plant_that_it_begins_from() -> None:
    """With a pole of 0.7 times 14 in 1/s an axis keeps more of its speed: a12 is 9.53 ms, the model's is 9.33 ms."""
    for velocity, expected in ((3.29, True), (3.27, False)):
        assert is_certain_after(change(-1.0, estimate(velocity), STRONG), 4) is expected
        assert is_certain_after(change(-1.0, estimate(velocity)), 4) is False


@pytest.mark.parametrize(
    ("factor", "own", "noise", "expected"),
    [
        (-1.0, 0.0199, 0.0, True),  # fifty times smaller
        (-1.0, 0.0201, 0.0, False),
        (-1.0, 0.0478, 0.01, True),  # in three samples the noise makes 0.01 (1 + 0.93 + 0.93²), that is 0.02795, of it
        (-1.0, 0.0481, 0.01, False),
        (0.5, 0.0478, 0.01, True),  # half a scale leaves the noise as it is
        (0.5, 0.0481, 0.01, False),
        (2.0, 0.0757, 0.005, True),  # twice the scale makes four times of it: 0.0559
        (2.0, 0.0760, 0.005, False),
        (-1.0, 0.1249, 0.05, True),  # eight times smaller however much the noise explains
        (-1.0, 0.1251, 0.05, False),
    ],
)
def test_a_change_has_to_be_fifty_times_better_but_for_the_noise_and_eight_times_with_it(
    factor: float, own: float, noise: float, expected: bool
) -> None:
    one = change(factor, estimate())
    one.ticks, one.accepted_sum, one.own_sum = 3, 1.0, own
    assert one.explains(0.125, 1.0, noise) is expected
    assert one.is_certain(0.125, 1.0, noise) is expected


@pytest.mark.parametrize(("own", "expected"), [(0.00012, True), (0.00013, False)])
def test_it_has_to_explain_as_much_as_decides_more_than_the_accepted_plants(own: float, expected: bool) -> None:
    """0.125² is 0.015625."""
    one = change(-1.0, estimate())
    one.ticks, one.accepted_sum, one.own_sum = 3, 0.01575, own
    assert one.explains(0.125, 0.01575, 0.0) is expected


@pytest.mark.parametrize(("factor", "scaled"), [(-1.0, 1.0), (0.5, 1.0), (2.0, 4.0)])
@pytest.mark.parametrize(("share", "expected"), [(0.99, False), (1.01, True)])
def test_a_change_has_to_surprise_by_eight_times_the_noise_that_there_was_before_it(
    factor: float, scaled: float, share: float, expected: bool
) -> None:
    """In three samples 0.01 (1 + 0.93 + 0.93²), four times of it on twice the scale; what comes later is its own."""
    one = change(factor, estimate())
    show(one, 10.0 - (1.0 - factor) * estimate().plant.a12 * 50.0, 0.0, noise=0.01)
    show(one, one._observer.position, 0.0, noise=9.0)
    one.ticks, one.own_sum, one.accepted_sum = 3, 0.0, share * 8.0 * scaled * 0.01 * (1.0 + 0.93 + 0.93**2)
    assert one.explains(0.125, one.accepted_sum, 0.0) is expected
    one.begin(estimate())
    one.ticks, one.accepted_sum = 3, 0.1
    assert one.explains(0.125, 0.1, 0.0)


@pytest.mark.parametrize(("window", "expected"), [(1.111, True), (1.112, False)])
def test_nine_tenths_of_all_surprise_have_to_have_come_since(window: float, expected: bool) -> None:
    one = change(-1.0, estimate())
    one.ticks, one.accepted_sum = 3, 1.0
    assert one.explains(0.125, window, 0.0) is expected


def test_on_a_short_tick_the_noise_of_more_samples_counts() -> None:
    """At 2 ms four samples weigh 1 + q + q² + q³ with q = 0.93^0.2: 0.03914 of 0.01 each."""
    one = change(-1.0, estimate(period_s=0.002), period_s=0.002)
    one.ticks, one.accepted_sum = 4, 1.0
    for own, expected in ((0.0590, True), (0.0593, False)):
        one.own_sum = own
        assert one.explains(0.125, 1.0, 0.01) is expected


@pytest.mark.parametrize("lag_s", [0.0, 0.004, 0.009])
@pytest.mark.parametrize("factor", [-1.0, 0.5, 2.0])
def test_an_older_sample_of_a_changed_encoder_begins_the_hypothesis_however_little_it_surprises_the_model(
    factor: float, lag_s: float
) -> None:
    """Dated by f times the speed it is where the hypothesis has it: 10 mm - (1 - f) a12 v, and f v lag before that."""
    one = change(factor, estimate())
    shown = 10.0 - (1.0 - factor) * PLANT.discretise(0.01).a12 * 50.0
    show(one, shown - factor * 50.0 * lag_s, 2.0, lag_s, square=1e-6)
    assert one.ticks == 1
    begun_anew = change(factor, estimate())
    show(begun_anew, shown - factor * 50.0 * lag_s + 0.002, 2.0, lag_s, square=1e-6)
    assert begun_anew.ticks == 0
