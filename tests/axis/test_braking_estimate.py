"""What an axis brakes on, where its plant is off its model or its last samples are in doubt."""

import itertools
import math
from pathlib import Path

import pytest

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.braking_estimate import BrakingEstimate
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.state import State
from twostage_servo.config.loader import load
from twostage_servo.control.plant import Plant

EXAMPLE_2 = design_axis(load(Path("config/example2.toml")).config.axis, PERIOD_S)
"""Its true plant has 30 % more gain and 30 % less of a pole."""


def moving(ticks: int) -> AxisRig:
    rig = AxisRig(Axis(EXAMPLE_2, TRAITS), Plant(234.0, 9.8)).armed()
    rig.axis.move_to(150.0, 100.0)
    rig.seconds(ticks * PERIOD_S)
    return rig


def way_until_disabled(rig: AxisRig) -> float:
    """Return the largest distance from here until long after the drive has been disabled."""
    start, farthest = rig.position, 0.0
    for _ in range(200):
        rig.tick()
        farthest = max(farthest, abs(rig.position - start))
    assert rig.axis.state is State.TRIPPED
    return farthest


@pytest.mark.parametrize("ticks", range(150, 185, 5))
def test_a_stop_without_feedback_does_not_turn_an_axis_round_whose_model_is_wrong(ticks: int) -> None:
    """The observer takes 15 mm/s for 28 mm/s in the position stage; braking on that reversed the axis."""
    rig = moving(ticks)
    assert rig.state() is State.POSITION_STAGE
    speed = abs(rig.velocity)
    rig.silent = True
    # 50 ms until it is noticed and acted on; then it does not go farther than without any effort.
    assert way_until_disabled(rig) <= speed * (0.05 + 1.0 / 9.8)


@pytest.mark.parametrize("ticks", range(150, 185, 5))
def test_an_operators_stop_does_not_either(ticks: int) -> None:
    rig = moving(ticks)
    speed, start, farthest = abs(rig.velocity), rig.position, 0.0
    rig.axis.stop()
    for _ in range(100):
        rig.tick()
        farthest = max(farthest, abs(rig.position - start))
    assert rig.state() is State.HOLDING
    assert farthest <= speed * (0.03 + 1.0 / 9.8)


def test_what_the_corrections_do_in_a_tick_is_in_the_estimate() -> None:
    """Corrected no more, the estimate goes on as it did while a standing innovation corrected it."""
    observer = EXAMPLE_2.build_law().observer
    braking = BrakingEstimate(EXAMPLE_2)
    observer.position, observer.velocity, observer.disturbance = 10.0, 50.0, 1.0
    for _ in range(60):
        observer.update(observer.position - 0.1, 3.0)
        braking.update(observer, 3.0, corrected=True, sure=True)
    position, velocity, disturbance = observer.position, observer.velocity, observer.disturbance
    observer.update(position - 0.1, 3.0)
    corrected = observer.position - position
    observer.position, observer.velocity, observer.disturbance = position, velocity, disturbance
    braking.apply(observer, in_doubt=False)
    assert abs(observer.velocity - velocity) > 5.0
    observer.predict(3.0)
    assert observer.position - position == pytest.approx(corrected, abs=0.02)


def test_a_model_that_is_right_brakes_on_its_own_estimate() -> None:
    observer = EXAMPLE_2.build_law().observer
    braking = BrakingEstimate(EXAMPLE_2)
    observer.velocity = 50.0
    for _ in range(20):
        observer.predict(2.0)
        braking.update(observer, 2.0, corrected=True, sure=True)
    before = observer.velocity, observer.disturbance
    braking.apply(observer, in_doubt=False)
    assert (observer.velocity, observer.disturbance) == before
    braking.apply(observer, in_doubt=True)
    assert (observer.velocity, observer.disturbance) == pytest.approx(before)


