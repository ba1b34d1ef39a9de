"""The speed reference of limited jerk: its bounds, where it ends, and how long it takes."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twostage_servo.control.laws.adaptive.design import AdaptiveDesign, design_adaptive
from twostage_servo.control.laws.adaptive.reference import Braking, Ways
from twostage_servo.control.laws.adaptive.smoothing import Smoothing, SmoothShape, next_slope
from twostage_servo.control.laws.law import ControlTask, Stage
from twostage_servo.control.laws.stop_design import smoothing_distance, smoothing_time_s
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

PLANT = Plant(180.0, 14.0)
WAYS = Ways.of(PLANT.discretise(0.01))


def task(period_s: float, acceleration: float, jerk: float) -> ControlTask:
    sampled, noise = PLANT.discretise(period_s), NoiseModel()
    return ControlTask(
        PLANT, sampled, period_s, noise, kalman_gain(sampled, noise), 250.0, acceleration, 24.0, 1000.0, 2.5, jerk
    )


def designed(made: ControlTask) -> AdaptiveDesign:
    return design_adaptive(made, 0.0, learns=False)


class Run:
    """A law on its own model: the axis is where the law takes it to be."""

    def __init__(self, period_s: float, acceleration: float, jerk: float) -> None:
        self.task = task(period_s, acceleration, jerk)
        self.law = designed(self.task).build(DisturbanceObserver(self.task.sampled, NO_CORRECTION))
        self.speeds = [0.0, 0.0]
        self.positions = [0.0]
        self.steps: list[float] = []  # of the effort, in the tick of a change-over

    def tick(self) -> None:
        law, before, stage = self.law, self.law.effort, self.law.stage
        law.step(None)
        if stage is Stage.SPEED and law.stage is Stage.POSITION:
            self.steps.append(abs(law.effort - before))
        self.speeds.append(law.speed_reference)
        self.positions.append(law.observer.position)

    def ticks(self, count: int) -> "Run":
        for _ in range(count):
            self.tick()
        return self

    def to_rest(self) -> "Run":
        law = self.law
        for _ in range(200_000):
            self.tick()
            if law.stage is Stage.POSITION and law.course.braking is None and law.speed_reference == 0.0:
                return self
        raise AssertionError("it does not come to rest")

    def check_bounds(self, velocity: float) -> None:
        """See that no bound is exceeded: velocity exactly, jerk by rounding, acceleration by a braking that is late."""
        period_s = self.task.period_s
        slopes = [(after - before) / period_s for before, after in pairwise(self.speeds)]
        jerks = [(after - before) / period_s for before, after in pairwise(slopes)]
        assert max(map(abs, self.speeds)) <= velocity * (1.0 + 1e-9)
        assert max(map(abs, slopes)) <= self.task.acceleration_limit / 0.9 * (1.0 + 1e-6)
        assert max(map(abs, jerks)) <= self.task.jerk * (1.0 + 1e-6)


PERIODS = st.sampled_from((0.001, 0.002, 0.005, 0.01, 0.02))
VELOCITIES = st.floats(2.0, 250.0)
ACCELERATIONS = st.floats(200.0, 2000.0)
DISTANCES = st.floats(0.05, 60.0)
RAMPS_S = st.floats(0.02, 0.4)
"""How long the acceleration takes to build up, a/j."""
SIGNS = st.sampled_from((-1.0, 1.0))


@settings(max_examples=60, deadline=None)
@given(PERIODS, VELOCITIES, ACCELERATIONS, RAMPS_S, DISTANCES, SIGNS)
def test_a_move_keeps_its_bounds_does_not_turn_and_ends_on_its_set_point(
    period_s: float, velocity: float, acceleration: float, ramp_s: float, distance: float, sign: float
) -> None:
    run = Run(period_s, acceleration, acceleration / ramp_s)
    run.law.set_target(sign * distance, velocity)
    run.to_rest()
    run.check_bounds(velocity)
    assert min(sign * speed for speed in run.speeds) >= -1e-9
    assert max(sign * position for position in run.positions) <= distance + 1e-6
    run.ticks(round(0.5 / period_s))
    assert run.positions[-1] == pytest.approx(sign * distance, abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    PERIODS, VELOCITIES, ACCELERATIONS, RAMPS_S, DISTANCES, st.floats(0.02, 0.98), st.floats(-1.5, 2.5),
    st.floats(0.3, 1.5),
)  # fmt: skip
def test_a_set_point_that_changes_on_the_way_keeps_the_bounds_and_is_met(
    period_s: float, velocity: float, acceleration: float, ramp_s: float, distance: float, share: float, other: float,
    speed: float,
) -> None:  # fmt: skip
    run = Run(period_s, acceleration, acceleration / ramp_s)
    expected_s = designed(run.task).move_duration_s(distance, velocity, 0.01)
    run.law.set_target(distance, velocity)
    run.ticks(max(1, round(share * expected_s / period_s)))
    run.law.set_target(other * distance, speed * velocity)
    run.to_rest()
    run.check_bounds(max(1.0, speed) * velocity)
    run.ticks(round(0.5 / period_s))
    assert run.positions[-1] == pytest.approx(other * distance, abs=1e-6)


def test_a_set_point_that_would_be_only_just_met_keeps_the_jerk() -> None:
    """A braking that was a little steeper than planned began with a tick of 1.03 j."""
    run = Run(0.001, 1265.0, 58_880.0)
    run.law.set_target(2.0, 2.0)
    run.ticks(20)
    run.law.set_target(0.04, 2.0)
    run.to_rest()
    run.check_bounds(2.0)


@settings(max_examples=60, deadline=None)
@given(PERIODS, VELOCITIES, ACCELERATIONS, RAMPS_S, st.floats(0.02, 3.0), st.booleans())
def test_a_smooth_stop_keeps_the_bounds_and_never_turns(
    period_s: float, velocity: float, acceleration: float, ramp_s: float, after_s: float, gradual: bool
) -> None:
    run = Run(period_s, acceleration, acceleration / ramp_s)
    run.law.set_target(1e4, velocity)
    run.ticks(max(1, round(after_s / period_s)))
    run.law.stop(acceleration, gradual=gradual, jerk=run.task.jerk)
    run.to_rest()
    run.check_bounds(velocity)
    assert min(run.speeds) >= -1e-9


def test_a_stop_that_has_no_time_for_it_brakes_at_once() -> None:
    smooth, at_once = Run(0.01, 1000.0, 5000.0), Run(0.01, 1000.0, 5000.0)
    for run, jerk in ((smooth, 5000.0), (at_once, math.inf)):
        run.law.set_target(1e4, 200.0)
        run.ticks(150)
        run.law.stop(4000.0, jerk=jerk)
        run.to_rest()
    # v²/2a, and what the S-curve adds: its slope has no time to come to 4000.
    assert smooth.positions[-1] - at_once.positions[-1] > 0.5 * 200.0 * math.sqrt(200.0 / 5000.0)
    falls = [before - after for before, after in pairwise(at_once.speeds)]
    assert max(falls) == pytest.approx(40.0)


def seven_segments_s(distance: float, velocity: float, acceleration: float, jerk: float) -> float:
    """Return how long the quickest S-curve from rest to rest takes, by hand.

    With the peaks v and a it takes ``d/v + v/a + a/j``. Each peak is its limit, or what the others leave: a is
    ``sqrt(v j)`` where the speed is too low for its limit; without a cruise, ``d = v (v/a + a/j)``, and without any
    constant acceleration ``d = 2 a³/j²``.
    """
    peak = min(acceleration, math.sqrt(velocity * jerk))
    if distance >= velocity * (velocity / peak + peak / jerk):
        return distance / velocity + velocity / peak + peak / jerk
    if distance <= 2.0 * acceleration**3 / jerk**2:
        return 4.0 * math.cbrt(distance / (2.0 * jerk))
    half = 0.5 * acceleration**2 / jerk
    top = -half + math.sqrt(half * half + acceleration * distance)
    return 2.0 * (top / acceleration + acceleration / jerk)


@settings(max_examples=40, deadline=None)
@given(VELOCITIES, ACCELERATIONS, RAMPS_S, st.floats(0.05, 400.0))
def test_seven_segments_by_hand_are_those_of_ruckig(
    velocity: float, acceleration: float, ramp_s: float, distance: float
) -> None:
    ruckig = pytest.importorskip("ruckig")
    asked, found = ruckig.InputParameter(1), ruckig.Trajectory(1)
    asked.current_position, asked.target_position = [0.0], [distance]
    jerk = acceleration / ramp_s
    asked.max_velocity, asked.max_acceleration, asked.max_jerk = [velocity], [acceleration], [jerk]
    ruckig.Ruckig(1).calculate(asked, found)
    assert seven_segments_s(distance, velocity, acceleration, jerk) == pytest.approx(found.duration, rel=1e-6)


@settings(max_examples=60, deadline=None)
@given(PERIODS, VELOCITIES, ACCELERATIONS, RAMPS_S, DISTANCES)
def test_a_move_takes_little_longer_than_the_quickest_one_in_continuous_time(
    period_s: float, velocity: float, acceleration: float, ramp_s: float, distance: float
) -> None:
    """Three ticks for what is whole ticks, and a ninth of the time in which braking builds up and ends."""
    jerk = acceleration / ramp_s
    run = Run(period_s, acceleration, jerk)
    run.law.set_target(distance, velocity)
    took_s = (len(run.to_rest().speeds) - 2) * period_s
    quickest_s = seven_segments_s(distance, velocity, acceleration, jerk)
    peak_s = min(ramp_s, math.sqrt(velocity / jerk))
    assert quickest_s - 1.0 * period_s <= took_s <= quickest_s + 3.0 * period_s + peak_s / 9.0


@settings(max_examples=60, deadline=None)
@given(PERIODS, VELOCITIES, ACCELERATIONS, RAMPS_S, DISTANCES)
def test_what_the_design_says_of_a_move_is_what_it_takes(
    period_s: float, velocity: float, acceleration: float, ramp_s: float, distance: float
) -> None:
    jerk = acceleration / ramp_s
    run = Run(period_s, acceleration, jerk)
    run.law.set_target(distance, velocity)
    took_s = (len(run.to_rest().speeds) - 2) * period_s
    said_s = designed(run.task).move_duration_s(distance, velocity, 1e-9)
    assert said_s == pytest.approx(took_s, abs=5.0 * max(period_s, 24.0 / 5000.0) + 0.02 * took_s)


@pytest.mark.parametrize("velocity", [20.0, 100.0, 250.0])
@pytest.mark.parametrize("jerk", [2000.0, 20_000.0])
def test_the_change_over_is_where_the_design_says(velocity: float, jerk: float) -> None:
    run = Run(0.01, 2000.0, jerk)
    run.law.set_target(400.0, velocity)
    while run.law.changeovers == 0:
        run.tick()
    said = designed(run.task).changeover_distance(velocity)
    assert 400.0 - run.positions[-1] == pytest.approx(said, abs=2.5 * velocity * 0.01)


def test_the_change_over_is_bumpless() -> None:
    """Before it the effort of a cruise is constant, and in its tick it is the same to the last bits."""
    run = Run(0.01, 2000.0, 10_000.0)
    run.law.set_target(400.0, 100.0)
    run.to_rest()
    assert run.steps == [pytest.approx(0.0, abs=1e-9)]


@given(st.floats(0.0, 200.0), st.floats(-20.0, 20.0), st.floats(200.0, 4000.0), st.floats(0.3, 5.0))
def test_the_way_of_the_average_is_that_of_its_speeds_one_by_one(
    ahead: float, slope: float, deceleration: float, step: float
) -> None:
    """Where the unaveraged reference stops at once, the axis goes what the shape says, and its last tap's share."""
    shape = SmoothShape.at(ahead, slope, deceleration, step, WAYS)
    taps = shape.history()
    lead = shape.lead()
    weights = [1.0] * (len(taps) - 1) + [shape.last_weight]
    assert sum(weights) == pytest.approx(shape.length)
    average = sum(weight * tap for weight, tap in zip(weights, taps, strict=True)) / shape.length
    assert average == pytest.approx(lead[-1] if lead else ahead, abs=1e-9)
    way = sum(WAYS.alpha * after + WAYS.beta * before for before, after in pairwise([ahead, *lead]))
    for index, weight in enumerate(weights):
        later = sum(WAYS.alpha * taps[j] + WAYS.beta * taps[j + 1] for j in range(index))
        way += weight * later / shape.length
    assert shape.way == pytest.approx(way, rel=1e-9, abs=1e-9)


