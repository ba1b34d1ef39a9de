"""The speed override: at any time and smooth, under each law; 0 holds the axis, which keeps its set-point."""

import math
import random
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from tests.axis.rig import DEMO, PERIOD_S, TRAITS, AxisRig
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.speed_override import SpeedOverride
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.plant import Plant

LAWS = ("paper", "adaptive")
VELOCITY_LIMIT = 250.0
LARGEST_STEP = 10.0 + 1e-9
"""1000 V/s in a tick of 10 ms."""
SLOPE = 2000.0 * PERIOD_S + 1e-9
"""The acceleration limit in a tick, in mm/s."""


def rig_of(law: str, gain: float = 1.0, pole: float = 1.0, **tables: Any) -> AxisRig:
    """Return an armed axis whose plant has these multiples of the model's gain and pole."""
    settings = AxisSettings.model_validate(DEMO | {"law": {"type": law}} | tables)
    return AxisRig(Axis(design_axis(settings, PERIOD_S), TRAITS), Plant(180.0 * gain, 14.0 * pole)).armed()


def until(rig: AxisRig, condition: Callable[[], bool], longest_s: float = 60.0) -> AxisRig:
    for _ in range(round(longest_s / PERIOD_S)):
        if condition():
            return rig
        rig.tick()
    raise AssertionError(f"not within {longest_s:g} s: {rig.state()} at {rig.position:g}")


def outcome(rig: AxisRig) -> str:
    assert rig.axis.trip is None, rig.axis.trip.cause
    assert rig.axis.move is not None
    return rig.axis.move.outcome


def efforts(rig: AxisRig) -> list[float]:
    return [command.effort for command in rig.commands]


def same(*rigs: AxisRig) -> bool:
    return all(efforts(rig) == efforts(rigs[0]) for rig in rigs)


# Smooth ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("percent", [25.0, 60.0, 200.0])
@pytest.mark.parametrize("at_s", [0.0, 0.03, 1.0])
def test_it_is_to_the_effort_what_a_move_at_that_speed_is(law: str, percent: float, at_s: float) -> None:
    overridden, moved = rig_of(law), rig_of(law)
    for rig in (overridden, moved):
        rig.axis.move_to(400.0, 100.0)
        rig.seconds(at_s)
    overridden.axis.set_override(percent)
    moved.axis.move_to(400.0, 100.0 * percent / 100.0)
    for rig in (overridden, moved):
        until(rig, lambda rig=rig: outcome(rig) == "reached")  # type: ignore[misc]
    assert same(overridden, moved)
    assert overridden.position == pytest.approx(400.0, abs=0.06)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("percent", [100.0, 200.0])
def test_what_closes_in_on_its_set_point_is_not_hurried(law: str, percent: float) -> None:
    overridden, left_alone = rig_of(law), rig_of(law)
    for rig in (overridden, left_alone):
        rig.axis.move_to(100.0, 100.0)
        until(rig, lambda rig=rig: rig.state() is State.POSITION_STAGE)  # type: ignore[misc]
    overridden.axis.set_override(percent)
    for rig in (overridden, left_alone):
        until(rig, lambda rig=rig: outcome(rig) == "reached")  # type: ignore[misc]
    assert same(overridden, left_alone)


@pytest.mark.parametrize("law", LAWS)
def test_what_closes_in_on_its_set_point_may_be_slowed_down(law: str) -> None:
    rig = rig_of(law)
    rig.axis.move_to(200.0, 200.0)
    until(rig, lambda: rig.state() is State.POSITION_STAGE)
    rig.axis.set_override(5.0)
    assert rig.state() is State.SPEED_STAGE
    until(rig, lambda: outcome(rig) == "reached")
    assert rig.position == pytest.approx(200.0, abs=0.06)


