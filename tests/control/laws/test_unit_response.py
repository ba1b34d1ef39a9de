"""The response of the paper's law that durations follow from, against sums that can be had by hand."""

from itertools import pairwise

import pytest

from twostage_servo.control.baselines.transcription import TranscribedLaw
from twostage_servo.control.laws.paper_design import UnitResponse
from twostage_servo.control.optimal import servo_gains
from twostage_servo.control.plant import Plant

PLANTS = [Plant(180.0, 14.0), Plant(-180.0, 14.0), Plant(25.0, 3.0)]


def response(plant: Plant, period_s: float, ratio: float = 5e-5) -> UnitResponse:
    sampled = plant.discretise(period_s)
    return UnitResponse(servo_gains(sampled, ratio), sampled, period_s)


@pytest.mark.parametrize("period_s", [0.002, 0.01])
@pytest.mark.parametrize("plant", PLANTS)
def test_a_cruise_runs_behind_its_reference_by_what_the_sum_has_to_hold(plant: Plant, period_s: float) -> None:
    """In a cruise at 1 the effort is a/b, the sum I = f12 + a/b, and it has come from f22 times the sum of 1 - x2.

    A tick goes ``(T - c) x2(k) + c x2(k+1)`` with c = b1/b2: T for each tick at 1, and c less for the rise; and the
    first effort acts a tick after the set-point.
    """
    sampled = plant.discretise(period_s)
    gains = servo_gains(sampled, 5e-5)
    deficit = (gains.f12 + plant.pole / plant.gain) / gains.f22
    expected = period_s * (deficit + 1.0) - sampled.b1 / sampled.b2
    assert response(plant, period_s).lag_s == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("plant", PLANTS[::2])
def test_what_is_left_from_each_tick_on_is_that_of_the_law_in_matrices(plant: Plant) -> None:
    """A move of 1 within the change-over distance: the errors that are still to come, the largest of them."""
    period_s = 0.01
    made, sampled = response(plant, period_s), plant.discretise(period_s)
    law = TranscribedLaw(sampled, 5e-5, 0.01)
    law.set_target(1.0, 2.0 / servo_gains(sampled, 5e-5).changeover_time_s(period_s))
    position = speed = effort = 0.0
    errors = [1.0]
    for _ in range(len(made.alone)):
        answer = law.step(position)
        position, speed = (
            position + sampled.a12 * speed + sampled.b1 * effort,
            sampled.a22 * speed + sampled.b2 * effort,
        )
        effort = answer
        errors.append(abs(1.0 - position))
    to_come = [max(errors[index:]) for index in range(len(errors))]
    assert made.alone[-1] == pytest.approx(1.0)
    assert made.alone[::-1] == pytest.approx(to_come[: len(made.alone)], abs=1e-5)


def test_it_ends_where_nobody_asks_any_more() -> None:
    """A millionth of the change-over distance, which is the whole of a move alone."""
    gains = servo_gains(PLANTS[0].discretise(0.01), 5e-5)
    made = response(PLANTS[0], 0.01)
    for left, length in ((made.alone, 1.0), (made.after_cruise, gains.changeover_time_s(0.01))):
        assert all(before <= after for before, after in pairwise(left))
        assert left[-1] == pytest.approx(length, rel=0.05)
        assert left[0] < 3e-6 * length


def test_a_share_is_entered_with_the_last_tick_that_leaves_more() -> None:
    made = response(PLANTS[0], 0.01)
    assert made.enters([0.1, 0.2, 0.4], 0.3) == pytest.approx(0.01)
    assert made.enters([0.1, 0.2, 0.4], 0.2) == pytest.approx(0.02)
    assert made.enters([0.1, 0.2, 0.4], 0.5) == 0.0