@given(st.floats(20.0, 200.0), st.floats(200.0, 4000.0), st.floats(0.3, 5.0))
def test_a_braking_from_a_cruise_goes_what_it_says(speed: float, deceleration: float, step: float) -> None:
    shape = SmoothShape.at(speed, 0.0, deceleration, step, WAYS)
    left = speed * speed / (2.0 * deceleration) + 0.3 * speed * 0.01
    braking, speeds = Braking(shape, left, deceleration), [speed]
    while not braking.done:
        speeds.append(braking.advance(WAYS))
    way = sum(WAYS.alpha * after + WAYS.beta * before for before, after in pairwise(speeds))
    assert way == pytest.approx(left + shape.way, rel=1e-9)


@given(st.floats(-200.0, 200.0), st.floats(0.01, 5.0), st.floats(0.5, 30.0))
def test_slopes_end_with_the_speed_that_is_to_be_reached(left: float, step: float, most: float) -> None:
    slope, total = 0.0, abs(left)
    for _ in range(100_000):
        before, slope = slope, next_slope(slope, left, most, step)
        assert abs(slope - before) <= step * (1.0 + 1e-9)
        assert abs(slope) <= most * (1.0 + 1e-9)
        left -= slope
        if abs(left) <= 1e-9 * (1.0 + total):
            break
    assert abs(slope) <= step * (1.0 + 1e-9)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from((0.002, 0.01, 0.02)), st.floats(20.0, 250.0), ACCELERATIONS, RAMPS_S)
