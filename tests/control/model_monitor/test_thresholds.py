"""When the tests of the model decide, at their documented thresholds on either side, and what they start from."""

import pytest

from twostage_servo.control.model_monitor.hypotheses import ACCEPTED, OTHER_GAINS
from twostage_servo.control.model_monitor.monitor import ModelMonitor
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01
PLANT = Plant(180.0, 14.0)
MODEL = PLANT.discretise(PERIOD_S)
NOISE = NoiseModel()
"""Its standard deviation is 0.1 mm, so a surprise of 0.125 mm is what it takes at rest."""


def at_rest(velocity: float = 0.0) -> DisturbanceObserver:
    model = DisturbanceObserver(MODEL, kalman_gain(MODEL, NOISE).predictor)
    model.velocity = velocity
    return model


def unexplained(shares: dict[float, float], surprise: float = 1.0) -> list[float]:
    """Return the sums of the other gains, of which one leaves a share of the surprise unexplained, and the rest all."""
    return [shares.get(other.factor, 1.0) * surprise**2 for other in OTHER_GAINS]


def verdict(surprise: float, shares: dict[float, float]) -> float | None:
    """Return what is told of a surprise, and of the share of it that another gain leaves unexplained."""
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.surprise, test._still_sum = surprise, 1e9
    test._window.total = test._window._lasting = surprise**2
    test._is_lasting = True
    test._sums = unexplained(shares, surprise)
    return test.better_factor


@pytest.mark.parametrize(
    ("surprise", "shares", "expected"),
    [
        (0.1249, {-1.0: 0.0}, None),
        (0.1251, {-1.0: 0.0}, -1.0),
        (0.1249, {0.45: 0.0}, None),
        (0.1251, {0.45: 0.0}, 0.45),
        (0.1251, {0.5: 0.0}, 0.5),
        (0.1251, {2.0: 0.0}, 2.0),
        (0.1251, {2.2: 0.0}, 2.2),
    ],
)
def test_a_surprise_of_one_and_a_quarter_standard_deviations_decides(
    surprise: float, shares: dict[float, float], expected: float | None
) -> None:
    assert verdict(surprise, shares) == expected


@pytest.mark.parametrize(
    ("shares", "expected"),
    [
        ({-1.0: 1 / 7.9}, None),
        ({-1.0: 1 / 8.1}, -1.0),
        ({0.45: 1 / 4.9}, None),
        ({0.45: 1 / 5.1}, 0.45),
        ({0.5: 1 / 29.0}, None),
        ({0.5: 1 / 31.0}, 0.5),
        ({2.0: 1 / 7.9}, None),
        ({2.0: 1 / 8.1}, 2.0),
        ({2.2: 1 / 4.9}, None),
        ({2.2: 1 / 5.1}, 2.2),
    ],
)
def test_a_sign_and_twice_the_scale_have_to_be_eight_times_better_half_of_it_thirty_and_what_is_beyond_five(
    shares: dict[float, float], expected: float | None
) -> None:
    assert verdict(2.0, shares) == expected


def test_one_sample_decides_nothing() -> None:
    """Where the window has only just begun, whatever a spike happens to fit would be told. It comes back."""
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.start(at_rest(40.0))
    for surprised, told in ((False, None), (True, None), (True, -1.0)):
        test.update(test._gains[0].position, 24.0, at_rest(40.0), 0.0)
        assert (test.surprise > test.least) is surprised
        assert test.better_factor == told


def test_what_an_encoder_that_stands_still_explains_as_well_is_no_other_gain() -> None:
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.surprise, test._sums = 1.0, unexplained({0.45: 0.01})
    test._window.total = test._window._lasting = 1.0
    test._is_lasting = True
    for still, told in ((0.0399, None), (0.0401, 0.45)):
        test._still_sum = still
        assert test.better_factor == told


def test_dates_that_may_be_off_hide_a_quarter_of_what_they_may_at_the_speed_of_late() -> None:
    """3 ms at 100 mm/s are 0.3 mm; 0.075 mm of them are added to the 0.125 mm of the noise."""
    test = ModelMonitor(PLANT, PERIOD_S, NOISE, date_error_s=0.003)
    test.update(0.0, 0.0, at_rest(), 100.0)
    assert test._least == pytest.approx(0.2)


def test_unless_told_otherwise_dates_are_right_at_any_speed() -> None:
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.update(0.0, 0.0, at_rest(), 100.0)
    assert test._least == pytest.approx(0.125)


def test_the_noise_that_is_assumed_is_the_only_scale_at_rest() -> None:
    quiet = ModelMonitor(PLANT, PERIOD_S, NoiseModel(measurement_variance=1e-6))
    assert quiet._least == pytest.approx(1.25e-3)


def test_it_begins_without_evidence_for_anything() -> None:
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    assert test.surprise == 0.0
    assert test.is_sure
    assert test.better_factor is None


