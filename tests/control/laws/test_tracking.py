"""The law that follows a reference with a feedback that it is given, on its own model and off it."""

import itertools
import math

import pytest

from twostage_servo.control.laws.law import ControlTask, DesignError, Stage
from twostage_servo.control.laws.tracking import TrackingDesign, TrackingLaw
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01
PLANT = Plant(180.0, 14.0)
SAMPLED = PLANT.discretise(PERIOD_S)
NOISE = NoiseModel()
TASK = ControlTask(
    plant=PLANT,
    sampled=SAMPLED,
    period_s=PERIOD_S,
    noise=NOISE,
    kalman=kalman_gain(SAMPLED, NOISE),
    velocity_limit=250.0,
    acceleration_limit=2000.0,
    effort_limit=24.0,
    effort_rate_limit=1000.0,
    rest_velocity=2.5,
)


def feedback(position_error: float, speed_error: float) -> float:
    return 0.2 * position_error - 0.011 * speed_error


DESIGN = TrackingDesign(TASK, feedback, 1.0 / 6.0, {"kp": 0.2}, "hand")


class Run:
    """A law on a plant that may be another one, under a load."""

    def __init__(self, gain: float = 1.0, load: float = 0.0) -> None:
        self.law = DESIGN.build(DisturbanceObserver(SAMPLED, TASK.kalman.predictor))
        self.plant = Plant(gain * PLANT.gain, PLANT.pole).discretise(PERIOD_S)
        self.load = load
        self.position = self.velocity = self.sample = 0.0
        self.efforts: list[float] = []
        self.speeds: list[float] = []

    def stage(self) -> Stage:
        return self.law.stage

    def seconds(self, duration_s: float) -> "Run":
        for _ in range(round(duration_s / PERIOD_S)):
            effort = self.law.step(self.sample)
            self.sample = self.position
            total = effort - self.load
            self.position += self.plant.a12 * self.velocity + self.plant.b1 * total
            self.velocity = self.plant.a22 * self.velocity + self.plant.b2 * total
            self.efforts.append(effort)
            self.speeds.append(self.velocity)
        return self


@pytest.mark.parametrize(("gain", "load"), [(1.0, 0.0), (1.3, 2.0), (0.7, -2.0)])
@pytest.mark.parametrize("target", [400.0, -30.0, 0.5])
def test_it_comes_to_rest_at_its_set_point_within_its_limits(gain: float, load: float, target: float) -> None:
    run = Run(gain, load).seconds(1.0)
    run.law.set_target(target, 100.0)
    assert run.stage() is Stage.SPEED
    run.seconds(8.0)
    assert run.stage() is Stage.POSITION
    assert run.law.changeovers == 1
    assert run.position == pytest.approx(target, abs=0.01)
    assert abs(run.velocity) < 0.1
    assert max(map(abs, run.speeds)) < 1.3 * 100.0
    assert max(map(abs, run.efforts)) <= 24.0
    assert max(abs(after - before) for before, after in itertools.pairwise(run.efforts)) <= 10.0 + 1e-9


def test_the_reference_keeps_to_speed_and_acceleration() -> None:
    law = Run().law
    law.set_target(100.0, 80.0)
    places, speeds = [law.reference], [law.speed_reference]
    while law.stage is Stage.SPEED and len(places) < 1000:
        law.step(None)
        places.append(law.reference)
        speeds.append(law.speed_reference)
    assert places[-1] == 100.0
    assert max(places) == 100.0
    assert max(speeds) == pytest.approx(80.0)
    assert max(abs(after - before) for before, after in itertools.pairwise(speeds)) <= 20.0 + 1e-9
    assert len(places) * PERIOD_S == pytest.approx(100.0 / 80.0 + 80.0 / 2000.0, abs=0.05)


def test_a_new_set_point_in_mid_move_turns_it_round_without_a_jump() -> None:
    run = Run()
    run.law.set_target(400.0, 100.0)
    run.seconds(1.0)
    before = run.law.reference, run.law.speed_reference
    run.law.set_target(-10.0, 50.0)
    assert (run.law.reference, run.law.speed_reference) == before
    run.seconds(6.0)
    assert run.position == pytest.approx(-10.0, abs=0.01)


def test_a_stop_ends_where_the_design_says_and_holds_there() -> None:
    run = Run()
    run.law.set_target(400.0, 100.0)
    run.seconds(2.0)
    at = run.position
    run.law.stop(2000.0, gradual=True)
    assert run.stage() is Stage.BRAKE
    run.seconds(0.6)
    assert run.stage() is Stage.POSITION
    assert 2.5 < run.position - at <= DESIGN.stopping_distance(100.0, 2000.0)
    assert DESIGN.stopping_distance(100.0, 2000.0) < DESIGN.certain_stopping_distance(100.0, 2000.0)
    rest = run.position
    run.seconds(2.0)
    assert run.position == pytest.approx(rest, abs=0.05)
    run.law.set_target(0.0, 100.0)
    assert run.law.reference == run.law.observer.position


