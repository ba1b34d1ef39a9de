"""The law as a whole, on plants that are known exactly."""

import random
from collections.abc import Callable
from itertools import pairwise
from math import inf

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tools.bench.control_quality.suite import Case, run
from tools.bench.control_quality.true_plant import TrueAxis, TruePlant
from twostage_servo.control.laws.adaptive.design import AdaptiveDesign, design_adaptive
from twostage_servo.control.laws.adaptive.law import AdaptiveLaw
from twostage_servo.control.laws.law import ControlTask, LearningLaw, Stage
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01


def task(
    gain: float = 180.0,
    pole: float = 14.0,
    *,
    effort: float = 24.0,
    rate: float = 1000.0,
    acceleration: float = 2000.0,
    length: float = 1.0,
) -> ControlTask:
    """Return a task; with `length` units for each of the demo's millimetres."""
    plant = Plant(gain * length, pole)
    sampled = plant.discretise(PERIOD_S)
    square = length * length
    noise = NoiseModel((0.1 * square, 0.1 * square, 0.1), 0.01 * square)
    return ControlTask(
        plant, sampled, PERIOD_S, noise, kalman_gain(sampled, noise), 250.0 * length, acceleration * length, effort,
        rate, 2.5 * length,
    )  # fmt: skip


def design(made: ControlTask, noise: float = 0.0, *, learns: bool = True) -> AdaptiveDesign:
    return design_adaptive(made, noise, learns=learns)


def law_of(made: ControlTask, *, learns: bool = True) -> AdaptiveLaw:
    return design(made, learns=learns).build(DisturbanceObserver(made.sampled, made.kalman.predictor))


class Rig:
    """A law and its plant, tick by tick; `gains` and `poles` are what the plant has for one of the model's."""

    def __init__(
        self, made: ControlTask, gain: float = 1.0, pole: float = 1.0, *, delay: int = 0, learns: bool = True
    ) -> None:
        axis = TrueAxis(made.plant.gain * gain, made.plant.pole * pole, delay_ticks=delay, quantum=0.0)
        self.law = law_of(made, learns=learns)
        self.plant = TruePlant(axis, PERIOD_S, 1)
        self.sample = self.plant.sample()
        self.efforts: list[float] = []
        self.positions: list[float] = []
        self.velocities: list[float] = []

    def ticks(self, count: int, until: Callable[[], bool] = lambda: False) -> "Rig":
        for _ in range(count):
            effort = self.law.step(self.sample)
            self.sample = self.plant.sample()
            self.plant.advance(effort)
            self.efforts.append(effort)
            self.positions.append(self.plant.position)
            self.velocities.append(self.plant.velocity)
            if until():
                break
        return self

    def move(self, target: float, velocity: float, ticks: int) -> "Rig":
        self.law.set_target(target, velocity)
        return self.ticks(ticks)

    def settled_after(self, target: float, band: float) -> int:
        """Return the tick from which the position stays within a band of the target."""
        outside = [index for index, at in enumerate(self.positions) if abs(at - target) > band]
        return outside[-1] + 1 if outside else 0


@pytest.mark.parametrize(("effort", "bound_s"), [(10.0, 4.08), (24.0, 4.06)])
def test_the_demos_move_takes_little_more_than_its_bound(effort: float, bound_s: float) -> None:
    """400 mm at 100 mm/s, to 0.1 mm, without a limit of the acceleration; 4.050 and 4.015 s are the bounds."""
    case = Case(TrueAxis(180.0, 14.0, effort_limit=effort), 400.0, 100.0, 1)
    for outcome in run(law_of(task(effort=effort, acceleration=inf)), case, 3):
        assert outcome.settling_s < bound_s
        assert outcome.overshoot < 0.03
        assert outcome.peak_velocity < 1.05


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("pole", [0.7, 1.0, 1.3])
@pytest.mark.parametrize("gain", [0.7, 1.0, 1.3])
def test_an_axis_off_its_model_is_identified_in_its_first_move(gain: float, pole: float, delay: int) -> None:
    rig = Rig(task(), gain, pole, delay=delay).ticks(50).move(400.0, 100.0, 600)
    assert rig.settled_after(400.0, 0.1) < 50 + 412
    assert max(rig.positions) < 400.05
    assert max(rig.velocities) < 125.0
    found = rig.law.learned
    assert found.gain == pytest.approx(180.0 * gain, rel=0.02)
    assert found.pole == pytest.approx(14.0 * pole, rel=0.02)
    assert (found.delay_ticks, found.moves, found.is_sure) == (delay, 1, True)
    assert found.load[0] == pytest.approx(0.0, abs=0.05)
    assert found.load[1] is None


