"""When what a move has shown is kept, and what is known then, case by case."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from tests.control.laws.adaptive.test_adaptive_law import Rig, task
from twostage_servo.control.laws.adaptive.departure import Departure
from twostage_servo.control.laws.adaptive.identification import Acted
from twostage_servo.control.laws.adaptive.learning import Learning
from twostage_servo.control.laws.adaptive.rules import LearningRules
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.rejection import Rejection, RejectionCode
from twostage_servo.control.plant import Plant

CONFIGURED = Plant(180.0, 14.0)
OUT_OF_BOUNDS = Rejection(RejectionCode.GAIN_OUT_OF_BOUNDS, "for a test", degrades=True)


def under_way(*, ticks: int, gain_share: float, gain: float = 200.0) -> Learning:
    """Return what has looked at a move for so many ticks, and has found a gain to a share of it."""
    made = Learning(CONFIGURED, LearningRules(), 0.01, 24.0)
    made.begin(1.0, 0.0, 0.01)
    fit: Any = SimpleNamespace(
        samples=ticks, gain=gain, pole=14.0, load=0.4, gain_share=gain_share, pole_share=0.02, misfit=0.0, evidence=0.0,
        surprise=0.0, residual=0.0, freedom=1,
    )  # fmt: skip
    late: Any = SimpleNamespace(**{**vars(fit), "evidence": 50.0})
    made._fits, made._later, made._ticks = (fit, late), late, ticks
    return made


@pytest.mark.parametrize(
    ("ticks", "gain_share", "gain", "goes_on"),
    [
        (10, 0.059, 200.0, True),
        (9, 0.059, 200.0, False),  # too early
        (10, 0.061, 200.0, False),  # not known well enough
        (10, 0.02, 1000.0, False),  # a gain that no plant has
    ],
)
def test_a_move_that_is_given_up_goes_on_with_its_model_only_if_that_is_known_well(
    ticks: int, gain_share: float, gain: float, goes_on: bool
) -> None:
    made = under_way(ticks=ticks, gain_share=gain_share, gain=gain)
    assert made.give_up() is goes_on
    assert not made.active
    assert (made.believed, made.moves, made.loads) == (CONFIGURED, 0, {})
    assert (made.trust.rejection is not None) is (gain > 300.0)


@pytest.mark.parametrize(
    ("ticks", "gain_share", "believed", "known"),
    [(4, 0.02, False, False), (5, 0.02, True, True), (30, 0.079, True, True), (30, 0.081, True, False)],
)
def test_a_move_that_ends_is_believed_from_five_ticks_on_and_known_from_eight_hundredths(
    ticks: int, gain_share: float, believed: bool, known: bool
) -> None:
    made = under_way(ticks=ticks, gain_share=gain_share)
    assert made.finish() is believed
    assert made.is_known is known
    assert (made.identified is not None) is known
    assert made.moves == int(believed)
    assert (made.believed.gain, made.loads) == ((200.0, {1.0: 0.4}) if believed else (180.0, {}))


def test_what_is_known_counts_no_more_once_a_move_has_spoken_against_it() -> None:
    made, known = under_way(ticks=30, gain_share=0.02), []
    made.finish()
    known.append((made.is_known, made.identified))
    made.trust.reject(OUT_OF_BOUNDS, 5, watched=False)
    known.append((made.is_known, made.identified))
    assert known == [(True, made.believed), (False, None)]


@pytest.mark.parametrize(("velocity", "speed"), [(30.0, 30.0), (0.4, 0.4), (-20.0, 0.0)])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_move_that_leaves_an_obstacle_goes_on_at_the_speed_that_it_has_then(
    direction: float, velocity: float, speed: float
) -> None:
    model = SimpleNamespace(plant=CONFIGURED)
    estimate: Any = SimpleNamespace(position=0.0, velocity=direction * velocity, spread=0.1, model=model)
    departure = Departure(estimate, 0.01, 0.01)
    departure.set_out(5.0, leaves_obstacle=True)
    course: Any = SimpleNamespace(direction=direction, speed=0.0)
    assert departure.release(course, 5.0 + direction * 0.29, direction * -24.0, 24.0) == pytest.approx(
        direction * (-24.0 + 0.48)
    )
    leaves = [departure.leaves_obstacle]
    departure.release(course, 5.0 + direction * 0.31, 0.0, 24.0)
    leaves.append(departure.leaves_obstacle)
    assert (leaves, course.speed) == ([True, False], speed)


def test_a_stop_that_is_over_leaves_the_velocity_of_its_move() -> None:
    """It is what the status shows, and what the next move begins with where it names none."""
    law = Rig(task()).ticks(30).law
    law.set_target(400.0, 90.0)
    for _ in range(40):
        law.step(None)
    law.stop(2000.0)
    while law.stage is Stage.BRAKE:
        law.step(None)
    assert law.cruise_velocity == 90.0
    assert law.target == law.course.position
    assert law.changeovers == 1


@pytest.mark.parametrize(
    ("moves", "known", "gap", "late"),
    [
        (0, 0.0, -2.6, False),  # a first move has to show more than 2.701
        (0, 0.0, -2.8, True),
        (0, -100.0, -2.6, False),  # and nothing else counts in it
        (1, 5.0, -4.9, False),  # a later one goes on with the evidence of those before
        (1, 5.0, -5.1, True),
        (1, -5.0, 4.9, True),
        (1, -5.0, 5.1, False),
    ],
)
def test_which_delay_is_likelier(moves: int, known: float, gap: float, late: bool) -> None:
    """By the evidence for each, twice the negative logarithm of its likelihood: the late fit's less the other one's."""
    made = under_way(ticks=10, gain_share=0.02)
    soon, after = made._fits
    shown: dict[str, Any] = {"update": lambda *_: None, "position": 1.0, "velocity": 2.0}
    vars(soon).update(shown, evidence=0.0)
    vars(after).update(shown, evidence=gap)
    made.moves, made._delay_evidence = moves, known
    found = made.update(1.0, Acted(3.0), Acted(3.0))
    assert found is not None
    assert made.is_late is late


def test_a_move_shows_something_from_the_sample_after_that_in_which_a_first_effort_has_acted() -> None:
    made = Learning(CONFIGURED, LearningRules(), 0.01, 24.0)
    made.begin(1.0, 0.0, 0.01)
    found = [made.update(sample, Acted(1.0), Acted(1.0)) for sample in (0.0, 0.0, 0.009, 0.034)]
    assert [one is None for one in found] == [True, True, True, False]


@pytest.mark.parametrize(("finds_delay", "evidence"), [(True, 50.0), (False, 0.0)])
def test_a_law_that_does_not_look_for_a_delay_learns_nothing_of_it(finds_delay: bool, evidence: float) -> None:
    made = under_way(ticks=30, gain_share=0.02)
    made._rules = replace(LearningRules(), finds_delay=finds_delay)
    assert made.finish()
    assert made.learned.delay_evidence == evidence


@pytest.mark.parametrize("degrades", [True, False])
def test_a_move_with_a_poor_fit_goes_on_with_its_model_unless_the_law_is_to_degrade(degrades: bool) -> None:
    made = under_way(ticks=20, gain_share=0.02)
    made._poor_fit = replace(OUT_OF_BOUNDS, degrades=degrades)
    assert made.give_up() is not degrades


@pytest.mark.parametrize(("watched", "disturbance"), [(True, -3.5), (False, 0.0)])
def test_a_plant_that_was_only_watched_is_taken_on_with_the_acceleration_that_there_was(
    watched: bool, disturbance: float
) -> None:
    """A cruise at 90 mm/s takes 7 V of 180 mm/s² each, and of twice that half: 3.5 V are over."""
    made = task()
    estimate = Rig(made).law.control_estimate
    estimate._efforts = (7.0, 7.0, 7.0)
    estimate.observer.go_on_from(10.0, 90.0, 0.0)
    found: Any = SimpleNamespace(
        only_watches=watched, finish=lambda: True, believed=Plant(360.0, 14.0), is_known=True, is_late=False
    )
    estimate.learning = found
    estimate.finish()
    assert estimate.model.plant.gain == 360.0
    assert estimate.disturbance == pytest.approx(disturbance)