def tick_within_limits(rig: AxisRig) -> None:
    """Let a tick pass in which nothing trips, and neither effort nor reference changes faster than it may."""
    axis = rig.axis
    effort, reference, stage = rig.commands[-1].effort, axis.speed_reference, axis.stage
    rig.tick()
    assert axis.trip is None, axis.trip.cause
    assert abs(rig.commands[-1].effort - effort) <= LARGEST_STEP
    assert axis.cruise_velocity <= VELOCITY_LIMIT
    if axis.stage is stage is Stage.SPEED:
        assert abs(axis.speed_reference - reference) <= SLOPE


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("jogs", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_whatever_it_is_changed_to_and_when_a_healthy_axis_goes_on(law: str, jogs: bool, seed: int) -> None:
    """Plants up to 20 % off, a load and noise: limits are kept, nothing trips, and the set-point is reached."""
    rng = random.Random(seed)  # noqa: S311 - a test
    rig = rig_of(law, rng.uniform(0.8, 1.2), rng.uniform(0.8, 1.2))
    rig.load = rng.uniform(-0.5, 0.5)
    rig.sees = lambda position: round(position + rng.gauss(0.0, 0.01), 3)
    rig.seconds(0.5)
    axis, velocity, target = rig.axis, rng.uniform(5.0, 80.0), rng.choice((-1.0, 1.0)) * rng.uniform(1.0, 600.0)
    signed = math.copysign(velocity, target)
    if jogs:
        axis.jog(signed)
    else:
        axis.move_to(target, velocity)
    for _ in range(20):
        percent = rng.choice((0.0, 0.0, 100.0, 200.0, rng.uniform(0.0, 200.0), rng.uniform(0.0, 5.0)))
        if axis.state is not State.HOLDING:
            axis.set_override(percent)
        ticks = rng.choice((1, 5, 20, 60))
        for _ in range(ticks):
            if jogs:
                axis.jog(signed)
            tick_within_limits(rig)
        if ticks == 60 and axis.state is not State.HOLDING:
            # The paper's law overshoots by a third, and lags behind.
            most = 1.35 * velocity * percent / 100.0 + 0.1 * velocity if percent else 2.5
            assert abs(rig.velocity) <= most
    if jogs:
        assert axis.state is State.JOGGING
        return
    if outcome(rig) == "moving":
        axis.set_override(100.0)
    until(rig, lambda: outcome(rig) == "reached")
    assert rig.position == pytest.approx(target, abs=0.1)


@pytest.mark.parametrize("law", LAWS)
def test_the_speed_stays_within_the_velocity_limit(law: str) -> None:
    rig = rig_of(law)
    rig.axis.move_to(1500.0, 200.0)
    rig.axis.set_override(200.0)
    rig.seconds(3.0)
    assert rig.axis.cruise_velocity == VELOCITY_LIMIT
    assert rig.velocity == pytest.approx(VELOCITY_LIMIT, rel=0.01)


@pytest.mark.parametrize("law", LAWS)
def test_a_jog_of_an_axis_that_does_not_know_its_position_stays_at_the_speed_of_its_search(law: str) -> None:
    rig = rig_of(law, homing={"required": True, "method": "switch", "velocity": 20.0, "position": 0.0})
    rig.axis.set_override(200.0)
    for _ in range(100):
        rig.axis.jog(15.0)
        rig.tick()
    assert rig.axis.cruise_velocity == 20.0
    assert rig.velocity == pytest.approx(20.0, rel=0.02)


# Held -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("at_s", [0.0, 0.02, 0.1, 1.0, 2.5])
def test_0_holds_the_axis_and_then_it_arrives_at_the_same_set_point(law: str, at_s: float) -> None:
    rig = rig_of(law)
    move = rig.axis.move_to(300.0, 100.0)
    rig.seconds(at_s)
    at, velocity = rig.position, rig.velocity
    rig.axis.set_override(0.0)
    rig.seconds(0.5)
    stopping = rig.axis.design.stopping_distance(velocity, 2000.0)
    assert -0.1 <= rig.position - at <= stopping + 0.5
    place = rig.position
    rig.seconds(5.0)
    assert (outcome(rig), rig.axis.set_point, rig.axis.override_percent) == ("moving", 300.0, 0.0)
    assert rig.position == pytest.approx(place, abs=0.05)
    assert rig.axis.distance_to_go == pytest.approx(300.0 - place, abs=0.05)
    rig.axis.set_override(100.0)
    until(rig, lambda: outcome(rig) == "reached")
    assert rig.position == pytest.approx(300.0, abs=0.06)
    assert rig.axis.move is move


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("ticks", range(1, 12))
def test_a_hold_may_be_ended_while_the_axis_still_brakes(law: str, ticks: int) -> None:
    rig = rig_of(law)
    rig.axis.move_to(300.0, 100.0)
    rig.seconds(1.0)
    rig.axis.set_override(0.0)
    rig.seconds(ticks * PERIOD_S)
    rig.axis.set_override(100.0)
    assert rig.axis.stage is Stage.SPEED
    until(rig, lambda: outcome(rig) == "reached")
    steps = [abs(after - before) for before, after in zip(efforts(rig), efforts(rig)[1:], strict=False)]
    assert max(steps) <= LARGEST_STEP
    assert rig.position == pytest.approx(300.0, abs=0.06)


@pytest.mark.parametrize("law", LAWS)
def test_a_set_point_that_is_nearer_than_a_stop_takes_is_reached_and_not_passed(law: str) -> None:
    """At each tick of the approach a stop ends before the set-point, or the axis comes to rest there."""
    stopped = reached = 0
    for ticks in range(60, 140, 3):
        rig = rig_of(law)
        rig.axis.move_to(100.0, 100.0)
        rig.seconds(ticks * PERIOD_S)
        rig.axis.set_override(0.0)
        farthest = 0.0
        for _ in range(200):
            rig.tick()
            farthest = max(farthest, rig.position)
        stopped, reached = stopped + (outcome(rig) == "moving"), reached + (outcome(rig) == "reached")
        assert farthest <= (100.06 if law == "adaptive" else 104.0)  # as far as the paper's law goes by itself
    assert stopped
    assert reached or law == "paper"  # whose last part is so slow that a stop nearly always ends before


@pytest.mark.parametrize("law", LAWS)
def test_between_moves_it_holds_for_the_next_one(law: str) -> None:
    rig = rig_of(law)
    rig.axis.set_override(0.0)
    assert rig.state() is State.HOLDING
    rig.axis.move_to(50.0, 100.0)
    assert rig.axis.stage is Stage.POSITION  # at rest there is nothing to stop
    rig.seconds(5.0)
    assert outcome(rig) == "moving"
    assert rig.position == pytest.approx(0.0, abs=0.01)
    rig.axis.move_by(10.0, 100.0)  # counts from the set-point that is kept
    rig.seconds(1.0)
    assert rig.axis.set_point == 60.0
    rig.axis.set_override(50.0)
    rig.seconds(0.5)
    assert rig.velocity == pytest.approx(50.0, rel=0.25)
    until(rig, lambda: outcome(rig) == "reached")
    assert rig.position == pytest.approx(60.0, abs=0.06)
    rig.axis.move_to(200.0, 100.0)
    rig.seconds(1.2)
    assert rig.velocity == pytest.approx(50.0, rel=0.1)


@pytest.mark.parametrize("law", LAWS)
def test_a_share_that_is_no_speed_holds_as_well(law: str) -> None:
    rig = rig_of(law)
    rig.axis.set_override(5e-324)
    rig.axis.move_to(50.0, 100.0)
    rig.seconds(2.0)
    assert outcome(rig) == "moving"
    assert rig.position == pytest.approx(0.0, abs=0.01)
    rig.axis.set_override(100.0)
    until(rig, lambda: outcome(rig) == "reached")


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("back", [-200.0, 150.0, 152.0, 300.0])
def test_another_set_point_while_held_is_the_one_that_is_kept(law: str, back: float) -> None:
    rig = rig_of(law)
    rig.axis.move_to(400.0, 100.0)
    rig.seconds(1.5)
    rig.axis.set_override(0.0)
    rig.tick()
    rig.axis.move_to(back, 80.0)
    rig.seconds(2.0)
    place = rig.position
    assert (outcome(rig), rig.axis.set_point) == ("moving", back)
    rig.seconds(5.0)
    assert rig.position == pytest.approx(place, abs=0.02)
    rig.axis.set_override(150.0)
    until(rig, lambda: outcome(rig) == "reached")
    assert rig.position == pytest.approx(back, abs=0.06)


@pytest.mark.parametrize("law", LAWS)
def test_a_move_that_ends_from_one_side_may_be_held_in_each_of_its_legs(law: str) -> None:
    rig = rig_of(law, approach={"direction": "positive", "distance": 5.0})
    rig.axis.move_to(-100.0, 100.0)
    rig.seconds(0.5)
    rig.axis.set_override(0.0)
    rig.seconds(2.0)
    assert (outcome(rig), rig.axis.set_point) == ("moving", -105.0)
    rig.axis.set_override(100.0)
    until(rig, lambda: rig.axis.set_point == -100.0)
    rig.axis.set_override(0.0)
    rig.seconds(5.0)
    assert outcome(rig) == "moving"
    assert rig.position < -100.5
    rig.axis.set_override(50.0)
    until(rig, lambda: outcome(rig) == "reached")
    assert rig.position == pytest.approx(-100.0, abs=0.06)


@pytest.mark.parametrize("law", LAWS)
def test_a_jog_is_slowed_down_held_and_let_go(law: str) -> None:
    rig = rig_of(law)

    def jog_for(ticks: int) -> float:
        for _ in range(ticks):
            rig.axis.jog(-80.0)
            rig.tick()
        return rig.velocity

    assert jog_for(150) == pytest.approx(-80.0, rel=0.02)
    rig.axis.set_override(25.0)
    assert jog_for(150) == pytest.approx(-20.0, rel=0.1)
    rig.axis.set_override(0.0)
    assert jog_for(150) == pytest.approx(0.0, abs=0.1)
    assert rig.state() is State.JOGGING
    rig.axis.set_override(100.0)
    assert jog_for(150) == pytest.approx(-80.0, rel=0.02)
    rig.axis.set_override(0.0)
    rig.seconds(1.0)
    assert (rig.state(), outcome(rig)) == (State.HOLDING, "stopped")
    rig.axis.set_override(100.0)
    rig.seconds(1.0)
    assert abs(rig.velocity) < 0.1


@pytest.mark.parametrize("law", LAWS)
def test_what_ends_a_move_ends_one_that_is_held(law: str) -> None:
    def held() -> AxisRig:
        rig = rig_of(law)
        rig.axis.move_to(400.0, 100.0)
        rig.seconds(1.0)
        rig.axis.set_override(0.0)
        return rig.seconds(1.0)

    rig = held()
    rig.axis.stop()
    rig.axis.set_override(100.0)
    rig.seconds(1.0)
    assert (rig.state(), outcome(rig)) == (State.HOLDING, "stopped")
    assert abs(rig.velocity) < 0.1
    rig = held()
    rig.axis.disarm()
    rig.seconds(0.5)
    assert (rig.state(), rig.axis.override_percent) == (State.DISARMED, 100.0)
    rig = held()
    rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "test")
    rig.seconds(0.5)
    assert (rig.state(), rig.axis.override_percent) == (State.TRIPPED, 100.0)
    assert rig.axis.set_point == rig.axis.law.target


