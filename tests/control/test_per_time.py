"""Figures for a tick of 10 ms on other ticks: the same to the last bit there, and the same over a time elsewhere."""

import math
from dataclasses import replace

import pytest

from tests.axis.rig import TRAITS, axis_settings
from twostage_servo.axis.braking_estimate import BrakingEstimate
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.homing import Homing
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.standing_load import StandingLoad
from twostage_servo.control.laws.stop import Stop, braking_gain
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver
from twostage_servo.control.per_time import kept_in, samples_in, share_in
from twostage_servo.control.plant import Plant

PLANT = Plant(180.0, 14.0)


@pytest.mark.parametrize("share", [0.2, 0.3, 0.7, 1e-9])
def test_on_the_nominal_tick_a_share_is_itself_to_the_last_bit(share: float) -> None:
    assert share_in(share, 0.01) == share
    assert kept_in(share, 0.01) == share


@pytest.mark.parametrize("period_s", [0.001, 0.002, 0.005, 0.02, 0.1])
def test_over_a_time_any_tick_takes_as_much(period_s: float) -> None:
    ticks = 0.1 / period_s
    assert (1.0 - share_in(0.3, period_s)) ** ticks == pytest.approx(0.7**10)
    assert kept_in(0.998, period_s) ** ticks == pytest.approx(0.998**10)


@pytest.mark.parametrize(
    ("duration_s", "period_s", "least", "samples"),
    [(0.03, 0.01, 3, 3), (0.03, 0.002, 3, 15), (0.03, 0.004, 3, 8), (0.03, 0.1, 3, 3), (0.3, 0.001, 1, 300)],
)
def test_a_time_has_so_many_samples_and_never_fewer_than_tell_a_single_one(
    duration_s: float, period_s: float, least: int, samples: int
) -> None:
    assert samples_in(duration_s, period_s, least) == samples


@pytest.mark.parametrize(("period_s", "share"), [(0.002, 1.0 - 0.7**0.2), (0.01, 0.3), (0.05, 0.3)])
def test_a_stop_takes_three_tenths_of_a_speed_error_in_ten_ms_or_a_longer_tick(period_s: float, share: float) -> None:
    sampled = PLANT.discretise(period_s)
    assert braking_gain(sampled) * sampled.b2 == pytest.approx(share, rel=1e-12)


@pytest.mark.parametrize(("period_s", "ticks"), [(0.002, 15), (0.01, 3), (0.05, 3)])
def test_a_stop_is_over_after_thirty_ms_of_rest_and_three_samples(period_s: float, ticks: int) -> None:
    stop = Stop(PLANT.discretise(period_s), period_s, rest_velocity=2.5)
    stop.begin(0.0)
    assert [stop.is_over(0.0) for _ in range(ticks)] == [*[False] * (ticks - 1), True]


@pytest.mark.parametrize("period_s", [0.002, 0.01, 0.02])
def test_what_stands_is_a_mean_over_a_time(period_s: float) -> None:
    """A load of 1 V, and an innovation of 1 mm with 1/gain of it in the velocity, for 60 ms."""
    design = replace(design_axis(axis_settings(), 0.01), period_s=period_s)
    load, braking = StandingLoad(design), BrakingEstimate(design)
    observer = DisturbanceObserver(design.plant, NO_CORRECTION)
    observer.correct(0.0, 1.0)
    observer.innovation = 1.0
    for _ in range(round(0.06 / period_s)):
        load.update(observer)
        braking.update(observer, 0.0, corrected=True, sure=False)
    assert load.load == pytest.approx(1.0 - 0.7**6)
    assert braking._standing == pytest.approx(1.0 - 0.8**6)


@pytest.mark.parametrize(("period_s", "fading"), [(0.002, 0.998**0.2), (0.01, 0.998), (0.02, 0.998**2)])
@pytest.mark.parametrize("gap", [0.02])
def test_a_motion_forgets_speeds_and_gaps_over_times(period_s: float, fading: float, gap: float) -> None:
    design = replace(design_axis(axis_settings(), 0.01), period_s=period_s)
    motion = Motion(design, DriveReport(design.settings, period_s, TRAITS), 0.001)
    assert motion._fading == pytest.approx(fading)
    assert motion._long_gap_ticks == math.ceil(gap / period_s)


@pytest.mark.parametrize(("period_s", "ahead"), [(0.002, 0.03), (0.01, 0.03), (0.05, 0.15)])
def test_an_index_mark_may_be_ahead_by_thirty_ms_and_by_three_ticks(period_s: float, ahead: float) -> None:
    settings = axis_settings({"method": "index", "slow_velocity": 20.0})
    design = replace(design_axis(settings, 0.01), period_s=period_s)
    drive = DriveReport(settings, period_s, TRAITS)
    search = Homing(design, Motion(design, drive, 0.001), drive)
    assert search._way_ahead == pytest.approx(ahead * 20.0)