def test_another_origin_moves_nothing() -> None:
    one, other = Run(), Run()
    for run in (one, other):
        run.law.set_target(400.0, 100.0)
        run.seconds(1.0)
    other.law.shift(1000.0)
    other.position += 1000.0
    other.sample += 1000.0
    one.seconds(4.0)
    other.seconds(4.0)
    assert other.efforts == pytest.approx(one.efforts)
    assert other.law.target == 1400.0


def test_a_law_that_continues_from_another_goes_on_as_that_one() -> None:
    for prepare in (lambda law: None, lambda law: law.stop(1000.0, gradual=True)):
        run = Run()
        run.law.set_target(400.0, 100.0)
        run.seconds(1.0)
        prepare(run.law)
        twin = Run().law
        twin.continue_from(run.law)
        assert [twin.step(None) for _ in range(50)] == [run.law.step(None) for _ in range(50)]


def test_a_smaller_limit_holds_from_the_next_step_on() -> None:
    run = Run(load=8.0).seconds(2.0)
    run.law.limit_effort(5.0)
    run.seconds(0.1)
    assert run.efforts[-1] == 5.0
    assert run.law.saturated
    assert run.law.effort_limit == 5.0


def test_a_stop_goes_on_from_the_speed_that_it_is_told() -> None:
    law = Run().law
    law.set_target(400.0, 100.0)
    law.stop(2000.0)
    law.resume_at(-60.0, 1.0)
    assert (law.observer.velocity, law.observer.disturbance, law.speed_reference) == (-60.0, 1.0, -60.0)
    law.step(None)
    assert law.speed_reference == pytest.approx(-40.0)


def test_periods_without_a_step_are_predicted_with_the_last_effort() -> None:
    law, twin = Run().law, Run().law
    for one in (law, twin):
        one.set_target(400.0, 100.0)
        one.step(None)
    law.skip(3)
    for _ in range(3):
        twin.observer.predict(twin.effort)
    assert law.observer.position == twin.observer.position


def test_what_is_no_number_is_handed_on() -> None:
    law = TrackingLaw(DisturbanceObserver(SAMPLED, TASK.kalman.predictor), lambda *_: math.nan, TASK)
    assert math.isnan(law.step(0.0))


def test_a_move_takes_as_long_as_the_design_says() -> None:
    run = Run()
    run.law.set_target(400.0, 100.0)
    expected_s = DESIGN.move_duration_s(400.0, 100.0, 0.05)
    run.seconds(expected_s)
    assert abs(run.position - 400.0) < 0.05
    assert expected_s < 4.05 + 9.0 / 6.0 + 0.1


@pytest.mark.parametrize("time_constant_s", [0.0, -1.0, math.nan, math.inf])
def test_a_time_constant_that_is_none_is_refused(time_constant_s: float) -> None:
    with pytest.raises(DesignError, match="the time constant is"):
        TrackingDesign(TASK, feedback, time_constant_s)


def test_what_it_says_of_itself() -> None:
    assert DESIGN.gains() == {"kp": 0.2}
    assert (DESIGN.origin(), DESIGN.loops(), DESIGN.changeover_time_s) == ("hand", {}, 1.0 / 6.0)
    assert 0.3 < DESIGN.settling_time_s < 0.5
    assert DESIGN.stopping_time_s(100.0, 2000.0) == pytest.approx(0.05 + 2.0 / 180.0 + DESIGN.settling_time_s, rel=1e-3)


@pytest.mark.parametrize("velocity", [30.0, 100.0, 250.0])
@pytest.mark.parametrize("target", [0.3, 3.0, 40.0, -40.0])
def test_a_reference_that_slows_down_comes_to_rest_just_at_its_set_point(target: float, velocity: float) -> None:
    """A tick from v to w takes (v + w) T/2, and w²/2a more come to rest: together all that is left, and never more."""
    law, sign, step = Run().law, math.copysign(1.0, target), 2000.0 * PERIOD_S
    law.set_target(target, velocity)
    slowed = 0
    for _ in range(1000):
        left, before = sign * (target - law.reference), sign * law.speed_reference
        law.step(None)
        after = sign * law.speed_reference
        if law.stage is Stage.POSITION:
            break
        way = 0.5 * (before + after) * PERIOD_S + after * after / 4000.0
        assert way <= left + 1e-9
        if after < before or after < min(velocity, before + step) - 1e-9:
            assert way == pytest.approx(left)
            slowed += 1
    assert slowed or abs(target) < 1.0


@pytest.mark.parametrize(("to_go", "speed", "arrives"), [(0.99, 0.0, True), (1.01, 0.0, False), (0.99, 1.01, False)])
def test_a_reference_arrives_where_half_a_tick_of_a_step_is_left(to_go: float, speed: float, arrives: bool) -> None:
    """In units of 0.1 mm, that is ``a T²/2``, and of a step of 20 mm/s."""
    law = Run().law
    law.set_target(0.1 * to_go, 100.0)
    law.speed_reference = 20.0 * speed
    law.step(None)
    assert (law.stage is Stage.POSITION) is arrives
    assert law.reference == pytest.approx(0.1 * to_go) or not arrives
