"""Plants that no gain, pole, load and delay describe: the law notices, says so, and goes on as on an unknown one."""

import random
from dataclasses import replace
from typing import Any

import pytest

from tests.control.laws.adaptive.test_adaptive_law import PERIOD_S, law_of, task
from tools.bench.control_quality.suite import Case, run
from tools.bench.control_quality.true_plant import TrueAxis, TruePlant
from twostage_servo.control.laws.adaptive.acceptance import poor_fit
from twostage_servo.control.laws.adaptive.identification import Acted, Fit, Prior
from twostage_servo.control.laws.adaptive.law import AdaptiveLaw
from twostage_servo.control.laws.adaptive.rules import LearningRules
from twostage_servo.control.laws.rejection import Rejection, RejectionCode

MODEL = TrueAxis(180.0, 14.0, effort_limit=24.0, quantum=0.001)
RINGS = replace(MODEL, resonance_hz=15.0, resonance_damping=0.05)
RINGS_LONG = replace(MODEL, resonance_hz=15.0, resonance_damping=0.02)
LOOSE = replace(MODEL, backlash=0.2)
OF_THE_FORM = {RejectionCode.FIT_RESIDUAL, RejectionCode.UNEXPLAINED_MOTION}


class Driven:
    """A law on an axis, which may become another one."""

    def __init__(self, axis: TrueAxis, *, learns: bool = True) -> None:
        self.law = law_of(task(), learns=learns)
        self.plant = TruePlant(axis, PERIOD_S, 1)
        self.sample = self.plant.sample()
        self.wait(50)

    def becomes(self, axis: TrueAxis) -> None:
        """Go on with another plant, from where the encoder is."""
        plant, place = TruePlant(axis, PERIOD_S, 1), self.plant.position
        self.law.shift(-place)
        self.plant, self.sample = plant, plant.sample()
        self.wait(150)

    def wait(self, ticks: int) -> list[float]:
        positions = []
        for _ in range(ticks):
            effort = self.law.step(self.sample)
            self.sample = self.plant.sample()
            self.plant.advance(effort)
            positions.append(self.plant.position)
        return positions

    def move(self, distance: float, velocity: float) -> float:
        """Move by a distance, with a rest after it; return the overshoot."""
        target = self.law.target + distance
        self.law.set_target(target, velocity)
        positions = self.wait(round((abs(distance) / velocity + 2.0) / PERIOD_S))
        sign = 1.0 if distance > 0.0 else -1.0
        return max(0.0, *(sign * (at - target) for at in positions))

    @property
    def rejection(self) -> Rejection | None:
        return self.law.learned.rejection


def code(driven: Driven) -> RejectionCode | None:
    return None if driven.rejection is None else driven.rejection.code


@pytest.mark.parametrize("axis", [RINGS, RINGS_LONG, LOOSE], ids=["rings", "rings long", "loose"])
@pytest.mark.parametrize(("distance", "velocity"), [(20.0, 100.0), (-50.0, 200.0), (100.0, 100.0), (-400.0, 100.0)])
def test_a_plant_of_another_form_is_rejected_and_overshoots_by_less_than_a_millimetre(
    axis: TrueAxis, distance: float, velocity: float
) -> None:
    driven = Driven(axis)
    assert driven.move(distance, velocity) < 1.0
    assert code(driven) in OF_THE_FORM
    assert driven.rejection is not None
    assert driven.rejection.degrades
    assert not driven.law.learned.is_sure
    assert driven.law.identified is None
    for _ in range(2):
        distance = -distance
        assert driven.move(distance, velocity) < 1.0


@pytest.mark.parametrize("axis", [RINGS, RINGS_LONG], ids=["rings", "rings long"])
def test_once_rejected_its_moves_are_those_of_the_law_that_identifies_nothing(axis: TrueAxis) -> None:
    """A move of either brakes where it may, so the overshoots are compared, and the place at the end."""
    watching, plain = Driven(axis), Driven(axis, learns=False)
    for driven in (watching, plain):
        driven.move(-50.0, 200.0)
    assert code(watching) in OF_THE_FORM
    assert watching.move(50.0, 200.0) == pytest.approx(plain.move(50.0, 200.0), abs=0.25)
    assert watching.plant.position == pytest.approx(plain.plant.position, abs=0.02)
    assert plain.rejection is None


def test_a_pole_that_is_three_times_the_models_is_named_with_its_figure() -> None:
    driven = Driven(replace(MODEL, pole=42.0))
    driven.move(-50.0, 200.0)
    assert code(driven) is RejectionCode.POLE_OUT_OF_BOUNDS
    assert driven.rejection is not None
    assert driven.rejection.degrades
    assert driven.rejection.cause.startswith("the pole of the plant is 3 ± ")
    assert "set axis.plant.pole to what the axis has" in driven.rejection.cause
    assert not driven.law.learned.is_sure


def test_a_plant_that_is_as_its_model_again_is_accepted_again() -> None:
    driven = Driven(RINGS)
    driven.move(-50.0, 200.0)
    assert code(driven) in OF_THE_FORM
    driven.becomes(MODEL)
    for _ in range(2):
        driven.move(100.0, 100.0)
    assert driven.rejection is None
    assert driven.law.learned.is_sure
    assert driven.law.learned.gain == pytest.approx(180.0, rel=0.02)
    assert driven.move(-100.0, 100.0) < 0.02


