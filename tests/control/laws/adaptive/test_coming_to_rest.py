"""What acts against a motion alone, friction first of all, is given up as the motion ends."""

import random
import statistics

import pytest

from tests.control.laws.adaptive.test_adaptive_law import PERIOD_S, design, task
from tools.bench.control_quality.true_plant import TrueAxis, TruePlant
from twostage_servo.control.laws.adaptive.design import design_adaptive
from twostage_servo.control.laws.adaptive.learning import Learning
from twostage_servo.control.laws.adaptive.rules import LearningRules, Rules
from twostage_servo.control.laws.law import Learned
from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.plant import Plant

NOISE = 0.0316
"""Standard deviation of the encoder in mm."""


class Moves:
    """An axis with friction and a load whose law goes there and back; `gain` is the model's."""

    def __init__(
        self,
        noise: float,
        seed: int,
        *,
        gain: float = 180.0,
        friction: float = 0.4,
        load: float = -0.9,
        rules: Rules = Rules(),  # noqa: B008 - frozen
    ) -> None:
        made = task(gain)
        observer = DisturbanceObserver(made.sampled, made.kalman.predictor)
        self.law = design_adaptive(made, noise, learns=True, rules=rules).build(observer)
        sign = 1.0 if gain > 0.0 else -1.0
        axis = TrueAxis(1.3 * gain, 9.8, friction, sign * load, effort_limit=24.0, quantum=0.01, delay_ticks=1)
        self.plant = TruePlant(axis, PERIOD_S, seed)
        self._noise = random.Random(seed)  # noqa: S311 - no secret
        self._noise_std = noise
        self.ticks(200)

    def ticks(self, count: int) -> list[float]:
        """Let some ticks pass; return where the axis truly was, in mm."""
        places = []
        for _ in range(count):
            sample = self.plant.sample() + self._noise.gauss(0.0, self._noise_std)
            self.plant.advance(self.law.step(sample))
            places.append(self.plant.position)
        return places

    def move(self, target: float) -> float:
        """Move until the reference has ended; return the disturbance that was estimated a tick before, in V."""
        self.law.set_target(target, 100.0)
        before, has_braked = 0.0, False
        while not has_braked or self.law.course.braking is not None:
            before = self.law.control_estimate.disturbance
            has_braked = has_braked or self.law.course.braking is not None
            self.ticks(1)
        return before

    def worst_error_at_rest(self, target: float) -> float:
        """Move 300 mm at 100 mm/s; return the largest error from 0.2 s after the reference has ended, in mm."""
        self.move(target)
        self.ticks(20)
        worst = max(abs(place - target) for place in self.ticks(80))
        self.ticks(60)
        return worst


@pytest.mark.parametrize("gain", [180.0, -180.0])
def test_an_axis_with_friction_and_a_noisy_encoder_is_not_pushed_on_from_where_it_comes_to_rest(gain: float) -> None:
    """What had been found against the motion pushed it on for half a second: 0.105 mm in the mean."""
    worst = []
    for seed in range(8):
        moves = Moves(NOISE, seed, gain=gain, friction=0.5, load=-0.5)
        worst += [moves.worst_error_at_rest(target) for target in (300.0, 0.0, 300.0)]
    assert statistics.fmean(worst) < 0.07


def test_the_load_that_is_left_is_that_of_the_axis_at_rest() -> None:
    moves = Moves(NOISE, 3)
    moves.worst_error_at_rest(300.0)
    moves.worst_error_at_rest(0.0)
    assert moves.move(300.0) == pytest.approx(0.5, abs=0.25)
    assert moves.law.control_estimate.disturbance == pytest.approx(0.9, abs=0.25)


def test_a_law_that_is_told_not_to_gives_nothing_up() -> None:
    moves = Moves(NOISE, 3, rules=Rules(ends_friction=False))
    moves.worst_error_at_rest(300.0)
    moves.worst_error_at_rest(0.0)
    before = moves.move(300.0)
    assert moves.law.control_estimate.disturbance == pytest.approx(before, abs=0.1)


def learning(gain: float, loads: dict[float, float], direction: float = 1.0) -> Learning:
    known = Learning(Plant(gain, 14.0), LearningRules(), PERIOD_S, 24.0)
    known.recall(Learned(gain, 14.0, 0.01, 0.01, 0, 50.0, (loads.get(1.0), loads.get(-1.0)), 2, is_sure=True))
    known.begin(direction, 0.0, 0.01)
    return known


@pytest.mark.parametrize(
    ("gain", "loads", "direction", "at_rest", "ends"),
    [
        (180.0, {1.0: 1.3, -1.0: -0.5}, 1.0, 0.5, 0.4),  # a load of 0.9, friction of 0.4
        (180.0, {1.0: 1.3, -1.0: -0.5}, -1.0, -1.3, 0.4),
        (180.0, {1.0: 1.3}, 1.0, 0.8, 0.5),  # nothing is known of the other direction
        (180.0, {1.0: 1.3}, 1.0, 1.4, 0.0),
        (180.0, {1.0: -0.2, -1.0: -0.3}, 1.0, 0.0, 0.0),  # nothing that drives the axis ends
        (-180.0, {1.0: -1.3, -1.0: 0.5}, 1.0, 0.0, -0.4),
        (-180.0, {1.0: 0.2, -1.0: 0.3}, 1.0, 0.0, 0.0),
        (180.0, {1.0: 9.0, -1.0: 9.0}, 1.0, 0.0, 3.0),  # the most
    ],
)
def test_what_ends_with_a_motion_is_friction_and_what_a_fit_took_for_a_load(
    gain: float, loads: dict[float, float], direction: float, at_rest: float, ends: float
) -> None:
    assert learning(gain, loads, direction).friction(at_rest, 3.0) == pytest.approx(ends)


def test_the_load_of_the_other_direction_counts_only_while_the_axis_shows_it_at_rest() -> None:
    moves = Moves(NOISE, 1)
    moves.worst_error_at_rest(300.0)
    moves.worst_error_at_rest(0.0)
    assert set(moves.law.control_estimate.learning.loads) == {1.0, -1.0}
    moves.plant.load = 8.0
    moves.ticks(200)
    moves.law.set_target(300.0, 100.0)
    assert set(moves.law.control_estimate.learning.loads) == set()


def test_a_quiet_encoder_needs_no_such_step() -> None:
    moves = Moves(0.0, 1)
    for target in (300.0, 0.0):
        moves.worst_error_at_rest(target)
    before = moves.move(300.0)
    assert moves.law.control_estimate.disturbance == pytest.approx(before, abs=0.1)


def test_a_motion_that_nothing_has_been_found_of_ends_as_it_is_however_often() -> None:
    """As the first one of a law, and a second set-point in the same motion, which begins no move from rest."""
    estimate = design(task(), 1.0).build(DisturbanceObserver(task().sampled, task().kalman.predictor)).control_estimate
    estimate.observer.disturbance = 0.7
    for _ in range(3):
        estimate.come_to_rest(1.0)
        assert estimate.observer.disturbance == 0.7
        assert estimate.disturbance == pytest.approx(0.7)
