"""An axis whose reference is smooth (`axis.law.jerk`): which motions are, which stops are not, and what is refused."""

import contextlib
import math
import random
from itertools import pairwise
from typing import Any

import pytest

from tests.axis.rig import DEMO, PERIOD_S, TRAITS, AxisRig
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign, DesignError, design_axis
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.plant import Plant

JERK = 10_000.0
STEP = JERK * PERIOD_S**2


def designed(jerk: float | None = JERK, law: str = "adaptive", **keys: Any) -> AxisDesign:
    table: dict[str, Any] = {"type": law, law: keys} if jerk is None else {"type": law, "jerk": jerk, law: keys}
    limits = DEMO["limits"] | {"acceleration": 1000.0}
    return design_axis(AxisSettings.model_validate(DEMO | {"law": table, "limits": limits}), PERIOD_S)


class Smooth(AxisRig):
    """An axis of which each tick's speed reference is kept."""

    def __init__(self, jerk: float | None = JERK, gain: float = 1.0, pole: float = 1.0) -> None:
        super().__init__(Axis(designed(jerk), TRAITS), Plant(180.0 * gain, 14.0 * pole))
        self.speeds: list[float] = []

    def tick(self, missed: int = 0) -> Any:
        command = super().tick(missed)
        self.speeds.append(self.axis.law.speed_reference)
        return command

    def largest_change_of_slope(self) -> float:
        slopes = [after - before for before, after in pairwise(self.speeds)]
        return max(abs(after - before) for before, after in pairwise(slopes))


def test_a_move_and_a_new_speed_on_the_way_are_smooth() -> None:
    rig = Smooth()
    rig.cruising(for_s=1.0)
    rig.axis.set_override(40.0)
    rig.seconds(0.7)
    rig.axis.set_override(150.0)
    rig.seconds(6.0)
    assert rig.state() is State.HOLDING
    assert rig.position == pytest.approx(400.0, abs=0.01)
    assert max(rig.speeds) == pytest.approx(150.0)
    assert rig.largest_change_of_slope() <= STEP * 1.001


def stop(rig: Smooth) -> None:
    rig.axis.stop()


def let_the_jog_end(rig: Smooth) -> None:
    assert rig.state() is State.JOGGING


def override_to_none(rig: Smooth) -> None:
    rig.axis.set_override(0.0)


def disarm(rig: Smooth) -> None:
    rig.axis.disarm()


@pytest.mark.parametrize("end", [stop, let_the_jog_end, override_to_none, disarm])
@pytest.mark.parametrize("after_s", [0.05, 0.25])
def test_a_jog_and_its_end_are_smooth(end: Any, after_s: float) -> None:
    """In mid-acceleration as well as in a cruise; the reference of the stop is the last of the motion."""
    rig = Smooth()
    rig.armed()
    rig.axis.jog(100.0)
    rig.seconds(after_s)
    end(rig)
    rig.seconds(1.5)
    assert rig.axis.trip is None
    assert abs(rig.velocity) < 0.05
    assert min(rig.speeds) >= 0.0
    assert rig.largest_change_of_slope() <= STEP * 1.001


def quick(rig: Smooth) -> None:
    rig.axis.stop(quick=True)


def trip_to_a_controlled_stop(rig: Smooth) -> None:
    rig.axis.raise_trip(TripCode.SPEED_UNREACHABLE, "test")


def trip_to_a_quick_stop(rig: Smooth) -> None:
    rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "test")


def trip_in_a_smooth_stop(rig: Smooth) -> None:
    rig.axis.stop()
    rig.seconds(0.02)
    rig.axis.raise_trip(TripCode.FOLLOWING_ERROR, "test")


@pytest.mark.parametrize("end", [quick, trip_to_a_controlled_stop, trip_to_a_quick_stop, trip_in_a_smooth_stop])
def test_safety_outranks_the_jerk(end: Any) -> None:
    """Such a stop is that of an axis without smoothing, but for what a smooth one has done before."""
    smooth, other = Smooth(), Smooth(None)
    for rig in (smooth, other):
        rig.cruising(for_s=1.0)
        start, before = rig.position, len(rig.speeds)
        end(rig)
        rig.seconds(1.0)
        rig.speeds = [rig.position - start, *rig.speeds[before:]]
    assert smooth.speeds[0] == pytest.approx(other.speeds[0], abs=0.02 if end is not trip_in_a_smooth_stop else 1.0)
    falls = [before - after for before, after in pairwise(smooth.speeds[1:])]
    assert max(falls) >= 10.0 - 1e-9  # the whole deceleration, or a quarter of the speed, at once
    assert smooth.largest_change_of_slope() > 5.0 * STEP