def test_a_start_in_a_motion_that_still_surprises_the_model_is_no_evidence() -> None:
    """A steady innovation e hides a wrong velocity: it counts as if it had been there for long, e²/(1 - 0.93)."""
    model = at_rest(100.0)
    model.innovation = 0.2
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.start(model)
    assert test.surprise == pytest.approx((0.2**2 / 0.07) ** 0.5)
    assert test.better_factor is None


def test_the_sums_are_those_of_the_best_accepted_plant_and_of_each_other_gain() -> None:
    """By hand, with observers of their own, from a tenth of the process variances."""
    slow = NoiseModel((0.01, 0.01, 0.01), NOISE.measurement_variance)

    def observer(gain: float, pole: float) -> DisturbanceObserver:
        sampled = Plant(gain * PLANT.gain, pole * PLANT.pole).discretise(PERIOD_S)
        return DisturbanceObserver(sampled, kalman_gain(sampled, slow).predictor)

    accepted = [(observer(gain, pole), delay) for gain, pole, delay in ACCEPTED]
    gains = [observer(factor * plant.gain, plant.pole) for factor, plant, _ in OTHER_GAINS]
    test, model = ModelMonitor(PLANT, PERIOD_S, NOISE), at_rest()
    total, sums, before = 0.0, [0.0] * len(gains), 0.0
    still_sum = last = 0.0
    for n in range(12):
        sample, effort = 0.03 * n * n, 1.0 + n
        model.update(sample, effort)
        test.update(sample, effort, model, 0.0)
        for one, delay in accepted:
            one.update(sample, before if delay else effort)
        total = 0.93 * total + min(one.innovation**2 for one, _ in accepted)
        for index, one in enumerate(gains):
            one.update(sample, effort)
            sums[index] = 0.93 * sums[index] + one.innovation**2
        still_sum = 0.93 * still_sum + (sample - last) ** 2
        before, last = effort, sample
    assert test._still_sum == pytest.approx(still_sum)
    assert test.surprise == pytest.approx(total**0.5)
    assert test._sums == pytest.approx(sums)


def changed(test: ModelMonitor, factor: float) -> object:
    return next(change for change in test._changes if change.factor == factor)


@pytest.mark.parametrize(
    ("ticks", "accepted", "own", "background", "certain"),
    [
        (3, 1.0, 0.019, 1.1, True),
        (2, 1.0, 0.019, 1.0, False),  # two samples are a spike and what follows it
        (3, 1.0, 0.021, 1.0, False),  # not fifty times better
        (3, 0.015, 0.0, 0.015, False),  # less than the noise
        (3, 0.016, 0.0, 0.016, True),
        (3, 1.0, 0.0, 1.12, False),  # the model had been surprised before
    ],
)
def test_what_makes_a_change_certain(ticks: int, accepted: float, own: float, background: float, certain: bool) -> None:
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.start(at_rest(100.0))
    change = changed(test, -1.0)
    change.ticks, change.accepted_sum, change.own_sum = ticks, accepted, own  # type: ignore[attr-defined]
    assert change.is_certain(0.125, background, 0.0) is certain  # type: ignore[attr-defined]


@pytest.mark.parametrize(("velocity", "certain"), [(3.3, False), (3.4, True)])
def test_a_change_has_to_show_in_its_first_sample(velocity: float, certain: bool) -> None:
    """2 a12 v, where half of 0.125 mm is needed: a12 is 9.33 ms."""
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.start(at_rest(velocity))
    change = changed(test, -1.0)
    change.ticks, change.accepted_sum = 3, 1.0  # type: ignore[attr-defined]
    assert change.is_certain(0.125, 1.0, 0.0) is certain  # type: ignore[attr-defined]


def test_a_change_is_expected_anew_where_it_explains_no_more_than_an_accepted_plant() -> None:
    test, model = ModelMonitor(PLANT, PERIOD_S, NOISE), at_rest()
    for _ in range(5):
        model.update(0.0, 0.0)
        test.update(0.0, 0.0, model, 0.0)
    assert {change.ticks for change in test._changes} == {0}


def test_the_hypotheses_forget_a_disturbance_as_the_noise_model_says() -> None:
    noise = NoiseModel(disturbance_memory=0.5)
    slow = NoiseModel((0.01, 0.01, 0.01), noise.measurement_variance, 0.5)
    test, model = ModelMonitor(PLANT, PERIOD_S, noise), at_rest()
    doubled_plant = Plant(2.2 * 180.0, 14.0).discretise(PERIOD_S)
    other = DisturbanceObserver(doubled_plant, kalman_gain(doubled_plant, slow).predictor, 0.5)
    expected = 0.0
    for n in range(20):
        model.update(0.1 * n, 1.0)
        test.update(0.1 * n, 1.0, model, 0.0)
        other.update(0.1 * n, 1.0)
        expected = 0.93 * expected + other.innovation**2
    assert test._sums[-1] == pytest.approx(expected, rel=1e-12)
