"""What the test of the model gives each hypothesis of a tick, and which one it chooses: by hand, on either side."""

import itertools

import pytest

from tests.control.model_monitor.test_thresholds import NOISE, PERIOD_S, PLANT, at_rest
from twostage_servo.control.model_monitor.encoder_change import EncoderChange
from twostage_servo.control.model_monitor.hypotheses import (
    ACCEPTED,
    CHANGE_FACTORS,
    CHANGE_PLANTS,
    OTHER_GAINS,
    deviating,
    slow_observer,
)
from twostage_servo.control.model_monitor.monitor import ModelMonitor
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver

EFFORTS = [4.0, 9.0, 9.0, -3.0, 8.0, 1.0, 7.0, 6.0, -5.0, 9.0, 2.0, 3.0]


def samples(gain: float, pole: float) -> list[float]:
    """Return where an axis is at each effort that has 10 mm, 30 mm/s and a load of 1 V to begin with."""
    axis = DisturbanceObserver(
        deviating(PLANT, ACCEPTED[0]._replace(gain=gain, pole=pole)).discretise(PERIOD_S), NO_CORRECTION
    )
    axis.position, axis.velocity, axis.disturbance = 10.0, 30.0, -1.0
    found = []
    for effort in EFFORTS:
        found.append(axis.position)
        axis.predict(effort)
    return found


def moving() -> DisturbanceObserver:
    """Return the estimate of the model for such an axis."""
    model = at_rest(30.0)
    model.position, model.disturbance = 10.0, -1.0
    return model


class ByHand:
    """The hypotheses, each given its tick by hand, and their sums.

    Each observer dates a sample by its own velocity, and a delayed plant gets the effort of the tick before.
    """

    def __init__(self, model: DisturbanceObserver) -> None:
        self.model = model
        self.accepted = [slow_observer(deviating(PLANT, one), PERIOD_S, NOISE) for one in ACCEPTED]
        self.gains = [slow_observer(deviating(PLANT, gain.plant, gain.factor), PERIOD_S, NOISE) for gain in OTHER_GAINS]
        self.plants = [0, 0, 0, 0, *(plant for plant in range(1, 6) for _ in range(3))]
        factors = [*CHANGE_FACTORS, *[-1.0, 0.5, 2.0] * 5]
        self.changes = [
            EncoderChange(factor, ACCEPTED[plant], PLANT, PERIOD_S, NOISE)
            for factor, plant in zip(factors, self.plants, strict=True)
        ]
        for observer in (*self.accepted, *self.gains):
            observer.continue_from(model)
        for change in self.changes:
            change.begin(model)
        self.sums = [0.0] * len(self.gains)
        self.least_square = self.total = self.noise = 0.0

    def _with_efforts(self, effort: float, before: float) -> list[tuple[DisturbanceObserver, float]]:
        late = [before if one.is_delayed else effort for one in ACCEPTED]
        return [*zip(self.accepted, late, strict=True), *((observer, effort) for observer in self.gains)]

    def predict(self, effort: float, before: float) -> None:
        self.model.predict(effort)
        for observer, acting in self._with_efforts(effort, before):
            observer.predict(acting)
        for change in self.changes:
            change.predict(effort)

    def update(self, shown: float, effort: float, before: float, lag_s: float, opens: float, least: float) -> None:
        for observer, acting in self._with_efforts(effort, before):
            observer.update(shown + observer.velocity * lag_s, acting)
        self.least_square = min(observer.innovation**2 for observer in self.accepted)
        self.total = 0.93 * self.total + self.least_square
        self.sums = [0.93 * old + one.innovation**2 for old, one in zip(self.sums, self.gains, strict=True)]
        for change, plant in zip(self.changes, self.plants, strict=True):
            origin = self.accepted[plant] if plant else self.model
            change.update(shown, effort, lag_s, origin, self.least_square, opens, least, self.noise)

    def shift(self, distance: float) -> None:
        for observer in (self.model, *self.accepted, *self.gains):
            observer.position += distance
        for change in self.changes:
            change.shift(distance)

    def compare(self, test: ModelMonitor) -> None:
        assert test.surprise == pytest.approx(self.total**0.5)
        assert test._sums == pytest.approx(self.sums)
        for one, by_hand in zip(test._changes, self.changes, strict=True):
            assert (one.factor, one.ticks) == (by_hand.factor, by_hand.ticks)
            assert (one.own_sum, one.accepted_sum) == pytest.approx((by_hand.own_sum, by_hand.accepted_sum))
            assert one.reckon() == pytest.approx(by_hand.reckon())


