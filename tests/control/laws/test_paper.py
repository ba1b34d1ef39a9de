"""The law against the paper's equations in matrices, and against what must hold for every plant, gain and set-point."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.laws.stop import ending_share
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, extended_model, kalman_gain
from twostage_servo.control.optimal import ServoGains, servo_gains
from twostage_servo.control.plant import DiscretePlant, Plant

PERIOD_S = 0.01
MODEL = Plant(180.0, 14.0)
SAMPLED = MODEL.discretise(PERIOD_S)
KALMAN = kalman_gain(SAMPLED, NoiseModel())
SLOW, QUICK = servo_gains(SAMPLED, 5e-5), servo_gains(SAMPLED, 5e-3)


def make_law(gains: ServoGains = SLOW, *, acceleration: float = 2000.0, effort: float = 24.0) -> TwoStageLaw:
    return TwoStageLaw(
        DisturbanceObserver(SAMPLED, KALMAN.predictor),
        gains,
        PERIOD_S,
        acceleration_limit=acceleration,
        effort_limit=effort,
        rest_velocity=2.5,
    )


@dataclass
class Run:
    """The law on a plant of its own, sample by sample; the sample of a tick is used at the next, as over the bus."""

    law: TwoStageLaw
    plant: DiscretePlant = SAMPLED
    load: float = 0.0
    position: float = 0.0
    velocity: float = 0.0
    sample: float = 0.0
    positions: list[float] = field(default_factory=list)
    velocities: list[float] = field(default_factory=list)
    efforts: list[float] = field(default_factory=list)

    def tick(self) -> None:
        effort = self.law.step(self.sample)
        self.sample = self.position
        total = effort - self.load
        plant = self.plant
        self.position += plant.a12 * self.velocity + plant.b1 * total
        self.velocity = plant.a22 * self.velocity + plant.b2 * total
        self.positions.append(self.position)
        self.velocities.append(self.velocity)
        self.efforts.append(effort)

    def stage(self) -> Stage:
        return self.law.stage

    def stopping(self) -> bool:
        return self.law.stage is Stage.BRAKE

    def seconds(self, duration_s: float) -> "Run":
        for _ in range(round(duration_s / PERIOD_S)):
            self.tick()
        return self


def run_move(target: float, velocity: float, duration_s: float, gains: ServoGains = SLOW, effort: float = 24.0) -> Run:
    run = Run(make_law(gains, effort=effort))
    run.law.set_target(target, velocity)
    return run.seconds(duration_s)


def paper_in_matrices(target: float, velocity: float, ticks: int, gains: ServoGains) -> Iterator[tuple[float, Stage]]:
    """Equations (26), (29)-(34) written out anew with numpy, on the nominal plant and without any limit."""
    state, effort_column, output = extended_model(SAMPLED, 1.0)
    gain = np.array(KALMAN.predictor).reshape(3, 1)
    plant_state = np.zeros((2, 1))
    estimate, effort, sample = np.zeros((3, 1)), 0.0, 0.0
    total = 0.0
    offset: float | None = None
    distance = velocity * gains.f11 * PERIOD_S / gains.f22
    for _ in range(ticks):
        estimate = state @ estimate + effort_column * effort + gain * (sample - output @ estimate)
        x1, x2 = float(estimate[0, 0]), float(estimate[1, 0])
        if offset is not None:
            total += target - sample
        elif target - x1 <= distance and total > 0.0:
            offset = -x1
        effort = -gains.f12 * x2 + gains.f22 * total
        if offset is not None:
            effort -= gains.f11 * (x1 + offset)
        else:
            total += velocity - x2
        sample = float(plant_state[0, 0])
        plant_state = state[:2, :2] @ plant_state + effort_column[:2] * effort
        yield effort, Stage.SPEED if offset is None else Stage.POSITION


@pytest.mark.parametrize("gains", [SLOW, QUICK], ids=["example 1", "example 2"])
@pytest.mark.parametrize(("target", "velocity"), [(400.0, 100.0), (900.0, 250.0)])
def test_the_law_is_the_papers_law(gains: ServoGains, target: float, velocity: float) -> None:
    law = make_law(gains, acceleration=math.inf, effort=math.inf)
    run = Run(law)
    law.set_target(target, velocity)
    for effort, stage in paper_in_matrices(target, velocity, 700, gains):
        run.tick()
        assert run.efforts[-1] == pytest.approx(effort, rel=1e-9, abs=1e-9)
        assert law.stage is stage
    assert run.position == pytest.approx(target, abs=0.05)


@settings(max_examples=60, deadline=None)
@given(
    gain=st.floats(20.0, 500.0),
    pole=st.floats(2.0, 40.0),
    exponent=st.floats(-6.0, -2.5),
    target=st.floats(-2000.0, 2000.0),
    velocity=st.floats(5.0, 250.0),
    load=st.floats(-1.0, 1.0),
)
def test_the_changeover_leaves_the_effort_continuous(
    gain: float, pole: float, exponent: float, target: float, velocity: float, load: float
) -> None:
    """At the change-over tick both stages give the same effort, for any plant, gains, set-point and velocity."""
    plant = Plant(gain, pole).discretise(PERIOD_S)
    gains = servo_gains(plant, 10.0**exponent)
    observer = DisturbanceObserver(plant, kalman_gain(plant, NoiseModel()).predictor)
    law = TwoStageLaw(observer, gains, PERIOD_S, acceleration_limit=20.0 * velocity)
    assume(abs(target) > 2.0 * velocity * gains.changeover_time_s(PERIOD_S))
    run = Run(law, plant, load)
    law.set_target(target, velocity)
    for _ in range(round(abs(target) / velocity / PERIOD_S) + 3000):
        if law.stage is Stage.POSITION:
            break
        reference, sum_before = law.speed_reference, law._sum
        run.tick()
    else:
        pytest.fail("the change-over never came")
    speed_stage_effort = sum_before - gains.f12 * observer.velocity
    assert law.effort == pytest.approx(speed_stage_effort, rel=1e-12, abs=1e-12)
    assert law.changeovers == 1
    remaining = math.copysign(1.0, target) * (target - observer.position)
    assert 0.0 <= remaining <= abs(reference) * gains.changeover_time_s(PERIOD_S)


def test_the_effort_around_the_changeover_changes_no_more_than_in_the_cruise() -> None:
    law = make_law()
    run = Run(law)
    law.set_target(400.0, 100.0)
    while not law.changeovers:
        run.tick()
    changes = np.abs(np.diff(run.efforts[-20:]))
    assert changes[-1] <= changes[:-1].max() + 1e-3
    run.tick()
    # One tick on, the error is short of p by at most the tick's travel of 1 mm: f22 times that.
    assert abs(run.efforts[-1] - run.efforts[-2]) <= SLOW.f22 * 1.0 + 1e-3


@settings(max_examples=30, deadline=None)
@given(target=st.floats(-2000.0, 2000.0), velocity=st.floats(20.0, 250.0), gains=st.sampled_from([SLOW, QUICK]))
def test_every_move_arrives(target: float, velocity: float, gains: ServoGains) -> None:
    run = run_move(target, velocity, abs(target) / velocity + 6.0, gains)
    assert run.position == pytest.approx(target, abs=max(2e-4 * abs(target), 1e-6))
    assert abs(run.velocity) < 0.1


@settings(max_examples=20, deadline=None)
@given(target=st.floats(1.0, 2000.0), velocity=st.floats(20.0, 250.0))
def test_both_directions_are_mirror_images(target: float, velocity: float) -> None:
    assert run_move(-target, velocity, 3.0).efforts == [-effort for effort in run_move(target, velocity, 3.0).efforts]


def test_a_move_shorter_than_p_is_made_in_the_position_stage() -> None:
    run = Run(make_law())
    run.law.set_target(54.0, 100.0)
    run.tick()
    assert run.stage() is Stage.POSITION
    run.law.set_target(56.0, 100.0)
    assert run.stage() is Stage.SPEED
    run.seconds(6.0)
    assert run.position == pytest.approx(56.0, abs=1e-2)


@pytest.mark.parametrize("gains", [SLOW, QUICK], ids=["slow", "quick"])
@pytest.mark.parametrize("at_s", [0.05, 0.5, 2.0, 3.45, 3.6, 3.7, 4.0, 8.0])
@pytest.mark.parametrize(
    ("target", "velocity"), [(600.0, 100.0), (405.0, 50.0), (210.0, 100.0), (0.0, 200.0), (-300.0, 250.0)]
)
def test_a_new_set_point_in_mid_move_is_met_without_a_jump(
    gains: ServoGains, at_s: float, target: float, velocity: float
) -> None:
    run = Run(make_law(gains))
    run.law.set_target(400.0, 100.0)
    run.seconds(at_s)
    before = run.law.effort
    estimate = run.law.observer
    run.law.set_target(target, velocity)
    run.tick()
    # In its first tick a set-point changes the effort by one step of the sum and of the ramp, not more.
    largest = gains.f22 * max(100.0, abs(target - estimate.position)) + gains.f12 * 30.0 + gains.f11 * 3.0
    assert abs(run.law.effort - before) <= largest
    assert abs(run.law.effort - before) < 5.0
    run.seconds(12.0)
    assert run.position == pytest.approx(target, abs=0.01)
    assert max(map(abs, run.efforts)) <= 24.0


def test_a_set_point_too_near_to_brake_for_is_met_by_braking_first() -> None:
    """Entering the position stage at full speed 10 mm before the set-point would overrun it by far more."""
    run = Run(make_law())
    run.law.set_target(400.0, 100.0)
    run.seconds(2.0)
    near = run.position + 10.0
    run.law.set_target(near, 100.0)
    assert run.law.stage is Stage.SPEED
    run.seconds(8.0)
    assert max(run.positions) - near < 10.0
    assert run.position == pytest.approx(near, abs=0.01)


@pytest.mark.parametrize(("ahead", "velocity"), [(20.0, 30.0), (30.0, 10.0), (30.0, 100.0), (40.0, 60.0)])
def test_a_slower_and_nearer_set_point_is_not_overrun(ahead: float, velocity: float) -> None:
    """An operator who slows down near the end must not get more overshoot by it."""
    run = Run(make_law())
    run.law.set_target(400.0, 100.0)
    run.seconds(2.0)
    near = run.position + ahead
    run.law.set_target(near, velocity)
    run.seconds(8.0)
    assert max(run.positions) - near < 0.05 * ahead
    assert run.position == pytest.approx(near, abs=0.01)


@pytest.mark.parametrize("deceleration", [500.0, 2000.0, 1e5, 1e9])
def test_a_stop_ends_at_rest_whatever_its_slope(deceleration: float) -> None:
    run = Run(make_law(acceleration=deceleration))
    run.law.set_target(2000.0, 250.0)
    run.seconds(3.0)
    run.law.stop(deceleration)
    for _ in range(200):
        run.tick()
        if not run.stopping():
            break
    assert not run.stopping()
    assert abs(run.velocity) < 4.0


def test_a_stop_in_the_position_stage_begins_at_the_present_speed() -> None:
    run = Run(make_law())
    run.law.set_target(400.0, 100.0)
    run.seconds(3.9)
    assert run.stage() is Stage.POSITION
    speed, effort = run.velocity, run.law.effort
    assert speed > 60.0
    run.law.stop(200.0)
    run.tick()
    assert run.law.speed_reference == pytest.approx(speed - 2.0, abs=1.5)
    assert run.law.effort == pytest.approx(effort, abs=0.5)


def test_the_speed_reference_keeps_to_the_acceleration_limit() -> None:
    run = Run(make_law(acceleration=500.0))
    run.law.set_target(400.0, 100.0)
    references = [0.0]
    for _ in range(600):
        run.tick()
        if run.law.stage is Stage.SPEED:
            references.append(run.law.speed_reference)
    assert np.abs(np.diff(references)).max() == pytest.approx(5.0)
    assert max(references) == 100.0


def test_saturation_does_not_wind_up() -> None:
    """The quick gains ask for 19 units in the ramp; with 9, the cruise taking 7.8, the speed is overrun less."""
    free, limited = Run(make_law(QUICK)), Run(make_law(QUICK, effort=9.0))
    for run in (free, limited):
        run.law.set_target(400.0, 100.0)
        run.seconds(3.0)
    assert max(free.efforts) > 15.0
    assert max(limited.efforts) == 9.0
    assert limited.velocity == pytest.approx(100.0, abs=0.5)
    assert max(limited.velocities) < max(free.velocities)
    limited.seconds(6.0)
    assert limited.position == pytest.approx(400.0, abs=0.01)


def test_a_stall_is_left_without_a_surge() -> None:
    run = Run(make_law())
    run.law.set_target(400.0, 100.0)
    run.seconds(1.0)
    stuck = run.position
    for _ in range(500):  # held fast for 5 s, the effort at its limit
        run.law.step(stuck)
    assert run.law.effort == 24.0
    run.sample, run.velocity = stuck, 0.0
    run.seconds(6.0)
    assert max(run.velocities) < 320.0  # of which 24 units alone would give 308
    assert run.position == pytest.approx(400.0, abs=0.01)


@settings(max_examples=20, deadline=None)
@given(load=st.floats(-8.0, 8.0))
def test_a_constant_load_leaves_no_error(load: float) -> None:
    run = Run(make_law(), load=load)
    run.law.set_target(400.0, 100.0)
    assert run.seconds(12.0).position == pytest.approx(400.0, abs=1e-3)


def test_a_plant_30_percent_off_still_arrives() -> None:
    for gain, pole in ((234.0, 9.8), (126.0, 18.2)):
        run = Run(make_law(), Plant(gain, pole).discretise(PERIOD_S))
        run.law.set_target(400.0, 100.0)
        assert run.seconds(12.0).position == pytest.approx(400.0, abs=0.01)


@pytest.mark.parametrize("after_s", [0.03, 1.0, 3.8])
def test_a_stop_brakes_and_holds_where_it_comes_to_rest(after_s: float) -> None:
    run = Run(make_law())
    run.law.set_target(400.0, 100.0)
    run.seconds(after_s)
    start = run.position
    run.law.stop(2000.0)
    assert run.stopping()
    run.seconds(0.6)
    assert not run.stopping()
    assert run.law.stage is Stage.POSITION
    run.seconds(6.0)
    assert run.position == pytest.approx(run.law.target, abs=0.01)
    assert 0.0 <= run.position - start < 25.0
    assert abs(run.velocity) < 0.01


def test_skipped_periods_are_predicted() -> None:
    """A host suspended for 5 ticks at constant speed: the estimate is where the axis is, not where it was."""
    run = Run(make_law())
    run.law.set_target(400.0, 100.0)
    run.seconds(2.0)
    estimated = run.law.observer.position
    run.law.skip(5)
    assert run.law.observer.position - estimated == pytest.approx(5.0, abs=0.05)


def test_start_begins_with_no_effort_wherever_the_axis_is() -> None:
    law = make_law()
    law.observer.reset(-731.25)
    law.start()
    assert law.step(-731.25) == 0.0
    assert law.stage is Stage.POSITION


def test_a_law_that_continues_from_another_gives_the_same_efforts() -> None:
    run = Run(make_law())
    run.law.set_target(400.0, 100.0)
    run.seconds(1.23)
    twin = make_law()
    twin.continue_from(run.law)
    step: Callable[[float], float] = twin.step
    assert [step(400.0 - n) for n in range(300)] == [run.law.step(400.0 - n) for n in range(300)]


def test_a_law_that_continues_from_one_that_has_to_come_to_rest_first_does_so() -> None:
    """At 100 mm/s it is asked for a place 1 mm ahead: it brakes, and turns round."""
    run = Run(make_law())
    run.law.set_target(400.0, 100.0)
    run.seconds(2.0)
    run.law.set_target(run.law.observer.position + 1.0, 100.0)
    twin = make_law()
    twin.continue_from(run.law)
    assert twin.course() == run.law.course()
    assert twin.course().braking is True
    assert [twin.step(None) for _ in range(200)] == [run.law.step(None) for _ in range(200)]


@pytest.mark.parametrize("period_s", [0.001, 0.002, 0.005, 0.01])
def test_a_stop_ends_by_a_quarter_of_its_speed_in_10_ms_on_shorter_ticks_as_well(period_s: float) -> None:
    """By a quarter in each tick of 2 ms a healthy plant was reversed by 19 % of its speed."""
    assert (1.0 - ending_share(period_s)) ** (0.01 / period_s) == pytest.approx(0.75)


def test_a_stop_ends_by_a_quarter_of_its_speed_in_a_longer_tick() -> None:
    assert ending_share(0.02) == ending_share(0.1) == pytest.approx(0.25)
