"""Stops of an axis: how far they take, by hand and by the design's formula, with loads, blind, and near the limits."""

import itertools
from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings, paper
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import BRAKING, State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.laws.stop_design import StopDesign

STOP, QUICK = 2000.0, 4000.0
"""Decelerations of the rig's axis, in mm/s²."""

DESIGN = design_axis(axis_settings(), PERIOD_S)


def rig_with(**limits: float) -> AxisRig:
    return AxisRig(Axis(design_axis(axis_settings(None, None, **limits), PERIOD_S), TRAITS))


@dataclass
class Stop:
    """One stop, seen from the plant: speeds and efforts tick by tick, the first ones from before it."""

    distance: float
    speeds: list[float]
    efforts: list[float]

    @property
    def largest_step(self) -> float:
        return max(abs(b - a) for a, b in itertools.pairwise(self.efforts))


def stop_from(velocity: float, *, quick: bool, load: float = 0.0, blind: bool = False) -> Stop:
    rig = AxisRig(Axis(DESIGN, TRAITS)).armed()
    rig.load = load
    rig.seconds(1.5)
    rig.axis.move_to(2400.0 if velocity > 0.0 else -2400.0, abs(velocity))
    rig.seconds(2.5)
    if blind:  # three ticks without feedback, and the axis goes on as before until the third
        rig.silent = True
        rig.seconds(0.03)
        assert rig.state() is State.TRIPPED_QUICK_STOP
    else:
        rig.axis.stop(quick=quick)
    start, speeds, first = rig.position, [rig.velocity], len(rig.commands)
    for _ in range(200):
        if rig.state() not in BRAKING:
            break
        rig.tick()
        speeds.append(rig.velocity)
    assert rig.state() is (State.TRIPPED if blind else State.HOLDING)
    sign = 1.0 if velocity > 0.0 else -1.0
    efforts = [command.effort for command in rig.commands[first - 1 :] if command.enable]
    return Stop(sign * (rig.position - start), [sign * speed for speed in speeds], efforts)


@settings(max_examples=40, deadline=None)
@given(
    speed=st.floats(5.0, 250.0),
    sign=st.sampled_from([1.0, -1.0]),
    quick=st.booleans(),
    load=st.floats(-3.0, 3.0),
)
def test_a_stop_takes_more_than_the_ramp_by_hand_and_less_than_the_formula(
    speed: float, sign: float, load: float, *, quick: bool
) -> None:
    stop = stop_from(sign * speed, quick=quick, load=load)
    deceleration = QUICK if quick else STOP
    assert speed**2 / (2.0 * deceleration) - 0.01 * speed * PERIOD_S <= stop.distance
    assert stop.distance <= DESIGN.stopping_distance(speed, deceleration)
    assert all(after <= before + 0.05 for before, after in itertools.pairwise(stop.speeds))
    assert min(stop.speeds) > -0.5  # never backwards
    assert max(map(abs, stop.efforts)) <= 24.0
    assert stop.largest_step <= 10.0 + 1e-9


@pytest.mark.parametrize(("velocity", "ramp"), [(250.0, 7.8125), (-100.0, 1.25)])
def test_without_feedback_the_model_stops_the_axis_as_well(velocity: float, ramp: float) -> None:
    """At the trip the effort has begun to brake already: that tick is not in the distance."""
    stop = stop_from(velocity, quick=True, blind=True)
    assert ramp - abs(velocity) * PERIOD_S < stop.distance < ramp + abs(velocity) * PERIOD_S
    assert all(after <= before + 1e-6 for before, after in itertools.pairwise(stop.speeds))
    assert min(stop.speeds) > -0.5


def test_the_formula_by_hand() -> None:
    """250 mm/s: a tick is 2.5 mm; the effort swings 4000/180 V at 1000 V/s, 5.556 mm; the ramp 7.8125 mm.

    At 160 mm/s a tick of the ramp, 40 mm/s, is a quarter of the speed: from there it takes 3.5 ticks of that speed,
    5.6 mm, in place of the ramp's last 3.2 mm.
    """
    assert DESIGN.stopping_distance(250.0, QUICK) == pytest.approx(2.5 + 250.0 * 4.0 / 180.0 + 7.8125 + 5.6 - 3.2)
    # At 80 mm/s it takes 20 mm/s away in a tick at most: 2000/180 V of effort.
    assert DESIGN.stopping_distance(80.0, QUICK) == pytest.approx(0.8 + 80.0 * 2.0 / 180.0 + 3.5 * 0.8)
    assert DESIGN.stopping_distance(-250.0, QUICK) == DESIGN.stopping_distance(250.0, QUICK)
    # More than gain times effort limit, 4320 mm/s², can't be had, however steep the ramp.
    assert StopDesign(paper(DESIGN).task).attainable(1e6) == pytest.approx(4320.0)


