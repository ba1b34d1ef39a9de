"""An axis that was not seen for a while: what it still knows of its place, and that it never runs away from there."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode

DESIGN = design_axis(axis_settings(), PERIOD_S)
OVERSPEED = 320.0
NARROW = 65.536
"""Range of a 16-bit counter of micrometres, in mm: half of it is 102 ms at the overspeed of 320 mm/s."""
WIDE = NARROW * 65_536.0
TURN = 5.0
"""A single-turn encoder on a screw of 5 mm: 8 ms at overspeed, so every missed frame counts."""


def wrapping(period: float) -> AxisRig:
    rig = AxisRig(Axis(DESIGN, replace(TRAITS, position_period=period)))
    rig.sees = lambda position: (position + period / 2.0) % period - period / 2.0
    return rig


def unseen(rig: AxisRig, ticks: int, velocity: float) -> None:
    """Let ticks pass without feedback while the axis is carried along at a velocity in mm/s."""
    rig.silent = True
    for _ in range(ticks):
        rig.position += velocity * PERIOD_S
        rig.velocity = 0.0
        rig.tick()
    rig.silent = False
    rig.sample = rig.sees(rig.position)


def arms_and_stays(rig: AxisRig) -> bool:
    """Arm, and see whether the axis stays where it is, to 0.5 mm, with next to no effort."""
    rig.velocity = 0.0
    rig.seconds(0.5)
    if rig.axis.trip is not None:
        rig.axis.reset()
    rig.seconds(0.1)
    at, commands = rig.position, len(rig.commands)
    rig.axis.arm()
    rig.seconds(1.0)
    return abs(rig.position - at) < 0.5 and max(abs(command.effort) for command in rig.commands[commands:]) < 1.0


@settings(max_examples=60, deadline=None)
@given(period=st.sampled_from([TURN, NARROW, WIDE]), ticks=st.integers(1, 60), speed=st.floats(-OVERSPEED, OVERSPEED))
def test_pushed_while_unseen_the_place_is_right_or_no_longer_trusted(period: float, ticks: int, speed: float) -> None:
    rig = wrapping(period).seconds(0.1)
    unseen(rig, ticks, speed)
    rig.tick()
    assert not rig.axis.referenced or rig.axis.drive.position == pytest.approx(rig.sees(0.0) + rig.position, abs=1e-6)
    assert arms_and_stays(rig)


@pytest.mark.parametrize(("ticks", "trusted"), [(9, True), (10, False)])
def test_the_reference_is_lost_when_half_a_round_is_possible(ticks: int, *, trusted: bool) -> None:
    """102.4 ms at 320 mm/s are half of 65.536 mm; the sample after nine empty ticks is 100 ms younger than the last."""
    rig = wrapping(NARROW).seconds(0.1)
    unseen(rig, ticks, 0.0)
    rig.tick()
    assert rig.axis.referenced is trusted


@pytest.mark.parametrize("period", [NARROW, WIDE])
@pytest.mark.parametrize("gap_s", [0.2, 0.5, 1.0, 1.7])
def test_a_long_silence_in_motion_never_ends_in_a_run(period: float, gap_s: float) -> None:
    rig = wrapping(period).cruising()
    rig.silent = True
    rig.seconds(gap_s)
    assert rig.axis.trip is not None
    rig.silent = False
    rig.tick()
    assert rig.axis.referenced is (period == WIDE)
    if period == WIDE:
        assert rig.axis.drive.position == pytest.approx(rig.sample, abs=1e-6)
    assert arms_and_stays(rig)


@pytest.mark.parametrize("missed", [5, 12, 30, 50])
def test_a_suspension_in_motion_never_ends_in_a_run(missed: int) -> None:
    """At 100 mm/s 50 ticks are 50 mm, more than half of the counter's range."""
    rig = wrapping(NARROW).cruising()
    rig.tick(missed)
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.MISSED_TICKS
    assert rig.axis.referenced is (missed < 10)
    rig.seconds(2.0)
    assert rig.state() is State.TRIPPED
    assert arms_and_stays(rig)


def test_a_suspension_while_disarmed_starts_the_estimate_afresh() -> None:
    rig = wrapping(WIDE).seconds(0.1)
    rig.velocity = 100.0
    rig.seconds(0.05)
    rig.position, rig.velocity = 300.0, 0.0  # has come to rest somewhere else meanwhile
    rig.sample = rig.sees(rig.position)
    rig.tick(40)
    rig.seconds(0.05)
    assert rig.axis.law.observer.velocity == pytest.approx(0.0, abs=1e-9)
    assert arms_and_stays(rig)


@pytest.mark.parametrize("speed", [OVERSPEED, -OVERSPEED])
@pytest.mark.parametrize("lost", [2, 7, 8, 9])
@pytest.mark.parametrize("surprise", ["not seen before", "knocked"])
def test_frames_lost_behind_the_first_one_do_not_make_it_look_quicker(surprise: str, lost: int, speed: float) -> None:
    """Two samples say how fast the axis is, and they may be some ticks apart: a speed ten times too large would lead
    the estimate into the next revolution of the counter within two ticks.
    """
    axis = Axis(
        design_axis(axis_settings(stale_feedback_ms=100.0), PERIOD_S),
        DriveTraits(counter_modulus=16, position_period=NARROW),
    )
    rig = AxisRig(axis)
    rig.sees = wrapping(NARROW).sees

    def carried(ticks: int, *, silent: bool = False) -> None:
        rig.silent = silent
        for _ in range(ticks):
            rig.velocity = 0.0
            rig.tick()
            rig.position += speed * PERIOD_S
            rig.sample = rig.sees(rig.position)
        rig.silent = False

    carried(10)
    if surprise == "knocked":
        rig.position += 1.0
        rig.sample = rig.sees(rig.position)
    else:
        axis.motion.lose_track()
    carried(1)
    carried(lost, silent=True)
    carried(12)
    assert axis.referenced
    assert axis.drive.position == pytest.approx(rig.position - speed * PERIOD_S, abs=1e-6)
