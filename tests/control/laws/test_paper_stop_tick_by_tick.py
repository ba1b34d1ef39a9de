"""A stop in single ticks, on an axis of mass 1 without friction: an effort of 1 changes its speed by 1 in a tick."""

import math

import pytest

from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver
from twostage_servo.control.optimal import ServoGains
from twostage_servo.control.plant import DiscretePlant

MASS = DiscretePlant(period_s=0.01, a12=0.01, a22=1.0, b1=0.0, b2=1.0)
GAINS = ServoGains(f11=0.4, f12=0.02, f22=0.008)


def law_at(velocity: float, *, effort_limit: float = math.inf, rest_velocity: float = 0.0) -> TwoStageLaw:
    """Return a law whose observer believes its own model alone, and knows the axis to run at a speed."""
    law = TwoStageLaw(
        DisturbanceObserver(MASS, NO_CORRECTION), GAINS, 0.01, effort_limit=effort_limit, rest_velocity=rest_velocity
    )
    law.observer.velocity = velocity
    return law


def step_at(law: TwoStageLaw, velocity: float) -> Stage:
    """Make a step in which the speed is this one, whatever the effort before."""
    law.observer.velocity = velocity - law.effort
    law.step(None)
    assert law.observer.velocity == pytest.approx(velocity)
    return law.stage


def test_a_stop_at_rest_is_done_in_the_third_tick_and_each_time_anew() -> None:
    law = law_at(0.0)
    for _ in range(2):
        law.stop(1000.0)
        assert [step_at(law, 0.0) for _ in range(3)] == [Stage.BRAKE, Stage.BRAKE, Stage.POSITION]


def test_a_speed_above_that_of_rest_begins_the_count_again() -> None:
    law = law_at(0.0, rest_velocity=2.5)
    law.stop(1000.0)
    stages = [step_at(law, velocity) for velocity in (1.0, -1.0, 3.0, 1.0, 2.0, -2.0)]
    assert stages == [Stage.BRAKE] * 5 + [Stage.POSITION]


def test_an_axis_that_stands_before_its_ramp_has_ended_waits_for_it() -> None:
    """From 100 by 10 a tick the reference is at zero in the eleventh tick, and has to be there for three."""
    law = law_at(100.0)
    law.stop(1000.0)
    stages = [step_at(law, 0.0) for _ in range(13)]
    assert stages == [Stage.BRAKE] * 12 + [Stage.POSITION]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_ramp_goes_on_from_the_speed_that_the_limit_lets_it_reach(sign: float) -> None:
    law = law_at(sign * 100.0, effort_limit=1.0)
    law.stop(1000.0)
    step_at(law, sign * 100.0)
    assert law.effort == -sign
    assert law.speed_reference == pytest.approx(sign * 99.0)


def test_the_ramp_goes_on_from_a_creep_as_well() -> None:
    law = law_at(1.0, effort_limit=0.2)
    law.stop(1000.0)
    law.step(None)
    assert law.speed_reference == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("reference", "velocity", "limit", "effort", "after"),
    [
        (100.0, 100.0, 12.0, -10.0, 90.0),  # no limit in the way
        (100.0, 50.0, 1.0, 1.0, 90.0),  # slower than the ramp already: -10, and 0.3 for each of the 50 that are missing
        (5.0, -100.0, 1.0, 1.0, 0.0),  # pushed back: what is reached lies behind
        (0.0, 100.0, 1.0, -1.0, 0.0),  # the ramp is over
    ],
)
def test_the_ramp_is_not_changed_by_what_else_the_limit_withholds(
    reference: float, velocity: float, limit: float, effort: float, after: float
) -> None:
    law = law_at(reference, effort_limit=limit)
    law.stop(1000.0)
    law.observer.velocity = velocity
    law.step(None)
    assert law.effort == pytest.approx(effort)
    assert law.speed_reference == pytest.approx(after)


def test_the_distance_to_the_set_point_has_no_sign() -> None:
    law = law_at(0.0)
    law.observer.position = 30.0
    for target, distance in ((100.0, 70.0), (-10.0, 40.0)):
        law.set_target(target, 1.0)
        assert law.distance == distance


def test_a_law_that_starts_has_forgotten_what_it_did() -> None:
    law = law_at(-300.0, effort_limit=1.0)
    law.set_target(500.0, 100.0)
    for _ in range(3):
        law.step(None)
    assert law.saturated
    assert law.sample_age == 1
    law.observer.reset(731.25)
    law.start()
    forgotten = (law.stage, law.target, law.cruise_velocity, law.speed_reference, law.effort, law.saturated)
    assert forgotten == (Stage.POSITION, 731.25, 0.0, 0.0, 0.0, False)
    assert type(law.saturated) is bool
    assert law.step(731.25) == 0.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("wanted", "effort", "saturated"), [(0.7, 0.5, True), (0.5, 0.5, False), (0.25, 0.25, False)])