def test_without_identification_it_goes_by_what_is_configured() -> None:
    rig = Rig(task(), 1.3, 0.7, learns=False).ticks(50).move(400.0, 100.0, 700)
    assert rig.law.learned.moves == 0
    assert rig.law.learned.gain == 180.0
    assert rig.positions[-1] == pytest.approx(400.0, abs=0.1)


@settings(max_examples=60, deadline=None)
@given(st.floats(0.002, 4.0), st.floats(1.0, 250.0), st.sampled_from((1.0, -1.0)), st.sampled_from((1.0, -1.0)))
def test_any_move_arrives_and_stays(time_s: float, velocity: float, direction: float, sign: float) -> None:
    """On the model's plant, whichever way its gain is; from 2 µm to 1000 mm, by the time at its velocity."""
    distance = time_s * velocity
    rig = Rig(task(sign * 180.0)).ticks(30)
    target = direction * distance
    rig.move(target, velocity, round(100.0 * distance / velocity) + 80)
    assert rig.law.stage is Stage.POSITION
    assert rig.positions[-1] == pytest.approx(target, abs=2e-3)
    assert max(direction * at for at in rig.positions) < distance + 0.02
    assert max(abs(speed) for speed in rig.velocities) < 1.05 * velocity + 0.5
    assert rig.law.changeovers == 1


def test_a_move_of_a_few_ticks_does_not_pass_its_velocity() -> None:
    rig = Rig(task()).ticks(30).move(7.59375, 81.0, 100)
    assert max(rig.velocities) < 1.05 * 81.0 + 0.5


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-800.0, 800.0), st.floats(5.0, 250.0), st.integers(1, 120)), min_size=2, max_size=6),
    st.sampled_from(((1.0, 1.0), (1.3, 0.7), (0.7, 1.3))),
)
def test_new_set_points_in_mid_move_are_met(moves: list[tuple[float, float, int]], plant: tuple[float, float]) -> None:
    """Forward, back, beyond, and other speeds; within the effort's rate and limit throughout."""
    rig = Rig(task(), *plant).ticks(30)
    for target, velocity, ticks in moves:
        rig.move(target, velocity, ticks)
    rig.ticks(round(100.0 * 1600.0 / moves[-1][1]) + 150)
    assert rig.positions[-1] == pytest.approx(moves[-1][0], abs=0.02)
    steps = [abs(after - before) for before, after in pairwise(rig.efforts)]
    assert max(steps) <= 10.0 * (1.0 + 1e-12)
    assert max(abs(effort) for effort in rig.efforts) <= 24.0


def test_a_set_point_that_cannot_be_met_any_more_is_met_from_the_other_side() -> None:
    """At 200 mm/s it takes 12 mm to stop at 2000 mm/s²: 3 mm are not enough."""
    rig = Rig(task()).ticks(30).move(400.0, 200.0, 100)
    target = rig.plant.position + 3.0
    rig.move(target, 200.0, 200)
    assert max(rig.positions) < target + 12.0
    assert rig.positions[-1] == pytest.approx(target, abs=0.01)


def test_the_change_over_is_bumpless() -> None:
    """The second difference of the effort at that tick lies within those of its neighbours."""
    rig = Rig(task(acceleration=inf, effort=10.0)).ticks(30)
    rig.law.set_target(400.0, 100.0)
    rig.ticks(600, until=lambda: rig.law.changeovers == 1)
    at = len(rig.efforts) - 1
    rig.ticks(40)
    second = [
        rig.efforts[index + 1] - 2.0 * rig.efforts[index] + rig.efforts[index - 1] for index in range(at - 20, at + 20)
    ]
    assert abs(second[20]) <= max(abs(one) for one in (*second[:20], *second[21:]))
    assert abs(rig.efforts[at] - rig.efforts[at - 1]) < 1e-6