@pytest.mark.parametrize("jerk", [1500.0, 10_000.0, 100_000.0])
@pytest.mark.parametrize("seed", range(6))
def test_a_healthy_axis_never_trips_whatever_it_is_asked_for(seed: int, jerk: float) -> None:
    """Plants up to 20 % off, a load, noise of 0.01 mm, and requests at any time."""
    rng = random.Random(seed)  # noqa: S311 - a test
    rig = Smooth(jerk, rng.uniform(0.8, 1.2), rng.uniform(0.8, 1.2))
    rig.armed()
    rig.load = rng.uniform(-0.5, 0.5)
    rig.sees = lambda position: round(position + rng.gauss(0.0, 0.01), 3)
    rig.seconds(0.5)
    for _ in range(12):
        choice = rng.random()
        with contextlib.suppress(Refused):  # a jog begins at rest, and a move when a stop has ended
            if choice < 0.6:
                rig.axis.move_to(rng.uniform(-600.0, 600.0), rng.uniform(5.0, 160.0))
            elif choice < 0.75:
                rig.axis.stop(quick=rng.random() < 0.5)
            elif choice < 0.9:
                rig.axis.set_override(rng.choice((0.0, 30.0, 100.0, 150.0)))
            else:
                rig.axis.jog(rng.choice((-1.0, 1.0)) * rng.uniform(5.0, 160.0))
        rig.seconds(rng.uniform(0.02, 3.0))
        assert rig.axis.trip is None
    rig.axis.set_override(100.0)
    rig.axis.stop()
    rig.seconds(3.0)
    assert (rig.state(), rig.axis.trip) == (State.HOLDING, None)


@pytest.mark.parametrize("velocity", [3.0, 10.0, 100.0])
@pytest.mark.parametrize("seed", range(4))
def test_a_noisy_encoder_lets_no_move_turn_round(seed: int, velocity: float) -> None:
    rng = random.Random(seed)  # noqa: S311 - a test
    rig = Smooth(5_000.0)
    rig.sees = lambda position: position + rng.gauss(0.0, 0.03)
    rig.armed(for_s=1.0)
    rig.axis.move_to(5.0 * velocity**0.5, velocity)
    furthest = 0.0
    for _ in range(1000):
        rig.tick()
        furthest = max(furthest, rig.position)
    assert min(rig.speeds) >= 0.0
    assert furthest <= 5.0 * velocity**0.5 + 0.25


def test_the_design_counts_the_longer_time_and_way() -> None:
    smooth, other = designed(), designed(None)
    # a/j is 0.1 s: as much longer at the beginning and, with a reserve, at the end.
    extra_s = smooth.law.move_duration_s(400.0, 100.0, 0.05) - other.law.move_duration_s(400.0, 100.0, 0.05)
    assert extra_s == pytest.approx(0.1, abs=0.02)
    assert smooth.changeover_distance(100.0) - other.changeover_distance(100.0) == pytest.approx(5.0, abs=1.0)
    # A stop with j takes 0.85 of it: from 200 mm/s it goes 100 mm/s times a/j farther.
    farther = smooth.stopping_distance(200.0, 1000.0, smooth=True) - other.stopping_distance(200.0, 1000.0)
    assert farther == pytest.approx(100.0 * 0.1 / 0.85)
    assert smooth.stopping_time_s(200.0, 1000.0, smooth=True) > other.stopping_time_s(200.0, 1000.0) + 0.1
    assert smooth.stopping_distance(200.0, 1000.0) == other.stopping_distance(200.0, 1000.0)
    assert smooth.jerk == JERK
    assert math.isinf(other.jerk)


@pytest.mark.parametrize(
    ("law", "jerk", "keys", "place", "text"),
    [
        ("paper", JERK, {}, ("axis", "law", "jerk"), "the law 'paper' cannot smooth its reference"),
        ("adaptive", 40.0, {}, ("axis", "law", "jerk"), "takes 25 s, 2500 ticks.* raise jerk to 50, or lower"),
        ("adaptive", JERK, {"planned_braking": False}, ("axis", "law", "adaptive", "planned_braking"), "jerk"),
    ],
)
def test_what_cannot_be_smoothed_is_refused(
    law: str, jerk: float, keys: dict[str, Any], place: tuple[str, ...], text: str
) -> None:
    with pytest.raises(DesignError, match=text) as caught:
        designed(jerk, law, **keys)
    assert caught.value.key == place


def test_a_smoothed_braking_has_as_much_more_time_as_it_takes() -> None:
    settings = AxisSettings.model_validate(DEMO | {"law": {"type": "adaptive", "jerk": 20_000.0}})
    rig = AxisRig(Axis(design_axis(settings, PERIOD_S), TRAITS)).cruising()
    allowed = []
    for smooth in (False, True):
        rig.axis.supervision.begin_braking(2000.0, smooth=smooth)
        allowed.append(rig.axis.supervision._braking_ticks_allowed * PERIOD_S / 2.0)
    velocity = rig.axis.motion.law.observer.velocity
    expected = [rig.axis.design.stopping_time_s(velocity, 2000.0, smooth=smooth) for smooth in (False, True)]
    assert allowed == pytest.approx(expected)
    assert expected[1] > expected[0] + 0.05