def test_an_effort_is_cut_beyond_its_limit_and_not_at_it(
    sign: float, wanted: float, effort: float, saturated: bool
) -> None:
    """What takes a speed away in one tick is that speed, for a mass of 1."""
    law = law_at(-sign * wanted, effort_limit=0.5)
    law.stop(1000.0)
    assert law.step(None) == sign * effort
    assert law.saturated is saturated


def test_unless_told_otherwise_only_no_speed_at_all_is_rest() -> None:
    law = TwoStageLaw(DisturbanceObserver(MASS, NO_CORRECTION), GAINS, 0.01)
    law.stop(1000.0)
    assert {step_at(law, 0.001) for _ in range(10)} == {Stage.BRAKE}


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_gradual_stop_takes_no_more_than_a_quarter_of_the_speed_in_a_tick(sign: float) -> None:
    """By 10 a tick down to 40, of which that is a quarter."""
    law = law_at(sign * 70.0)
    law.stop(1000.0, gradual=True)
    references = []
    for _ in range(6):
        law.step(None)
        references.append(sign * law.speed_reference)
    assert references == pytest.approx([60.0, 50.0, 40.0, 30.0, 22.5, 16.875])


def test_a_stop_that_is_not_gradual_takes_all_of_the_speed_that_its_ramp_does() -> None:
    law = law_at(70.0)
    law.stop(1000.0, gradual=True)
    law.step(None)
    law.stop(1e6)
    law.step(None)
    assert law.speed_reference == 0.0


@pytest.mark.parametrize(
    ("period_s", "after", "last"), [(0.002, 100.0 * 0.75**0.2, 1.0 - 0.75**0.2), (0.01, 75.0, 0.25), (0.04, 75.0, 0.25)]
)
def test_a_gradual_stop_ends_by_the_share_of_the_speed_of_rest(period_s: float, after: float, last: float) -> None:
    """From 100 by its share; from 9, with a rest of 8, by that share of 8 at least, or it would never end."""
    mass = DiscretePlant(period_s=period_s, a12=period_s, a22=1.0, b1=0.0, b2=1.0)
    law = TwoStageLaw(DisturbanceObserver(mass, NO_CORRECTION), GAINS, period_s, rest_velocity=8.0)
    law.observer.velocity = 100.0
    law.stop(1e6, gradual=True)
    law.step(None)
    assert law.speed_reference == pytest.approx(after)
    law.stop_stage.state.speed_reference = 4.0
    law.observer.velocity = 4.0 - law.effort
    law.step(None)
    assert law.speed_reference == pytest.approx(4.0 - 8.0 * last)


def test_friction_that_the_model_does_not_have_falls_with_the_speed() -> None:
    """At 0.1 a mm/s, 10 mm/s less take 1 from the disturbance that held it, so that much less brakes."""
    law = law_at(100.0)
    law.stop(1000.0, friction=0.1)
    assert law.step(None) == pytest.approx(-10.0)
    assert law.observer.disturbance == 0.0
    assert law.step(None) == pytest.approx(-10.0 + 1.0)
    assert law.observer.disturbance == pytest.approx(-1.0)
    assert law.step(None) == pytest.approx(-10.0 + 2.0)


def test_a_law_that_continues_from_one_that_stops_stops_as_gradually_and_with_the_same_friction() -> None:
    law, twin = law_at(100.0), law_at(-3.0)
    law.stop(1e6, friction=0.1, gradual=True)
    law.step(None)
    twin.continue_from(law)
    efforts = [law.step(None) for _ in range(5)]
    assert [twin.step(None) for _ in range(5)] == efforts
    assert law.speed_reference == twin.speed_reference == pytest.approx(100.0 * 0.75**6)


@pytest.mark.parametrize(
    ("speed", "step"),
    [
        (1.0, 0.25),  # a quarter of the speed
        (13.6, 3.4),  # as far up as such a step is 0.85/0.25 at most: from there on it becomes smaller by 0.85 a tick
        (17.85, 4.25),  # one that is larger by 0.85 leads there
        (22.95, 5.1),
    ],
)
def test_a_smooth_stop_plans_its_end_with_most_of_its_jerk(speed: float, step: float) -> None:
    """On a tick of 10 ms, with steps that may change by 1 in a tick, of which it takes 0.85."""
    stop = law_at(speed).stop_stage
    stop.begin(speed)
    stop.aim(1e9, 0.0, gradual=True, jerk=1e4)
    for before in (step - 0.9, step, step + 0.9):
        stop.state.step = before
        assert stop._smooth_step(speed) == pytest.approx(step)
    stop.state.step = step + 1.1
    assert stop._smooth_step(speed) == pytest.approx(min(step + 0.1, speed))