@pytest.mark.parametrize("length", [1e-3, 1e3, 360.0])
def test_the_same_axis_in_other_units_makes_the_same_move(length: float) -> None:
    def positions(length: float) -> list[float]:
        rig = Rig(task(length=length), 1.2, 0.8).ticks(30)
        rig.move(length * 400.0, length * 100.0, 500).move(length * 10.0, length * 150.0, 400)
        return [at / length for at in rig.positions]

    assert positions(length) == pytest.approx(positions(1.0), abs=1e-6)


def test_a_gain_the_other_way_round_turns_the_efforts_round() -> None:
    one = Rig(task(180.0), 1.2).ticks(30).move(300.0, 100.0, 450)
    other = Rig(task(-180.0), 1.2).ticks(30).move(300.0, 100.0, 450)
    assert other.positions == pytest.approx(one.positions, abs=1e-9)
    assert other.efforts == pytest.approx([-effort for effort in one.efforts], abs=1e-9)


@pytest.mark.parametrize("after", [2, 5, 9, 40, 120])
def test_a_stop_from_any_stage_comes_to_rest_and_holds(after: int) -> None:
    rig = Rig(task(), 1.2, 0.8).ticks(30).move(100.0, 100.0, after)
    rig.law.stop(2000.0)
    rig.ticks(200)
    assert rig.law.stage is Stage.POSITION
    assert abs(rig.velocities[-1]) < 0.05
    assert rig.positions[-1] == pytest.approx(rig.law.target, abs=0.02)
    rig.move(-50.0, 100.0, 400)
    assert rig.positions[-1] == pytest.approx(-50.0, abs=0.02)


def test_a_model_that_runs_by_itself_learns_nothing_and_moves_as_designed() -> None:
    made = task()
    law = design(made).build(DisturbanceObserver(made.sampled, NO_CORRECTION))
    law.set_target(400.0, 100.0)
    for _ in range(450):
        law.step(None)
    assert law.learned.moves == 0
    assert law.observer.position == pytest.approx(400.0, abs=1e-3)


def test_it_goes_on_where_another_one_stands() -> None:
    """A model beside an axis, as the nominal response is, from the middle of its braking on."""
    made = task()
    rig = Rig(made).ticks(30).move(400.0, 100.0, 0)
    rig.ticks(600, until=lambda: rig.law.changeovers == 1)
    beside = design(made).build(DisturbanceObserver(made.sampled, NO_CORRECTION))
    beside.continue_from(rig.law)
    for _ in range(100):
        rig.ticks(1)
        beside.step(None)
        assert beside.observer.position == pytest.approx(rig.law.observer.position, abs=0.05)
    assert beside.observer.position == pytest.approx(400.0, abs=0.05)
    assert beside.stage is rig.law.stage is Stage.POSITION


def test_it_forgets_when_it_is_told_to() -> None:
    rig = Rig(task(), 1.3, 0.8).ticks(30).move(400.0, 100.0, 600)
    assert isinstance(rig.law, LearningLaw)
    effort = rig.efforts[-1]
    rig.law.forget()
    found = rig.law.learned
    assert (found.gain, found.pole, found.delay_ticks, found.load, found.moves) == (180.0, 14.0, 0, (None, None), 0)
    assert not found.is_sure
    rig.ticks(50)
    assert max(abs(one - effort) for one in rig.efforts[-50:]) < 0.05
    assert rig.positions[-1] == pytest.approx(400.0, abs=0.01)


def test_an_origin_that_moves_moves_nothing() -> None:
    def efforts(shift: float) -> list[float]:
        rig = Rig(task(), 1.2).ticks(30).move(300.0, 100.0, 60)
        rig.law.shift(shift)
        rig.plant.shift(shift)
        rig.sample += shift
        return rig.ticks(400).efforts

    assert efforts(1234.0) == pytest.approx(efforts(0.0), abs=1e-6)


def test_a_tick_that_was_missed_is_made_up_for() -> None:
    rig = Rig(task()).ticks(30).move(300.0, 100.0, 100)
    before = rig.law.observer.position
    rig.law.skip(2)
    for _ in range(2):
        rig.plant.advance(rig.efforts[-1])
    rig.sample = rig.plant.position - 0.01 * rig.plant.velocity  # of the last effort's instant
    assert rig.law.observer.position == pytest.approx(before + 2.0, abs=0.01)
    rig.ticks(400)
    assert rig.positions[-1] == pytest.approx(300.0, abs=0.01)


