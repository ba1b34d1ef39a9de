"""Efforts that begin to act late, and samples of another instant: what the fits and the loops make of them."""

from itertools import pairwise
from random import Random

import pytest

from tests.control.laws.adaptive.test_adaptive_law import Rig, law_of, task
from twostage_servo.control.laws.adaptive.identification import Acted, Fit, Prior
from twostage_servo.control.laws.timing import Timing
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01
TRUE = Plant(216.0, 11.0)
PRIOR = Prior(180.0, 14.0, 0.0, 0.17, 0.17, 0.46)


def advanced(position: float, velocity: float, effort: float, duration_s: float) -> tuple[float, float]:
    part = TRUE.discretise(duration_s) if duration_s > 0.0 else None
    if part is None:
        return position, velocity
    return position + part.a12 * velocity + part.b1 * effort, part.a22 * velocity + part.b2 * effort


def fitted(*, counts_way: bool, seed: int = 1) -> Fit:
    """Return a fit of 30 ticks, each of whose efforts begins to act late by another share of it."""
    chance = Random(seed)  # noqa: S311 - not for secrets
    fit, position, velocity = Fit(PRIOR, 1e-4, PERIOD_S), 0.0, 0.0
    efforts = [0.0, *(10.0 if index % 4 < 2 else 4.0 for index in range(30))]
    for before, effort in pairwise(efforts):
        share = chance.uniform(0.0, 0.9)
        position, velocity = advanced(position, velocity, before, share * PERIOD_S)
        position, velocity = advanced(position, velocity, effort, (1.0 - share) * PERIOD_S)
        more = share * (1.0 - share) * (before - effort)
        fit.update(position, Acted(effort + share * (before - effort), more if counts_way else 0.0))
    return fit


def test_an_effort_that_changes_within_a_tick_is_integrated_exactly() -> None:
    fit = fitted(counts_way=True)
    assert (fit.gain, fit.pole) == pytest.approx((TRUE.gain, TRUE.pole), rel=5e-3)
    assert fit.residual / fit.freedom < 2.0


def test_by_its_mean_alone_the_way_is_wrong() -> None:
    """The speed is the same, and the way of each tick is off by up to a quarter of what the speed makes of it."""
    fit = fitted(counts_way=False)
    assert fit.residual / fit.freedom > 100.0


def test_a_sample_of_an_uncertain_date_is_believed_by_less_and_leaves_nothing_behind() -> None:
    """One of 20 is 0.3 mm off. Told that its date may be off by 3 ms, the fit is not surprised by it."""
    surprises = []
    for error_s in (3e-3, 0.0):
        fit, position, velocity = Fit(PRIOR, 1e-4, PERIOD_S), 0.0, 0.0
        for index in range(20):
            position, velocity = advanced(position, velocity, 8.0, PERIOD_S)
            wrong = index == 10
            fit.update(position + 0.3 * wrong, Acted(8.0), error_s if wrong else 0.0)
        surprises.append(fit.residual)
    assert surprises[0] < 300.0
    assert surprises[1] > 1e5


def test_a_fit_that_is_told_of_no_date_error_has_the_sample_in_its_integral() -> None:
    """Otherwise what it makes of its samples would go into what it makes of them."""
    fit, other = Fit(PRIOR, 1e-4, PERIOD_S), Fit(PRIOR, 1e-4, PERIOD_S)
    for made, error_s in ((fit, 0.0), (other, 1e-12)):
        for index in range(5):
            made.update(0.1 * index, Acted(8.0), error_s)
    assert (fit.gain, fit.pole, fit.position) == pytest.approx((other.gain, other.pole, other.position), rel=1e-9)


@pytest.mark.parametrize(
    ("late_share", "lag_s", "is_slow"),
    [(0.09, 0.0, False), (0.11, 0.0, True), (0.0, 0.0011, True), (0.0, -0.0011, True), (0.0, 0.0009, False)],
)
def test_what_is_untimely_takes_slower_gains(late_share: float, lag_s: float, *, is_slow: bool) -> None:
    """As long as more than a tenth of a tick is within some hundred ticks: 0.11 has become less after 20 of them."""
    rig = Rig(task())
    rig.law.set_target(100.0, 100.0)
    rig.ticks(300)
    assert rig.law.learned.is_sure
    quick = rig.law.control_estimate.model.feedback
    rig.law.tell_timing(Timing(0.0, late_share, lag_s))
    rig.ticks(1)
    assert (rig.law.control_estimate.model.feedback != quick) is is_slow
    unknown = law_of(task()).control_estimate.model.feedback
    assert (rig.law.control_estimate.model.feedback[0] < 2.0 * unknown[0]) is is_slow
    assert rig.law.control_estimate.model.feedback[0] > unknown[0]
    rig.ticks(25)
    rig.law.set_target(0.0, 100.0)
    assert rig.law.control_estimate.model.feedback[0] > 2.0 * unknown[0]


def test_the_effort_that_has_acted_is_what_the_observers_go_by() -> None:
    """Of 4 V that began to act after 0.3 of the tick, and 1 V before: 3.1 V. It counts for one step."""
    law, other = law_of(task()), law_of(task())
    for one in (law, other):
        one.start(4.0)
    law.tell_timing(Timing(3.1 - 4.0, 0.3))
    other.effort = 3.1
    law.step(0.0)
    other.step(0.0)
    assert law.observer.position == other.observer.position
    assert law.observer.velocity == other.observer.velocity
    before, after = law.effort, law.observer.velocity
    law.step(None)
    assert law.observer.velocity == pytest.approx(
        law.observer.plant.a22 * after + law.observer.plant.b2 * (before + law.observer.disturbance)
    )


def test_a_missed_tick_takes_it_too() -> None:
    law = law_of(task())
    law.start(4.0)
    law.tell_timing(Timing(3.1 - 4.0, 0.3))
    law.skip(2)
    plant = law.observer.plant
    assert law.observer.velocity == pytest.approx(plant.a22 * plant.b2 * 3.1 + plant.b2 * 4.0)


def test_what_was_added_to_a_sample_for_its_age_shows_no_motion() -> None:
    """An axis that is stuck is not pushed on because its samples are brought to another instant by the estimate."""
    pushed = []
    for dating in (0.0, 0.5):
        law = law_of(task())
        law.start()
        law.set_target(100.0, 100.0)
        efforts = []
        for _ in range(12):
            law.tell_timing(Timing(lag_s=1e-4, dating=dating))
            efforts.append(law.step(dating))
        pushed.append(max(map(abs, efforts[6:])))
    assert pushed[1] < 1.2 * pushed[0]