def test_a_smooth_stop_goes_no_farther_and_takes_no_longer_than_is_said(
    period_s: float, velocity: float, acceleration: float, ramp_s: float
) -> None:
    jerk = acceleration / ramp_s
    run = Run(period_s, acceleration, jerk)
    run.law.set_target(1e5, velocity)
    run.ticks(math.ceil((velocity / acceleration + 2.0 * ramp_s) / period_s) + 200)
    start, ticks = run.positions[-1], len(run.positions)
    run.law.stop(acceleration, gradual=True, jerk=jerk)
    run.to_rest()
    went, took_s = run.positions[-1] - start, (len(run.positions) - ticks) * period_s
    design = designed(run.task)
    said = design.stopping_distance(velocity, acceleration) + smoothing_distance(velocity, acceleration, jerk)
    assert went <= said * 1.05
    assert said <= 1.5 * went + 4.0 * velocity * period_s + 0.05 * velocity
    stopping_s = design.stopping_time_s(velocity, acceleration) + smoothing_time_s(velocity, acceleration, jerk)
    assert took_s <= stopping_s + 0.1


def smoothing(jerk: float = 10_000.0, rate: float = 1000.0) -> Smoothing:
    return Smoothing(replace(task(0.01, 2000.0, jerk), effort_rate_limit=rate))