@pytest.mark.parametrize("gain_and_pole", [(1.0, 1.0), (1.3, 0.7), (2.0, 1.0)])
@pytest.mark.parametrize("missing", [None, 4])
@pytest.mark.parametrize("distance", [0.0, 500.0])
@pytest.mark.parametrize("lag_s", [0.0, 0.004])
def test_every_hypothesis_gets_every_tick(
    gain_and_pole: tuple[float, float], missing: int | None, distance: float, lag_s: float
) -> None:
    """From a start in motion, under an effort of 6 V; one sample may be missing, and the origin changes after six."""
    test, model = ModelMonitor(PLANT, PERIOD_S, NOISE, date_error_s=0.004), moving()
    test.start(model, 6.0)
    by_hand, origin = ByHand(model), 0.0
    ticks = zip(samples(*gain_and_pole), itertools.pairwise([6.0, *EFFORTS]), strict=True)
    for n, (sample, (before, effort)) in enumerate(ticks):
        if n == missing:
            by_hand.predict(effort, before)
            test.predict(effort)
        else:
            shown = sample + origin + 0.02 * (n % 3)
            model.update(shown + model.velocity * lag_s, effort)
            test.update(shown, effort, model, 50.0, lag_s)
            least = 0.125 + 0.25 * 0.004 * 50.0
            opens = max(9.0 * test._noise_square, (0.4 * least) ** 2)
            by_hand.update(shown, effort, before, lag_s, opens, least)
            by_hand.noise = test._noise_square
            assert test.is_sure is (by_hand.least_square <= 0.175**2)
        by_hand.compare(test)
        if n == 5:
            origin = distance
            by_hand.shift(distance)
            test.shift(distance)


def test_an_encoder_that_stands_still_is_told_by_its_own_steps_from_where_it_was() -> None:
    """Steps of 1 mm, 2 mm and, over a new origin, of 3 mm."""
    test, model = ModelMonitor(PLANT, PERIOD_S, NOISE), moving()
    test.start(model)
    by_hand = 0.0
    for sample, step in ((11.0, 1.0), (13.0, 2.0)):
        test.update(sample, 0.0, model, 0.0)
        by_hand = 0.93 * by_hand + step**2
        assert test._still_sum == pytest.approx(by_hand)
    test.shift(100.0)
    test.update(116.0, 0.0, model, 0.0)
    assert test._still_sum == pytest.approx(0.93 * by_hand + 9.0)
    test.start(model)
    assert test._still_sum == 0.0


def test_the_noise_is_half_the_squared_difference_of_two_innovations_a_hundredth_each() -> None:
    """Innovations of 0.02, -0.04 and 0 mm differ by 0.02, 0.06 and 0.04 mm."""
    test, model = ModelMonitor(PLANT, PERIOD_S, NOISE), at_rest()
    by_hand = 0.0
    for innovation, difference in ((0.02, 0.02), (-0.04, 0.06), (0.0, 0.04)):
        model.innovation = innovation
        test.update(0.0, 0.0, model, 0.0)
        by_hand = 0.99 * by_hand + 0.01 * 0.5 * difference**2
        assert test._noise_square == pytest.approx(by_hand)


def test_a_surprise_is_not_measured_as_noise_but_the_next_sample_is_compared_with_it() -> None:
    test, model = ModelMonitor(PLANT, PERIOD_S, NOISE), at_rest()
    model.innovation = 3.0
    test.update(3.0, 0.0, model, 0.0)
    assert (test.is_sure, test._noise_square) == (False, 0.0)
    test.is_sure = True
    test._measure_noise(3.1)
    assert test._noise_square == pytest.approx(0.01 * 0.5 * 0.1**2)


@pytest.mark.parametrize(("noise", "opens"), [(0.0, 0.0025), (0.00027, 0.0025), (0.0004, 0.0036)])
def test_a_part_of_a_change_shows_from_three_deviations_of_the_noise_and_from_two_fifths_of_what_decides(
    noise: float, opens: float
) -> None:
    """0.4 of 0.125 mm is 0.05 mm."""
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test._noise_square = noise
    assert test._opening_square() == pytest.approx(opens)


def test_a_change_is_supposed_of_each_accepted_plant_whose_effort_is_not_late() -> None:
    assert [ACCEPTED[plant].is_delayed for plant in CHANGE_PLANTS] == [False] * 6
    assert all(plant.is_delayed for plant in ACCEPTED[6:])


def with_changes(**evidence: tuple[float, ...]) -> ModelMonitor:
    """Return a test at 100 mm/s whose changes have come to so much, of each plant that they are supposed of.

    Parameters
    ----------
    evidence
        Sums of the accepted plants since the change, by a name of its factor; it leaves nothing unexplained itself.
    """
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.start(at_rest(100.0))
    factors = {"turned": -1.0, "standing": 0.0, "half": 0.5, "twice": 2.0}
    for name, sums in evidence.items():
        found = [change for change in test._changes if change.factor == factors[name]]
        for change, total in zip(found, sums, strict=False):
            change.ticks, change.accepted_sum = 5, total
    test.surprise, test._still_sum = 1.0, 1e9
    test._window.total = test._window._lasting = 1.0
    test._is_lasting = True
    test._sums = [1.0] * len(OTHER_GAINS)
    return test