@pytest.mark.parametrize("law", LAWS)
def test_a_fault_is_told_while_the_axis_is_held(law: str) -> None:
    rig = rig_of(law)
    rig.axis.move_to(400.0, 100.0)
    rig.seconds(1.0)
    rig.axis.set_override(0.0)
    rig.seconds(1.0)
    rig.sees = lambda position: position + 30.0
    rig.seconds(0.1)
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.POSITION_JUMP


# When -----------------------------------------------------------------------------------------------------------------


def test_it_is_100_again_after_each_arming() -> None:
    rig = rig_of("adaptive")
    assert rig.axis.override_percent == 100.0
    rig.axis.set_override(30.0)
    rig.axis.move_to(10.0, 100.0)
    until(rig, lambda: outcome(rig) == "reached")
    assert rig.axis.override_percent == 30.0
    rig.axis.disarm()
    rig.seconds(0.2)
    assert rig.axis.override_percent == 100.0
    rig.axis.arm()
    rig.seconds(0.2)
    assert (rig.state(), rig.axis.override_percent) == (State.HOLDING, 100.0)
    rig.axis.move_to(200.0, 100.0)
    rig.seconds(1.0)
    assert rig.velocity == pytest.approx(100.0, rel=0.02)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("quick", [False, True])
def test_a_stop_takes_no_notice_of_it_but_the_next_move_does(law: str, quick: bool) -> None:
    overridden, left_alone = rig_of(law), rig_of(law)
    for rig in (overridden, left_alone):
        rig.axis.move_to(400.0, 100.0)
        rig.seconds(1.0)
        rig.axis.stop(quick=quick)
        rig.tick()
    overridden.axis.set_override(50.0)
    overridden.seconds(1.0)
    left_alone.seconds(1.0)
    assert same(overridden, left_alone)
    overridden.axis.move_to(400.0, 100.0)
    overridden.seconds(1.5)
    assert overridden.velocity == pytest.approx(50.0, rel=0.05)