def test_a_controlled_stop_after_a_trip_is_a_stop_and_then_disables() -> None:
    rig = AxisRig().cruising(2000.0, 250.0)
    at = rig.position
    rig.axis.raise_trip(TripCode.SPEED_UNREACHABLE, "test")
    assert rig.state() is State.TRIPPED_STOPPING
    rig.seconds(1.0)
    assert rig.state() is State.TRIPPED
    assert 250.0**2 / (2.0 * STOP) < rig.position - at < rig.axis.design.stopping_distance(250.0, STOP)


def test_a_quick_stop_takes_over_from_a_stop_and_not_the_other_way_round() -> None:
    rig = AxisRig().cruising(2000.0, 250.0)
    rig.axis.stop()
    rig.tick()
    rig.axis.stop(quick=True)
    assert rig.state() is State.QUICK_STOPPING
    rig.tick()
    rig.axis.stop()
    assert rig.state() is State.QUICK_STOPPING


@pytest.mark.parametrize("request_name", ["stop", "disarm"])
def test_a_gentle_stop_does_not_leave_the_position_limits(request_name: str) -> None:
    """From 250 mm/s at 150 mm/s² it takes 208 mm: where only 140 mm remain, it has to become a quick stop in time."""
    rig = rig_with(acceleration=150.0, following_error_minimum=1e3)
    rig.position = rig.sample = 2000.0
    rig.armed()
    rig.axis.move_to(2500.0, 250.0)
    while rig.position < 2360.0:
        rig.tick()
    getattr(rig.axis, request_name)()
    farthest = rig.position
    for _ in range(400):
        rig.tick()
        farthest = max(farthest, rig.position)
    assert farthest <= 2520.0


def test_the_formula_holds_for_a_slow_effort_rate() -> None:
    rig = rig_with(
        effort_rate=20.0, acceleration=200.0, quick_stop_deceleration=500.0, following_error_minimum=1e4,
        position_minimum=-1e5, position_maximum=1e5,
    )  # fmt: skip
    rig.cruising(5e4, 250.0, for_s=4.0)
    at, speed = rig.position, rig.velocity
    rig.axis.stop(quick=True)
    rig.seconds(4.0)
    assert rig.state() is State.HOLDING
    assert rig.position - at <= rig.axis.design.stopping_distance(speed, 500.0)


def test_a_quick_stop_may_be_asked_for_in_every_motion() -> None:
    rig = AxisRig().cruising(2000.0, 250.0)
    rig.axis.disarm()
    rig.tick()
    rig.axis.stop(quick=True)


def test_the_time_of_a_stop_is_ramp_and_swing_and_settling() -> None:
    expected = 250.0 / QUICK + (QUICK / 180.0) / 1000.0 + DESIGN.law.settling_time_s
    assert DESIGN.stopping_time_s(250.0, QUICK) == pytest.approx(expected)
    assert 0.3 < DESIGN.law.settling_time_s < 0.5  # the slowest pole of a stop is 0.889: ln 0.01 / ln 0.889 ticks


def test_an_axis_can_stop_just_where_a_stop_is_not_refused() -> None:
    rig = AxisRig()
    assert not rig.axis.can_stop
    with pytest.raises(Refused, match="disarmed"):
        rig.axis.stop(quick=False)
    rig = rig.armed()
    rig.axis.move_to(400.0, 100.0)
    rig.seconds(1.0)
    assert rig.axis.can_stop
    rig.axis.stop(quick=False)
    assert rig.axis.can_stop  # harder
    rig.axis.raise_trip(TripCode.STALL, "for the test")
    rig.seconds(1.0)
    assert rig.state() is State.TRIPPED
    assert not rig.axis.can_stop