@pytest.mark.parametrize(
    ("evidence", "told"),
    [
        ({"turned": (1.0, 0.0)}, -1.0),
        ({"turned": (0.0, 1.0)}, -1.0),
        ({"twice": (0.91, 1.0), "half": (0.95, 0.0)}, 2.0),
        ({"standing": (1.0,), "turned": (0.95, 0.95)}, 0.0),
        ({"standing": (0.95,), "turned": (0.92, 0.96)}, -1.0),
        ({"half": (0.89, 0.5)}, None),  # a tenth of the surprise came before
    ],
)
def test_the_change_that_explains_most_is_told(evidence: dict[str, tuple[float, ...]], told: float | None) -> None:
    test = with_changes(**evidence)
    assert test.better_factor == told
    assert test.seems_to_stand is (told == 0.0)


@pytest.mark.parametrize(
    ("ticks", "own", "accepted", "told"),
    [
        (6, 1.66e-3, 0.5, 0.5),
        (5, 1.66e-3, 0.5, None),
        (6, 1.67e-3, 0.5, None),
        (6, 0.0, 0.142, 0.5),
        (6, 0.0, 0.140, None),
    ],
)
def test_a_change_that_is_300_times_better_in_six_samples_needs_no_estimate_that_was_right_before(
    ticks: int, own: float, accepted: float, told: float | None
) -> None:
    """And three times the surprise below which nothing is decided: 0.375 mm, or 0.1406 mm² of evidence."""
    test = with_changes(half=(accepted,))
    change = next(change for change in test._changes if change.factor == 0.5)
    change.ticks, change.own_sum = ticks, own
    assert test.better_factor == told


def test_a_change_of_the_encoder_comes_before_another_gain_and_needs_more_surprise_than_the_noise() -> None:
    test = with_changes(turned=(1.0, 0.0))
    test._sums[-1] = 0.0
    told = [test.better_factor]
    test.surprise = 0.1249
    told.append(test.better_factor)
    test = with_changes(turned=(0.5, 0.0))
    test._sums[-1] = 0.0
    assert [*told, test.better_factor] == [-1.0, None, 2.2]


@pytest.mark.parametrize(
    ("least", "noise", "own", "expected"),
    [
        (0.125, 0.0, 0.019, True),
        (0.125, 0.0, 0.021, False),
        (0.125, 0.01, 0.021, True),
        (1.01, 0.0, 0.0, False),
    ],
)
def test_it_seems_to_stand_by_the_evidence_for_a_change_however_slow_it_was(
    least: float, noise: float, own: float, expected: bool
) -> None:
    """From rest on nothing jumps, so nothing is told."""
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.start(at_rest())
    change = next(change for change in test._changes if change.factor == 0.0)
    change.ticks, change.accepted_sum, change.own_sum = 1, 1.0, own
    test.surprise, test._least, test._noise_square = 1.0, least, noise
    test._window.total = test._window._lasting = 1.0
    assert test.seems_to_stand is expected
    assert test.better_factor is None


def test_it_does_not_seem_to_stand_where_most_of_the_surprise_came_before() -> None:
    test = with_changes(standing=(1.0,))
    test._window._lasting = 1.12
    assert not test.seems_to_stand


def begin_apart(test: ModelMonitor) -> None:
    """Let each change begin from a speed of its own: 100 mm/s, 200 mm/s, and so on."""
    for number, change in enumerate(test._changes, start=1):
        kept = change.ticks, change.accepted_sum
        change.begin(at_rest(100.0 * number))
        change.ticks, change.accepted_sum = kept