def test_an_axis_that_does_not_move_is_not_pushed_by_all_of_the_effort() -> None:
    law = law_of(task())
    for _ in range(30):
        law.step(0.0)
    law.set_target(400.0, 100.0)
    efforts = [law.step(0.0) for _ in range(15)]
    assert max(efforts) < 20.0
    assert 3.0 < efforts[-1] < 7.0
    for _ in range(60):  # friction that takes more is overcome all the same
        law.step(0.0)
    assert law.effort == 24.0


def test_what_held_it_against_all_of_its_effort_is_let_go_evenly() -> None:
    """Half a second from the limit to none, and no step where the obstacle is left."""
    law = law_of(task())
    law.set_target(400.0, 100.0)
    for _ in range(100):
        law.step(0.0)
    assert law.effort == 24.0
    law.set_target(-400.0, 10.0)
    efforts = [law.step(0.0) for _ in range(50)]
    steps = {round(before - after, 9) for before, after in pairwise(efforts)}
    assert steps == {0.48}
    assert abs(efforts[-1]) < 0.5


def test_noise_is_measured_at_rest_and_chooses_the_poles() -> None:
    made = task()
    quiet, noisy = design(made, 0.003), design(made, 0.03)
    assert quiet.origin() == "poles for a quiet encoder"
    assert noisy.origin() == "poles for a noisy encoder"
    rng, law = random.Random(3), law_of(made)  # noqa: S311 - a test
    for _ in range(400):
        law.step(rng.gauss(0.0, 0.03))
    assert law.control_estimate.noise == pytest.approx(0.03, rel=0.25)
    law.set_target(100.0, 50.0)
    law.step(0.0)
    assert (
        law.control_estimate.model.gains
        == noisy.build(DisturbanceObserver(made.sampled, made.kalman.predictor)).control_estimate.model.gains
    )


def test_a_move_that_begins_at_speed_shows_no_plant_and_keeps_its_speed() -> None:
    """As where a service takes over an axis that moves: identified from there, it was any plant, and ran away."""
    rig = Rig(task())
    rig.plant = TruePlant(TrueAxis(180.0, 14.0, quantum=0.0), PERIOD_S, 1)
    rig.plant.velocity = rig.law.observer.velocity = 100.0
    rig.law.start(100.0 * 14.0 / 180.0)
    rig.move(1000.0, 100.0, 60)
    assert isinstance(rig.law, LearningLaw)
    assert not rig.law.control_estimate.is_identifying
    assert min(rig.velocities) == pytest.approx(100.0, abs=6.0)
    assert max(rig.velocities) == pytest.approx(100.0, abs=6.0)
    assert rig.law.learned.moves == 0


def test_a_move_that_is_given_up_early_leaves_the_next_one_the_poles_of_an_unknown_plant() -> None:
    """It goes on by what it has found, quickly; but what is configured is not known any better for it."""
    rig = Rig(task(), 1.25, 0.8).ticks(50).move(400.0, 100.0, 30)
    unknown = law_of(task()).control_estimate.model.observer_gain
    rig.law.set_target(390.0, 90.0)
    assert rig.law.control_estimate.model.plant.gain == pytest.approx(225.0, rel=0.05)
    assert rig.law.control_estimate.model.observer_gain[0] > 1.5 * unknown[0]
    assert not rig.law.learned.is_sure
    rig.ticks(600).law.set_target(0.0, 100.0)
    assert rig.law.control_estimate.model.observer_gain == pytest.approx(unknown)


@pytest.mark.parametrize("noise", [0.0, 0.0316])
def test_the_noise_of_an_encoder_is_measured_at_each_place_by_itself(noise: float) -> None:
    """The step from one place to the next was taken for noise of a metre: quick poles were used in no second move."""
    rig, chance = Rig(task(), 0.9), random.Random(3)  # noqa: S311 - not for secrets
    for target in (400.0, 0.0, -400.0):
        rig.law.set_target(target, 100.0)
        for _ in range(1000):
            effort = rig.law.step(rig.plant.sample() + chance.gauss(0.0, noise))
            rig.plant.advance(effort)
        assert rig.law.control_estimate.noise == pytest.approx(noise, abs=0.3 * noise + 0.001)