@pytest.mark.parametrize(
    ("speed", "braking", "rate", "expected_s"),
    [
        (400.0, False, 1000.0, 0.4),  # 2000²/10000 mm/s: the acceleration reaches its limit, and falls at once
        (1000.0, False, 1000.0, 0.7),  # 0.5 s at the limit, and 0.2 s for the jerk
        (100.0, False, 1000.0, 0.2),  # twice the root of v/j
        (1000.0, True, 1000.0, 0.5 + 2.0 / 9.0),  # nine tenths of the jerk
        (100.0, True, 1000.0, 2.0 * (100.0 / 9000.0) ** 0.5),
        (100.0, False, 20.0, 2.0 * (100.0 / 2700.0) ** 0.5),  # three quarters of 20 V/s, times 180 mm/(V s²)
    ],
)
def test_a_change_of_speed_takes_as_long_as_its_s_curve(
    speed: float, braking: bool, rate: float, expected_s: float
) -> None:
    assert smoothing(rate=rate).change_s(speed, 2000.0, braking=braking) == pytest.approx(expected_s)


def test_a_move_takes_its_two_changes_of_speed_and_its_cruise() -> None:
    """Half of each change goes as far as a cruise in that time. Without a cruise ``v (r + b)/2`` is the distance."""
    rising, braking = 2.0 * (100.0 / 10_000.0) ** 0.5, 2.0 * (100.0 / 9000.0) ** 0.5
    made = smoothing()
    assert made.move_s(400.0, 100.0, 2000.0, 2000.0) == pytest.approx(4.0 + 0.5 * (rising + braking))
    both = 10_000.0**-0.5 + 9000.0**-0.5
    top = (2.0 / both) ** (2.0 / 3.0)
    assert top < 100.0
    assert made.move_s(2.0, 100.0, 2000.0, 2000.0) == pytest.approx(2.0 * top**0.5 * both)
    # 1500 mm/s²: what braking builds up in 1/6 s, and what the rise of 1000 mm/s² does in 0.1 s
    assert made.move_s(9000.0, 900.0, 1000.0, 1500.0) == pytest.approx(10.0 + 0.5 * (0.9 + 0.1 + 0.6 + 1.0 / 6.0))