@pytest.mark.parametrize("percent", [0.0, 50.0, 200.0])
def test_homing_takes_no_notice_of_it(percent: float) -> None:
    way = {"method": "hard_stop", "direction": "positive", "effort": 5.0, "velocity": 20.0, "position": 48.0}

    def homed(percent: float) -> AxisRig:
        rig = rig_of("adaptive", homing=way)
        rig.axis.home()
        rig.seconds(0.2)
        rig.axis.set_override(percent)
        for _ in range(4000):
            rig.tick()
            if rig.position >= 10.0:
                rig.position, rig.velocity = 10.0, min(rig.velocity, 0.0)
            if rig.state() is not State.HOMING:
                break
        assert (rig.state(), outcome(rig), rig.axis.override_percent) == (State.HOLDING, "reached", percent)
        return rig

    assert same(homed(percent), homed(100.0))


@pytest.mark.parametrize("percent", [-1e-9, 200.1, math.nan, math.inf, -math.inf])
def test_what_is_no_percentage_is_refused(percent: float) -> None:
    rig = rig_of("adaptive")
    with pytest.raises(Refused, match=r"it must be from 0, which holds the axis, to 200 %\.") as refused:
        rig.axis.set_override(percent)
    assert refused.value.code == "bad_request"
    assert rig.axis.override_percent == 100.0


