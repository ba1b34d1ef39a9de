"""The figures of hand-made runs, whose overshoot, settling, steps and windows are known beforehand."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.paper.experiment import Run
from twostage_servo.paper.scores import score

TICKS = 600
DIRECTIONS = [1.0, -1.0]


def made(
    direction: float = 1.0,
    *,
    position: dict[int, float] | None = None,
    velocity: dict[int, float] | None = None,
    law_velocity: dict[int, float] | None = None,
    effort: dict[int, float] | None = None,
    changeover: int | None = None,
    ticks: int = TICKS,
) -> Run:
    """Return a move over 100 mm at 20 mm/s; each dict holds what a figure is from some tick on, all else is 0."""

    def series(changes: dict[int, float] | None) -> list[float]:
        values, value = [], 0.0
        for k in range(ticks):
            value = (changes or {}).get(k, value)
            values.append(direction * value)
        return values

    return Run(
        set_point=direction * 100.0,
        reference=20.0,
        position=series(position),
        velocity=series(velocity),
        law_velocity=series(law_velocity),
        effort=series(effort),
        changeover=changeover,
    )


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_overshoot_is_the_farthest_beyond_the_set_point_in_the_direction_of_the_move(direction: float) -> None:
    assert score(made(direction, position={10: 103.5, 11: 101.0, 12: 100.0})).overshoot == pytest.approx(3.5)
    assert score(made(direction, position={10: 99.0})).overshoot == 0.0
    assert score(made(direction, position={10: -400.0, 12: 100.0})).overshoot == 0.0


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_settling_is_when_the_band_of_a_thousandth_is_entered_for_good(direction: float) -> None:
    """The band is 0.1 mm to both sides: the visit at 50 does not count, the last entry does."""
    run = made(direction, position={50: 100.05, 60: 100.3, 123: 99.95, 400: 100.09})
    assert score(run).settling_time_s == pytest.approx(1.23)
    assert score(made(direction, position={0: 100.0})).settling_time_s == 0.0


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("last", [99.89, 100.11, 0.0])
def test_a_run_that_ends_outside_the_band_never_settles(direction: float, last: float) -> None:
    assert score(made(direction, position={50: 100.0, TICKS - 1: last})).settling_time_s is None


@given(entered=st.integers(1, TICKS - 1), outside=st.floats(0.11, 1e4), sign=st.sampled_from([1.0, -1.0]))
def test_settling_is_the_tick_after_the_last_one_outside(entered: int, outside: float, sign: float) -> None:
    run = made(position={0: 100.0, entered - 1: 100.0 + sign * outside, entered: 100.0})
    assert score(run).settling_time_s == pytest.approx(0.01 * entered)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_speed_overshoot_counts_until_the_changeover_and_in_the_whole_run_without_one(direction: float) -> None:
    velocity = {5: 20.0, 30: 26.0, 31: 20.0, 200: 29.0, 201: 0.0}
    assert score(made(direction, velocity=velocity, changeover=199)).speed_overshoot == pytest.approx(6.0)
    assert score(made(direction, velocity=velocity, changeover=200)).speed_overshoot == pytest.approx(9.0)
    assert score(made(direction, velocity=velocity)).speed_overshoot == pytest.approx(9.0)
    assert score(made(direction, velocity={5: 19.0})).speed_overshoot == 0.0


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_cruise_is_judged_from_one_and_a_half_to_three_seconds_and_nowhere_else(direction: float) -> None:
    """Half the window at 20 + 3, half at 20 - 1, whatever comes before and after: mean 21, deviation 2, error √5."""
    halves = {0: 500.0, 150: 23.0, 225: 19.0, 300: -700.0}
    scores = score(made(direction, velocity=halves, law_velocity=halves))
    assert scores.velocity_noise_rms == pytest.approx(2.0)
    assert scores.velocity_error_rms == pytest.approx(math.sqrt((9.0 + 1.0) / 2.0))
    assert scores.cruise_velocity == pytest.approx(direction * 21.0)


def test_noise_is_of_the_velocity_that_the_law_uses_and_error_of_the_true_one() -> None:
    alternating = {k: 20.0 + (-1.0) ** k for k in range(TICKS)}
    scores = score(made(velocity={0: 20.0}, law_velocity=alternating))
    assert scores.velocity_noise_rms == pytest.approx(1.0)
    assert scores.velocity_error_rms == 0.0
    scores = score(made(velocity=alternating, law_velocity={0: 20.0}))
    assert scores.velocity_noise_rms == 0.0
    assert scores.velocity_error_rms == pytest.approx(1.0)


def test_the_cruise_velocity_ends_with_the_speed_stage() -> None:
    velocity = {0: 18.0, 200: 2.0}
    assert score(made(velocity=velocity, changeover=200)).cruise_velocity == pytest.approx(18.0)
    assert score(made(velocity=velocity, changeover=150)).cruise_velocity is None
    assert score(made(velocity=velocity)).cruise_velocity == pytest.approx((50.0 * 18.0 + 100.0 * 2.0) / 150.0)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_steps_into_and_out_of_the_changeover_are_told_from_those_of_the_half_second_before(
    direction: float,
) -> None:
    """Steps of 9 (too early), 0.5, -0.7 (ordinary), -2 (into the change-over at 200), 8 (out of it) and 20."""
    effort = {149: 9.0, 150: 9.5, 199: 8.8, 200: 6.8, 201: 14.8, 202: 34.8}
    scores = score(made(direction, effort=effort, changeover=200))
    assert scores.changeover_effort_step == pytest.approx(2.0)
    assert scores.following_effort_step == pytest.approx(8.0)
    assert scores.ordinary_effort_step == pytest.approx(0.7)
    assert scores.changeovers == 1


def test_without_a_changeover_there_is_no_step_at_it_and_every_step_is_ordinary() -> None:
    scores = score(made(effort={10: 1.0, 400: -3.0}))
    assert (scores.changeover_effort_step, scores.following_effort_step) == (0.0, 0.0)
    assert scores.ordinary_effort_step == pytest.approx(4.0)
    assert scores.changeovers == 0


def test_a_changeover_in_the_first_tick_has_no_step_before_it_to_count() -> None:
    scores = score(made(effort={0: 5.0, 1: 1.0}, changeover=0))
    assert (scores.changeover_effort_step, scores.ordinary_effort_step) == (0.0, 0.0)
    assert scores.following_effort_step == pytest.approx(4.0)


def test_a_run_that_ends_with_its_changeover_has_no_step_after_it_to_count() -> None:
    scores = score(made(effort={TICKS - 1: 3.0}, changeover=TICKS - 1))
    assert (scores.changeover_effort_step, scores.following_effort_step) == (3.0, 0.0)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_final_error_is_the_mean_of_the_last_second_with_its_sign(direction: float) -> None:
    run = made(direction, position={10: 50.0, TICKS - 100: 99.0, TICKS - 50: 100.5})
    assert score(run).final_error == pytest.approx(direction * -0.25)


def test_a_short_run_that_was_given_up_is_scored_until_there() -> None:
    run = made(position={0: 0.0, 4: 130.0}, velocity={0: 50.0}, ticks=5)
    run.diverged = True
    scores = score(run)
    assert scores.diverged
    assert scores.overshoot == pytest.approx(30.0)
    assert scores.settling_time_s is None
    assert scores.final_error is None
    assert (scores.velocity_noise_rms, scores.velocity_error_rms, scores.cruise_velocity) == (None, None, None)
    assert scores.duration_s == pytest.approx(0.05)
    assert not score(made()).diverged
    assert score(made()).duration_s == pytest.approx(6.0)


def test_the_json_holds_every_figure_by_its_name() -> None:
    scores = score(made(position={10: 103.5, 20: 100.0}, changeover=15))
    figures = scores.as_json()
    assert figures["overshoot"] == pytest.approx(3.5)
    assert figures["settling_time_s"] == pytest.approx(0.2)
    assert figures["changeovers"] == 1
    assert figures["diverged"] is False