@pytest.mark.parametrize(
    ("evidence", "left", "factor", "velocity"),
    [
        ({"turned": (1.0, 1.0)}, (0.0, 0.0), -1.0, 100.0),
        ({"turned": (1.0, 1.0)}, (0.0156, 0.0), -1.0, 100.0),  # 0.125 mm, squared, tells nothing apart
        ({"turned": (1.0, 1.0)}, (0.0157, 0.0), -1.0, 500.0),
        ({"turned": (1.0, 1.0, 1.0)}, (0.018, 0.017, 0.016), -1.0, 800.0),
        ({"turned": (0.5, 1.0)}, (0.0, 0.0), -1.0, 500.0),  # the first is not certain
        ({"standing": (0.0,)}, (0.0,), 0.0, 200.0),  # as it is, certain or not
        ({"half": (0.95, 0.0), "twice": (1.0, 1.0)}, (0.0, 0.0), 0.5, 300.0),
        ({"half": (0.0, 0.95), "twice": (1.0, 1.0)}, (0.0, 0.0), 0.5, 600.0),
        ({"half": (0.0, 0.0, 0.96), "twice": (1.0, 1.0)}, (0.0, 0.0, 0.0), 0.5, 900.0),
        ({"twice": (0.5, 1.0)}, (0.0, 0.0), 2.0, 700.0),
    ],
)
def test_what_is_reckoned_is_that_of_the_first_certain_change_that_explains_as_much_as_can_be_told(
    evidence: dict[str, tuple[float, ...]], left: tuple[float, ...], factor: float, velocity: float
) -> None:
    """Those of the model are -1, 0, 0.5 and 2, those of each other plant -1, 0.5 and 2."""
    test = with_changes(**evidence)
    begin_apart(test)
    of_factor = [change for change in test._changes if change.factor == factor]
    for change, own in zip(of_factor, left, strict=False):
        change.own_sum = own
    assert test.reckon(factor).velocity == velocity


@pytest.mark.parametrize(
    ("least", "factor", "velocity", "disturbance"),
    [
        (0, -1.0, -110.0, 0.0),
        (1, -1.0, -111.0 / 1.3, 1.0),  # on the plant with 30 % more gain
        (2, -1.0, -112.0 / 0.7, 2.0),
        (3, 0.3, 113.0 / 0.3, 3.0),
        (4, 0.45, 114.0 / 0.45, 4.0),
        (5, 0.5, 230.0, 5.0),
        (6, 2.0, 58.0, 6.0),
        (7, 2.2, 117.0 / 2.2, 7.0),
    ],
)
def test_with_another_gain_the_speed_that_is_reckoned_is_that_of_the_model_which_the_same_effort_brings_to_rest(
    least: int, factor: float, velocity: float, disturbance: float
) -> None:
    """The hypotheses show 110, 111, ... mm/s and 0, 1, ... V; the one with the smallest sum of that factor counts."""
    test = with_changes()
    for number, observer in enumerate(test._gains):
        observer.velocity, observer.disturbance = 110.0 + number, float(number)
    test._sums = [1.0 if other.factor == factor else 0.01 for other in OTHER_GAINS]
    test._sums[least] = 0.5
    assert test.reckon(factor) == pytest.approx((velocity, disturbance))


def test_a_start_brings_the_effort_that_has_acted_to_the_plants_whose_effort_is_late() -> None:
    """In a steady cruise at 90 mm/s, that is 7 V: the model with a later effort is surprised no more than the model."""
    model = at_rest(90.0)
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.start(model, 7.0)
    for _ in range(5):
        test.update(model.position, 7.0, model, 0.0)
        model.predict(7.0)
    for index in (0, 6):
        observer, _ = test._accepted[index]
        assert observer.velocity == pytest.approx(90.0, abs=1e-9)
    assert model.velocity == pytest.approx(90.0)


def test_a_start_without_an_effort_is_one_at_which_none_has_acted() -> None:
    test, model = ModelMonitor(PLANT, PERIOD_S, NOISE), at_rest()
    test.start(model)
    for _ in range(5):
        test.update(0.0, 0.0, model, 0.0)
    assert {observer.innovation for observer, _ in test._accepted} == {0.0}


@pytest.mark.parametrize(("sample", "is_sure"), [(0.124, True), (0.126, False), (-0.126, False)])
def test_it_is_sure_while_an_accepted_plant_is_surprised_by_no_more_than_what_decides(
    sample: float, is_sure: bool
) -> None:
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    test.update(sample, 0.0, at_rest(), 0.0)
    assert test.is_sure is is_sure


@pytest.mark.parametrize(("surprise", "best"), [(4.0, 1), (0.0, 2)])
def test_a_sign_that_a_short_window_has_told_is_reckoned_by_that_window(surprise: float, best: int) -> None:
    """There the second of the three signs explains the samples best, over the whole window the third one."""
    test = with_changes()
    for number, observer in enumerate(test._gains):
        observer.velocity = 110.0 + number
    test._sums = [0.9, 0.8, 0.1, *[1.0] * 5]
    watch = test._reversal
    watch._sums, watch._accepted_sum, watch._still_sum = [0.02, 0.001, 0.03], surprise, 1e9
    expected = (110.0 + best) / (-OTHER_GAINS[best].plant.gain)
    assert test.reckon(-1.0).velocity == pytest.approx(expected)


def test_the_reversal_watch_compares_the_gains_of_the_wrong_sign() -> None:
    test = ModelMonitor(PLANT, PERIOD_S, NOISE)
    wrong = [index for index, other in enumerate(OTHER_GAINS) if other.factor < 0.0]
    assert len(wrong) >= 2
    assert [id(one) for one in test._reversal._observers] == [id(test._gains[index]) for index in wrong]