def test_the_oftener_no_plant_fits_the_longer_it_only_watches() -> None:
    """Counted in healthy moves until one is accepted, after each of the times in which the plant was another one."""
    driven, watched = Driven(MODEL), []
    for _ in range(3):
        driven.becomes(RINGS)
        driven.move(-50.0, 200.0)
        assert code(driven) in OF_THE_FORM
        driven.becomes(MODEL)
        moves = 0
        while driven.rejection is not None:
            driven.move(20.0 if moves % 2 else -20.0, 100.0)
            moves += 1
            assert moves < 20
        watched.append(moves)
    assert watched == [1, 2, 4]


def test_a_rejection_outlasts_what_was_learned() -> None:
    """As after a trip: the next move would be the same nonsense."""
    driven = Driven(RINGS)
    driven.move(-50.0, 200.0)
    why = driven.rejection
    assert why is not None
    driven.law.forget()
    assert driven.rejection == why


def test_a_move_that_is_cut_short_by_forgetting_is_judged_by_what_it_has_shown() -> None:
    driven = Driven(replace(MODEL, pole=42.0))
    driven.law.set_target(-50.0, 200.0)
    driven.wait(14)
    assert driven.law.control_estimate.is_identifying
    driven.law.forget()
    assert code(driven) is RejectionCode.POLE_OUT_OF_BOUNDS


@pytest.mark.parametrize("noise", [0.0, 0.0316])
@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("gain", [0.65, 1.0, 1.5])
@pytest.mark.parametrize("pole", [0.55, 1.0, 1.5])
def test_a_healthy_axis_is_never_rejected_for_its_form(gain: float, pole: float, delay: int, noise: float) -> None:
    """Off its model by up to half, with friction, load, delay, quantum and noise."""
    rng = random.Random(f"{gain} {pole} {delay} {noise}")  # noqa: S311 - a test
    axis = TrueAxis(
        180.0 * gain, 14.0 * pole, rng.uniform(0.0, 0.5), rng.uniform(-1.0, 1.0), delay, 24.0, quantum=0.01, noise=noise
    )
    driven = Driven(axis)
    driven.wait(150)
    for distance in (100.0, -100.0, 20.0):
        driven.move(distance, 100.0)
        assert code(driven) not in OF_THE_FORM


def test_a_load_that_rings_at_rest_is_not_taken_for_noise_of_the_encoder() -> None:
    """15 Hz and 0.05 mm; the same in white noise is."""
    rings, noisy = law_of(task()), law_of(task())
    rng = random.Random(1)  # noqa: S311 - a test
    plant = TruePlant(replace(RINGS_LONG, friction=5.0), PERIOD_S, 1)
    plant.velocity = 5.0  # friction stops the drive at once, and the load swings on
    places = []
    for _ in range(200):
        places.append(plant.sample())
        rings.control_estimate.rest(places[-1])
        noisy.control_estimate.rest(rng.gauss(0.0, 0.05))
        plant.advance(0.0)
    assert noisy.control_estimate.noise == pytest.approx(0.05, rel=0.35)
    assert max(places) - min(places) > 0.08
    assert rings.control_estimate.noise < 0.005


# The test itself ------------------------------------------------------------------------------------------------------


def fits_of(axis: TrueAxis, ticks: int) -> tuple[Fit, Fit]:
    """Return both fits after an acceleration without feedback."""
    plant, rules = TruePlant(axis, PERIOD_S, 3), LearningRules()
    prior = Prior(180.0, 14.0, 0.0, rules.prior_share, rules.prior_share, 1.0)
    soon, late = Fit(prior, 0.00625, PERIOD_S), Fit(prior, 0.00625, PERIOD_S)
    before = 0.0
    for tick in range(ticks):
        effort = min(2.0 * (tick + 1), 12.0)
        plant.advance(effort)
        soon.update(plant.sample(), Acted(effort))
        if tick:
            late.update(plant.sample(), Acted(before))
        before = effort
    return soon, late


@pytest.mark.parametrize("changed", [{}, {"gain": 240.0, "pole": 9.0}, {"delay_ticks": 1}, {"friction": 0.5}])
def test_a_plant_of_the_form_leaves_little(changed: dict[str, Any]) -> None:
    assert poor_fit(fits_of(replace(MODEL, **changed), 25), LearningRules()) is None


@pytest.mark.parametrize("changed", [{"resonance_hz": 15.0}, {"resonance_hz": 8.0}, {"backlash": 0.3}])
def test_one_of_another_form_leaves_more(changed: dict[str, Any]) -> None:
    found = poor_fit(fits_of(replace(MODEL, **changed), 25), LearningRules())
    assert found is not None
    assert found.code is RejectionCode.FIT_RESIDUAL
    assert "positions leave a residual of" in found.cause


def test_too_few_samples_decide_nothing() -> None:
    assert poor_fit(fits_of(RINGS_LONG, 4), LearningRules()) is None


def test_over_the_suites_moves_it_is_accepted_as_ever() -> None:
    law = law_of(task())
    run(law, Case(replace(MODEL, gain=225.0, pole=11.0, friction=0.3), 100.0, 100.0, 1), 2)
    assert isinstance(law, AdaptiveLaw)
    assert (law.learned.moves, law.learned.is_sure, law.learned.rejection) == (2, True, None)
