"""What follows from the tuned numbers for one axis or another, by hand; and small decisions of the law."""

import cmath
from types import SimpleNamespace
from typing import Any

import pytest

from tests.control.laws.adaptive.test_adaptive_law import Rig, task
from twostage_servo.control.laws.adaptive.course import Course
from twostage_servo.control.laws.adaptive.identification import Acted
from twostage_servo.control.laws.adaptive.law import AdaptiveLaw
from twostage_servo.control.laws.adaptive.learning import Learning
from twostage_servo.control.laws.adaptive.placement import Pair, Poles
from twostage_servo.control.laws.adaptive.rules import (
    NOISY_POLES,
    QUIET_POLES,
    LearningRules,
    encoder_poles,
    is_noisy,
    loop_period_s,
    noise_unit,
)
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.plant import Plant


@pytest.mark.parametrize(
    ("rate", "period_s"),
    [(1000.0, 0.01), (480.0, 0.01), (400.0, 0.012), (320.0, 0.015), (120.0, 0.04)],  # 24 V in five ticks: 480 V/s
)
def test_the_loops_are_made_for_a_tick_in_five_of_which_the_effort_can_go_to_its_limit(
    rate: float, period_s: float
) -> None:
    assert loop_period_s(task(rate=rate)) == pytest.approx(period_s)


@pytest.mark.parametrize(
    ("rate", "unit"), [(1000.0, 0.18), (320.0, 180.0 * 4.8 * 0.015**2), (1e6, 180.0 * 24.0 * 1e-4)]
)
def test_noise_is_measured_by_what_the_efforts_largest_change_moves_in_a_tick(rate: float, unit: float) -> None:
    """180 mm/(V s²), 10 V in a tick of 10 ms; 4.8 V in one of 15 ms; all 24 V where the rate is no limit."""
    made = task(rate=rate)
    assert noise_unit(made) == pytest.approx(unit)
    assert not is_noisy(made, 0.0399 * unit)
    assert is_noisy(made, 0.0401 * unit)


@pytest.mark.parametrize(("noise", "poles"), [(0.0, QUIET_POLES), (1.0, NOISY_POLES)])
@pytest.mark.parametrize(("rate", "ticks"), [(1000.0, 1.0), (480.0, 1.0), (400.0, 1.2), (320.0, 1.5), (120.0, 4.0)])
def test_the_poles_are_those_of_the_noise_and_die_down_by_as_many_ticks_later(
    noise: float, poles: Poles, rate: float, ticks: float
) -> None:
    found = encoder_poles(task(rate=rate), noise)
    assert found.single == pytest.approx(poles.single ** (1.0 / ticks))
    for pair, quick in ((found.observer, poles.observer), (found.feedback, poles.feedback)):
        radius, angle = polar(quick)
        assert polar(pair) == pytest.approx((radius ** (1.0 / ticks), angle / ticks))


def polar(pair: Pair) -> tuple[float, float]:
    """Return magnitude and angle of a pair of complex poles."""
    pole = complex(pair.real, pair.square**0.5)
    return cmath.polar(pole)


@pytest.mark.parametrize(
    ("velocity", "cruise", "stands"),
    [
        (2.5, 1.0, True),  # at rest, as every stop has it
        (2.6, 1.0, False),
        (-2.6, 1.0, False),
        (49.0, 100.0, True),  # half of what is asked for
        (-51.0, 100.0, False),
    ],
)
def test_an_axis_stands_beside_how_fast_it_is_to_be(velocity: float, cruise: float, stands: bool) -> None:
    law: Any = SimpleNamespace(_estimate=SimpleNamespace(velocity=velocity), _rest_velocity=2.5)
    assert AdaptiveLaw._stands(law, cruise) is stands


def test_the_effort_is_held_back_until_a_sample_shows_motion_and_no_longer() -> None:
    """Three spreads of a sample; without a sample that shows it, 150 ms."""
    rig = Rig(task()).ticks(30)
    rig.law.set_target(400.0, 100.0)
    departure = rig.law._departure
    held = 0
    while departure.is_held and held < 100:
        rig.ticks(1)
        held += 1
    assert 0 < held < 8
    assert abs(rig.sample or 0.0) > 3.0 * rig.law._estimate.spread


@pytest.mark.parametrize("velocity", [0.0, 2.4, -2.4])
def test_a_move_from_rest_begins_with_a_reference_at_rest(velocity: float) -> None:
    """What the estimate shows of an axis at rest is noise."""
    law = Rig(task()).ticks(30).law
    law.control_estimate.velocity = velocity
    law.set_target(400.0, 100.0)
    assert (law.course.speed, law.course.direction, law.stage) == (0.0, 1.0, Stage.SPEED)
    law.set_target(-400.0, 100.0)
    assert law.course.direction == -1.0


def learning(ticks: int, *, surprise: float = 50.0) -> Learning:
    """Return what has looked at a move for so many ticks, and meets a sample that neither fit expects."""
    made = Learning(Plant(180.0, 14.0), LearningRules(surprise=surprise), 0.01, 24.0)
    made.begin(1.0, 0.0, 0.01)
    for _ in range(ticks):
        made.update(0.0, Acted(0.0), Acted(0.0))
    return made


@pytest.mark.parametrize(("ticks", "ends"), [(3, False), (4, False), (5, False), (6, True), (9, True)])
def test_two_surprises_in_a_row_end_identification_from_the_sixth_tick_on(ticks: int, ends: bool) -> None:
    """The first sample of a move is tick 0; before the sixth a fit goes by its prior most of all."""
    made = learning(ticks)
    for position in (8.0, -8.0):
        made.update(position, Acted(0.0), Acted(0.0))
    assert made.contradicted is ends


@pytest.mark.parametrize(
    ("rules", "moves", "gap", "knows"),
    [
        (LearningRules(), 0, 2.9, False),
        (LearningRules(), 0, 3.0, True),
        (LearningRules(), 1, 0.0, True),  # former moves have shown it
        (LearningRules(finds_delay=False), 0, 0.0, True),  # there is none to know
    ],
)
def test_the_delay_is_known_by_a_gap_or_by_former_moves(
    rules: LearningRules, moves: int, gap: float, knows: bool
) -> None:
    made = Learning(Plant(180.0, 14.0), rules, 0.01, 24.0)
    made.moves = moves
    assert made._knows_delay(gap) is knows


def test_a_course_counts_from_another_origin_with_all_that_it_has() -> None:
    course = Course(400.0, 30.0, speed=7.0)
    course.shift(-5.0)
    assert (course.target, course.position, course.speed) == (395.0, 25.0, 7.0)
    copied = course.copied_to(26.0)
    assert (copied.target, copied.position, copied.speed, course.position) == (395.0, 26.0, 7.0, 25.0)