def test_an_axis_that_is_not_armed_refuses_it_and_says_why() -> None:
    rig = rig_of("adaptive")

    def refusal() -> tuple[str, str]:
        assert not rig.axis.takes_override
        with pytest.raises(Refused) as refused:
            rig.axis.set_override(50.0)
        return refused.value.code, str(refused.value)

    assert rig.axis.takes_override
    rig.axis.move_to(400.0, 100.0)
    rig.seconds(1.0)
    rig.axis.disarm()
    again = "and the override is 100 % again after each arming: `arm` it first."
    assert refusal() == ("disarmed", f"the axis is disarming, {again}")
    rig.seconds(0.5)
    assert refusal() == ("disarmed", f"the axis is disarmed, {again}")
    rig.axis.arm()
    assert refusal() == ("busy", "the axis is arming, and the override is 100 % then: wait until it holds.")
    rig.seconds(0.2)
    rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "test")
    code, text = refusal()
    assert code == "tripped"
    assert text.startswith("the axis has tripped (following_error): test.")


@pytest.mark.parametrize(
    ("stage", "velocity", "is_there", "stops"),
    [
        (Stage.POSITION, 2.4, True, False),  # it rests where it should
        (Stage.POSITION, 2.6, True, True),
        (Stage.POSITION, -2.6, True, True),
        (Stage.POSITION, 0.0, False, True),  # it would go on to its set-point
        (Stage.SPEED, 0.0, True, True),
        (Stage.BRAKE, 100.0, False, False),  # it comes to rest already
    ],
)
def test_an_axis_that_is_to_hold_is_stopped_unless_it_rests_or_stops_already(
    stage: Stage, velocity: float, is_there: bool, stops: bool
) -> None:
    stopped: list[tuple[float, bool]] = []
    motion = SimpleNamespace(
        law=SimpleNamespace(stage=stage, target=400.0, observer=SimpleNamespace(velocity=velocity)),
        stop=lambda deceleration, smooth: stopped.append((deceleration, smooth)),
    )
    override: Any = SimpleNamespace(
        _motion=motion, _rest_velocity=2.5, _acceleration=2000.0, _is_at=lambda target: is_there and target == 400.0
    )
    leg: Any = SimpleNamespace(target=400.0)
    SpeedOverride._hold(override, leg)
    assert override.kept_target == 400.0
    assert stopped == [(2000.0, True)] * stops


@pytest.mark.parametrize(("at", "target"), [(1000.0, 1003.0), (-1000.0, -1003.0)])
def test_how_far_it_is_to_a_set_point_counts_from_where_the_axis_is(at: float, target: float) -> None:
    """3 mm away, where a stop from 20 mm/s takes less."""
    rig = rig_of("adaptive")
    rig.axis.set_position(at)
    rig.axis.move_to(target, 20.0)
    rig.seconds(0.08)
    rig.axis.set_override(0.0)
    rig.seconds(1.0)
    assert outcome(rig) == "moving"
    assert 0.0 < abs(rig.axis.motion.law.observer.position - at) < 2.5


@pytest.mark.parametrize("law", LAWS)
def test_after_a_stop_beyond_its_set_point_the_axis_heads_back(law: str) -> None:
    """A limit switch behind it counts as soon as it may go on."""
    rig = rig_of(law)
    rig.axis.move_to(300.0, 100.0)
    rig.seconds(1.0)
    rig.axis.set_override(0.0)
    rig.tick()
    target = rig.position + 0.5
    rig.axis.move_to(target, 100.0)
    assert rig.axis._operation.heading > 0.0
    rig.seconds(1.0)
    assert rig.position > target + 0.5
    rig.axis.set_override(100.0)
    assert rig.axis._operation.heading < 0.0
    until(rig, lambda: outcome(rig) == "reached")
    assert rig.position == pytest.approx(target, abs=0.06)
