"""Which stage a set-point enters, and what is left of the other: by hand, with a change-over time of half a second."""

import math

import pytest

from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver
from twostage_servo.control.optimal import ServoGains
from twostage_servo.control.plant import DiscretePlant

MASS = DiscretePlant(period_s=0.01, a12=0.01, a22=1.0, b1=0.0, b2=2.0)
GAINS = ServoGains(f11=0.4, f12=0.02, f22=0.008)


def law_at(position: float, velocity: float = 0.0, *, effort_rate: float = math.inf) -> TwoStageLaw:
    law = TwoStageLaw(DisturbanceObserver(MASS, NO_CORRECTION), GAINS, 0.01, effort_rate_limit=effort_rate)
    law.observer.reset(position)
    law.start()
    law.observer.velocity = velocity
    return law


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize(
    ("distance", "approach", "stage"),
    [
        (49.0, 0.0, Stage.POSITION),  # within the 50 that a cruise at 100 takes
        (51.0, 0.0, Stage.SPEED),
        (40.0, 89.0, Stage.POSITION),  # 80 is the speed for 40, and a tenth of the cruise is tolerated
        (40.0, 91.0, Stage.SPEED),
        (40.0, -9.0, Stage.POSITION),
        (40.0, -11.0, Stage.SPEED),
    ],
)
def test_the_stage_that_a_set_point_enters(direction: float, distance: float, approach: float, stage: Stage) -> None:
    law = law_at(7.0, direction * approach)
    law.set_target(7.0 + direction * distance, 100.0)
    assert law.stage is stage


@pytest.mark.parametrize("speed", [3.5, 10.0, 1000.0])
def test_steps_that_shrink_by_the_rate_of_the_effort_take_the_whole_speed_away(speed: float) -> None:
    """An effort rate of 150/s is 1.5 in a tick, a change of speed by r = 3: ``s + s (s - 3) / 6`` for a step s."""
    step = law_at(0.0, effort_rate=150.0).stop_stage._steepest_step(speed)
    assert step + step * (step - 3.0) / 6.0 == pytest.approx(speed)


@pytest.mark.parametrize("speed", [1e-300, 0.5, 3.0])
def test_a_speed_that_the_rate_takes_away_in_a_tick_goes_in_one_step(speed: float) -> None:
    assert law_at(0.0, effort_rate=150.0).stop_stage._steepest_step(speed) == speed


def test_without_a_limit_to_the_rate_any_step_will_do() -> None:
    assert law_at(0.0).stop_stage._steepest_step(10.0) == math.inf


def test_in_the_position_stage_no_speed_is_asked_for() -> None:
    law = law_at(0.0)
    law.set_target(100.0, 100.0)
    law.step(0.0)
    assert law.speed_reference == 100.0
    law.observer.position, law.observer.velocity = 60.0, 100.0
    law.step(None)
    assert law.speed_reference == 0.0
    assert law.changeovers == 1
    law.set_target(200.0, 100.0)
    law.observer.position, law.observer.velocity = 155.0, 100.0
    law.step(None)
    assert law.changeovers == 2


def braking_at_60() -> TwoStageLaw:
    """Return a law that runs at 100 with 40 left, for which 80 would do, so that it brakes in the speed stage."""
    law = law_at(60.0, 100.0)
    law.set_target(100.0, 100.0)
    return law


@pytest.mark.parametrize(("velocity", "stage"), [(81.0, Stage.SPEED), (79.0, Stage.POSITION)])
def test_braking_ends_at_the_speed_at_which_half_a_second_is_left(velocity: float, stage: Stage) -> None:
    law = braking_at_60()
    law.observer.position, law.observer.velocity = 60.0 - 0.01 * velocity, velocity
    law.step(None)
    assert law.stage is stage


def test_who_passes_the_set_point_while_braking_turns_round_in_the_speed_stage() -> None:
    law = braking_at_60()
    law.observer.position, law.observer.velocity = 101.0, 80.0
    law.step(None)
    assert law.stage is Stage.SPEED
    assert law.speed_reference == -100.0


def test_while_braking_no_speed_is_asked_for() -> None:
    law = braking_at_60()
    law.step(None)
    assert law.stage is Stage.SPEED
    assert law.speed_reference == 0.0


def test_the_position_stage_is_entered_however_little_is_left() -> None:
    law = law_at(0.0)
    law.set_target(200.0, 100.0)
    law.step(0.0)
    law.observer.velocity = 100.0 - MASS.b2 * law.effort
    law.observer.position = 199.5 - MASS.a12 * law.observer.velocity
    law.step(None)
    assert law.observer.position == pytest.approx(199.5)
    assert law.stage is Stage.POSITION


@pytest.mark.parametrize("target", [0.0, 1e6], ids=["position stage", "speed stage"])
def test_no_tick_changes_the_effort_by_more_than_its_rate_or_leaves_its_limit(target: float) -> None:
    """The sum is set so that each tick wants the effort that is given: within both, beyond one, beyond both."""
    law = TwoStageLaw(
        DisturbanceObserver(MASS, NO_CORRECTION), GAINS, 0.01,
        acceleration_limit=0.0, effort_limit=10.0, effort_rate_limit=600.0,
    )  # fmt: skip
    law.set_target(target, 100.0)
    met = []
    for wanted in (3.0, 8.5, 11.0, 4.5, -1.0, -7.0, 7.0, 20.0, -20.0, -20.0, 5.0, -0.5, -9.0, -10.5, -4.0, 2.0, -2.0):
        before = law.effort
        law._sum, law.observer.velocity, law.observer.disturbance = wanted, 0.0, -before
        effort = law.step(0.0)
        at_limit = max(-10.0, min(10.0, wanted))
        assert effort == law.effort == pytest.approx(max(before - 6.0, min(before + 6.0, at_limit)))
        assert law.saturated is (abs(wanted) > 10.0)
        assert law._sum == pytest.approx(effort)
        met.append((law.saturated, effort == pytest.approx(at_limit)))
    assert set(met) == {(True, True), (True, False), (False, True), (False, False)}