@pytest.mark.parametrize(
    ("speed", "slope", "most", "expected"),
    [
        (100.0, 0.0, 2000.0, (9000.0 * 100.0) ** 0.5),  # A² = j v, of nine tenths of the jerk
        (100.0, 3.0, 2000.0, (9000.0 * (100.0 + 9.0 / 1.8)) ** 0.5),  # the slope runs out 5 mm/s higher
        (100.0, -3.0, 2000.0, (9000.0 * (100.0 + 9.0 / 1.8)) ** 0.5),
        (100.0, 0.0, 500.0, 500.0),
        (0.0, 0.0, 2000.0, 90.0),  # one step in a tick
        (-10.0, 3.0, 2000.0, (9000.0 * 9.0 / 1.8) ** 0.5),
    ],
)
def test_braking_takes_the_least_time_where_its_square_is_jerk_times_speed(
    speed: float, slope: float, most: float, expected: float
) -> None:
    made = smoothing()
    assert made.step(180.0) == pytest.approx(1.0)  # 10000 mm/s³ in ticks of 10 ms
    assert made.deceleration(speed, slope, made.step(180.0), most, 0.01) == pytest.approx(expected)


@pytest.mark.parametrize("jerk", [500.0, 20_000.0])
@pytest.mark.parametrize("speed", [1.0, -3.0, 40.0])
def test_an_s_curve_takes_longer_than_its_ramp_by_the_time_of_its_jerk_or_as_two_triangles(
    speed: float, jerk: float
) -> None:
    """With 0.85 of the jerk: a/j more where it gets to the ramp's slope; else two triangles, ``sqrt(v/j)`` each."""
    most, planned = 2000.0, 0.85 * jerk
    reaches = abs(speed) >= most**2 / planned
    whole_s = abs(speed) / most + most / planned if reaches else 2.0 * math.sqrt(abs(speed) / planned)
    assert smoothing_time_s(speed, most, jerk) == pytest.approx(whole_s - abs(speed) / most)
    assert smoothing_distance(speed, most, jerk) == pytest.approx(0.5 * abs(speed) * (whole_s - abs(speed) / most))


def test_both_kinds_of_an_s_curve_meet_where_it_just_gets_to_the_slope_of_the_ramp() -> None:
    speed = 2000.0**2 / (0.85 * 20_000.0)
    below, at = (smoothing_time_s(share * speed, 2000.0, 20_000.0) for share in (1.0 - 1e-9, 1.0))
    assert below == pytest.approx(at)
    assert at == pytest.approx(2000.0 / 17_000.0)


@pytest.mark.parametrize(
    ("slope", "runs", "fallen"),
    [(3.0, 2, 0.0), (2.0, 1, 0.0), (0.5, 1, 0.0), (0.0, 0, 0.0), (-1.8, 0, 1.0), (-6.3, 0, 3.5)],
)
def test_a_braking_goes_on_with_the_slope_that_there_is(slope: float, runs: int, fallen: float) -> None:
    """Planned with 0.9 of 2 mm/s a tick: a slope of -1.8 mm/s is that of a tick of it. A rise runs out by 2 mm/s."""
    shape = SmoothShape.at(100.0, slope, 1000.0, 2.0, WAYS)
    assert shape.runs == runs
    assert shape.fallen == pytest.approx(fallen)


@pytest.mark.parametrize(
    ("slope", "deceleration", "fall"),
    [(0.0, 1000.0, 10.0), (-12.0, 1000.0, 12.0), (12.0, 1000.0, 10.0), (0.0, 100.0, 1.8), (-1.0, 100.0, 1.8)],
)
def test_the_unaveraged_reference_falls_by_its_deceleration_the_slope_that_there_is_or_a_step_of_the_jerk(
    slope: float, deceleration: float, fall: float
) -> None:
    assert SmoothShape.at(100.0, slope, deceleration, 2.0, WAYS).fall == pytest.approx(fall)