def test_samples_in_doubt_are_left_out_of_it() -> None:
    observer = EXAMPLE_2.build_law().observer
    braking = BrakingEstimate(EXAMPLE_2)
    observer.velocity = 50.0
    for _ in range(20):
        observer.predict(5.0)
        braking.update(observer, 5.0, corrected=True, sure=True)
    wanted = EXAMPLE_2.build_law().observer
    wanted.continue_from(observer)
    for _ in range(3):
        observer.update(observer.position - 2.0, 5.0)  # an encoder that stands still, say
        braking.update(observer, 5.0, corrected=True, sure=False)
        wanted.predict(5.0)
    assert abs(observer.velocity - wanted.velocity) > 10.0
    braking.apply(observer, in_doubt=True)
    assert observer.velocity == pytest.approx(wanted.velocity)
    assert observer.disturbance == pytest.approx(wanted.disturbance)


@pytest.mark.parametrize(("innovation", "speed"), [(-50.0, 0.0), (50.0, 40.0)])
def test_what_stands_changes_the_speed_by_no_more_than_the_speed_itself(innovation: float, speed: float) -> None:
    """More than that is what late samples have left; the disturbance keeps the speed as it is then."""
    observer = EXAMPLE_2.build_law().observer
    braking = BrakingEstimate(EXAMPLE_2)
    observer.innovation = innovation
    for velocity in (20.0, -20.0):
        observer.velocity = 0.0
        braking.start(observer, 0.0)
        observer.disturbance = 0.5
        for _ in range(60):
            observer.velocity = velocity
            observer.innovation = math.copysign(innovation, innovation * velocity)
            braking.update(observer, 0.0, corrected=True, sure=True)
        braking.apply(observer, in_doubt=False)
        assert observer.velocity == pytest.approx(math.copysign(speed, velocity), abs=1e-9)
        assert math.copysign(observer.disturbance - 0.5, innovation * velocity) == observer.disturbance - 0.5
        again = observer.velocity, observer.disturbance
        braking.apply(observer, in_doubt=False)  # it was taken into the estimate once
        assert (observer.velocity, observer.disturbance) == again


def test_from_its_start_on_a_model_without_sure_samples_runs_on_by_the_effort() -> None:
    braking, wanted = BrakingEstimate(EXAMPLE_2), EXAMPLE_2.build_law().observer
    wanted.velocity, wanted.disturbance = 30.0, 0.7
    braking.start(wanted, 4.0)
    observer = EXAMPLE_2.build_law().observer
    for before, effort in itertools.pairwise((4.0, -2.0, 1.0, 0.0)):
        wanted.predict(before)
        braking.update(observer, effort, corrected=False, sure=False)
    braking.apply(observer, in_doubt=True)
    assert (observer.velocity, observer.disturbance) == pytest.approx((wanted.velocity, wanted.disturbance))


@pytest.mark.parametrize(("notes", "share"), [(1, 0.2), (2, 0.36), (3, 0.488)])
def test_an_innovation_stands_when_it_lasts(notes: int, share: float) -> None:
    """A fifth of what is new in each tick; a tick without a sample changes nothing."""
    observer = EXAMPLE_2.build_law().observer
    braking = BrakingEstimate(EXAMPLE_2)
    observer.velocity, observer.innovation = 100.0, 0.1
    for _ in range(notes):
        braking.update(observer, 0.0, corrected=True, sure=True)
        braking.update(observer, 0.0, corrected=False, sure=True)
    braking.apply(observer, in_doubt=False)
    gain1, gain2, _ = EXAMPLE_2.kalman.predictor
    gone = share * 0.1 * gain1 / EXAMPLE_2.plant.a12
    assert observer.velocity == pytest.approx(100.0 + gone)
    lasting = gain2 * share * 0.1 + (1.0 - EXAMPLE_2.plant.a22) * gone
    assert observer.disturbance == pytest.approx(lasting / EXAMPLE_2.plant.b2)
