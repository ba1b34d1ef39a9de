"""A search for the reference, step by step, with motion and drive written by hand: which way, how fast, how long."""

from types import SimpleNamespace
from typing import Any

import pytest

from tests.axis.rig import PERIOD_S, axis_settings
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.homing import Homing, HomingFailed
from twostage_servo.control.laws.law import Stage

SEARCH = {"velocity": 40.0, "slow_velocity": 20.0, "travel": 300.0, "effort": 4.0, "stop_time_ms": 50.0}


class Bench:
    """A search with what it looks at, and what it asks of the motion: set-points with speeds, and stops."""

    def __init__(self, position: float = 100.0, gain: float = 180.0, *, at_switch: bool = False, **homing: Any) -> None:
        settings = axis_settings(SEARCH | homing)
        plant = settings.plant.model_copy(update={"gain": gain})
        self.design = design_axis(settings.model_copy(update={"plant": plant}), PERIOD_S)
        self.asked: list[tuple[float, float] | float] = []
        observer = SimpleNamespace(position=position, velocity=0.0, plant=self.design.plant)
        self.law = SimpleNamespace(observer=observer, effort=0.0, effort_limit=24.0, saturated=False, stage=Stage.SPEED)
        self.law.limit_effort = lambda limit: setattr(self.law, "effort_limit", limit)
        motion: Any = SimpleNamespace(
            law=self.law,
            doubts_sample=False,
            innovation_gate=0.5,
            set_target=lambda target, velocity: self.asked.append((target, velocity)),
            stop=self.stop,
        )
        self.drive = SimpleNamespace(
            home_switch=at_switch, index=77.0, fresh=True, position=position, forget_index=self.forget_index
        )
        drive: Any = self.drive
        self.search = Homing(self.design, motion, drive)

    def stop(self, deceleration: float, *, smooth: bool) -> None:
        assert smooth  # a search has time for the jerk that is set
        self.asked.append(deceleration)

    def forget_index(self) -> None:
        self.drive.index = None

    def at(self, position: float, stage: Stage = Stage.SPEED) -> bool:
        """Step with the axis at a position; return whether the search is done."""
        self.law.observer.position = self.drive.position = position
        self.law.stage = stage
        self.search.step()
        return self.search.done


@pytest.mark.parametrize(("direction", "sign"), [("positive", 1.0), ("negative", -1.0)])
def test_a_switch_is_passed_left_slowly_and_taken_where_it_opens(direction: str, sign: float) -> None:
    bench = Bench(method="switch", direction=direction)
    assert bench.asked == [(100.0 + sign * 600.0, 40.0)]
    assert (bench.search.direction, bench.search.reference, bench.law.effort_limit) == (sign, None, 24.0)
    assert not bench.at(100.0 + sign * 50.0)
    assert bench.asked[1:] == []
    bench.drive.home_switch = True
    assert not bench.at(100.0 + sign * 60.0)
    assert bench.asked[1:] == [2000.0]
    assert not bench.at(100.0 + sign * 61.0)  # it still brakes
    assert bench.asked[2:] == []
    assert not bench.at(100.0 + sign * 62.0, Stage.POSITION)
    assert bench.asked[2:] == [(100.0 - sign * 538.0, 20.0)]
    assert bench.search.direction == -sign
    bench.at(100.0 + sign * 58.0)
    bench.drive.home_switch = False
    bench.drive.fresh = False  # a switch that is not seen to be open is not
    bench.at(100.0 + sign * 57.5)
    assert (bench.search.reference, bench.asked[3:]) == (None, [])
    bench.drive.fresh = True
    assert not bench.at(100.0 + sign * 57.0)
    assert bench.search.reference == 100.0 + sign * 57.0
    assert bench.asked[3:] == [2000.0]
    assert not bench.at(100.0 + sign * 56.0)
    assert bench.at(100.0 + sign * 55.0, Stage.POSITION)
    assert bench.search.reference == 100.0 + sign * 57.0


@pytest.mark.parametrize(("direction", "sign"), [("positive", 1.0), ("negative", -1.0)])
def test_a_search_that_begins_on_the_switch_leaves_it_at_once(direction: str, sign: float) -> None:
    bench = Bench(method="switch", direction=direction, at_switch=True)
    assert bench.asked == [(100.0 - sign * 600.0, 20.0)]
    bench.drive.home_switch = False
    bench.at(100.0 - sign)
    assert bench.search.reference == 100.0 - sign


def test_other_searches_do_not_care_for_the_switch_and_are_slow() -> None:
    for method in ("index", "hard_stop"):
        bench = Bench(method=method, at_switch=True)
        assert bench.asked == [(-500.0, 20.0)]
        bench.drive.home_switch = None
        assert not bench.at(99.0)
        bench.drive.home_switch = True
        assert not bench.at(99.0)
        assert bench.asked[1:] == []


def test_a_switch_that_is_open_at_rest_has_been_passed_or_flickered() -> None:
    bench = Bench(method="switch")
    bench.drive.home_switch = True
    bench.at(99.0)
    bench.drive.home_switch = False
    bench.at(98.0)
    with pytest.raises(HomingFailed, match="overran it, or the switch only flickered"):
        bench.at(97.0, Stage.POSITION)


def test_a_search_for_a_switch_needs_one() -> None:
    bench = Bench(method="switch")
    bench.drive.home_switch = None
    with pytest.raises(HomingFailed, match="does not report a home switch"):
        bench.at(99.0)


def test_only_an_index_mark_from_now_on_counts() -> None:
    bench = Bench(method="index")
    assert not bench.at(99.0)
    assert bench.asked[1:] == []
    bench.drive.index = 98.5
    assert not bench.at(98.0)
    assert (bench.search.reference, bench.asked[1:]) == (98.5, [2000.0])
    assert bench.at(97.0, Stage.POSITION)


@pytest.mark.parametrize(("direction", "sign"), [("positive", 1.0), ("negative", -1.0)])
@pytest.mark.parametrize(("before_the_start", "ahead"), [(0.5, 0.0), (0.0, 0.5)])
def test_an_index_mark_is_taken_only_on_the_way_of_the_search(
    direction: str, sign: float, before_the_start: float, ahead: float
) -> None:
    """From 100 on by 2 mm: what a sample may be off by is 0.5 mm, and three ticks at 20 mm/s are 0.6."""
    for off, is_taken in ((0.59, True), (0.61, False), (900.0, False)):
        bench = Bench(method="index", direction=direction)
        bench.at(100.0 + sign)
        off_start = before_the_start + off if before_the_start else 0.0
        bench.drive.index = 100.0 - sign * off_start if before_the_start else 100.0 + sign * (2.0 + ahead + off)
        if is_taken:
            bench.at(100.0 + sign * 2.0)
            assert bench.search.reference == bench.drive.index
        else:
            with pytest.raises(HomingFailed, match=r"an index mark at .* where the axis has not been.* from 100 to "):
                bench.at(100.0 + sign * 2.0)
            assert bench.search.reference is None


def test_a_switch_or_a_mark_on_the_way_is_not_what_another_method_looks_for() -> None:
    hard_stop, switch = Bench(method="hard_stop"), Bench(method="switch")
    for bench in (hard_stop, switch):
        bench.drive.index = 98.5
        bench.at(98.0)
        assert bench.search.reference is None


@pytest.mark.parametrize(("direction", "sign"), [("positive", 1.0), ("negative", -1.0)])
@pytest.mark.parametrize("gain", [180.0, -180.0])
@pytest.mark.parametrize(("back_off", "leaves"), [(0.0, 1.0), (3.0, 3.0)])
def test_a_hard_stop_is_five_ticks_of_standstill_under_the_homing_effort_and_is_left(
    direction: str, sign: float, gain: float, back_off: float, leaves: float
) -> None:
    """50 ms are 5 ticks; 20 windows of 0.05 mm are 1 mm."""
    bench = Bench(gain=gain, method="hard_stop", direction=direction, back_off=back_off)
    assert bench.law.effort_limit == 4.0
    push = sign * 4.0 * (1.0 if gain > 0.0 else -1.0)
    place = 100.0 + sign * 10.0

    def still(ticks: int, effort: float = push, velocity: float = 2.0, *, saturated: bool = True) -> None:
        bench.law.effort, bench.law.observer.velocity, bench.law.saturated = effort, velocity, saturated
        for _ in range(ticks):
            bench.at(place)

    still(4)
    still(10, saturated=False)
    still(4)
    still(10, velocity=2.01)  # a tenth of the slow velocity
    still(10, velocity=-2.01)
    still(10, effort=-push)
    still(10, effort=0.0)
    still(4, velocity=-2.0)
    assert (bench.search.reference, bench.asked[1:]) == (None, [])
    still(1)
    assert bench.search.reference == place
    assert bench.asked[1:] == [(place - sign * 600.0, 20.0)]
    assert bench.search.direction == -sign
    bench.at(place - sign * (leaves - 0.01))
    assert bench.asked[2:] == []
    assert not bench.at(place - sign * leaves)
    assert bench.asked[2:] == [2000.0]
    assert not bench.at(place - sign * (leaves + 1.0))
    assert bench.at(place - sign * (leaves + 2.0), Stage.POSITION)
    assert bench.search.reference == place
    bench.search.end()
    assert bench.law.effort_limit == 24.0


def test_at_a_hard_stop_no_more_than_rest_is_standstill() -> None:
    """A tenth of 40 mm/s is more than the rest velocity of 2.5 mm/s."""
    for velocity, found in ((2.5, True), (2.51, False)):
        bench = Bench(method="hard_stop", slow_velocity=40.0)
        bench.law.effort, bench.law.saturated, bench.law.observer.velocity = -4.0, True, velocity
        for _ in range(5):
            bench.at(90.0)
        assert (bench.search.reference is not None) is found


def test_a_small_homing_effort_pushes_too() -> None:
    bench = Bench(method="hard_stop", effort=0.4)
    bench.law.effort, bench.law.saturated = -0.4, True
    for _ in range(5):
        bench.at(90.0)
    assert bench.search.reference == 90.0


@pytest.mark.parametrize("method", ["switch", "index", "hard_stop"])
def test_a_search_fails_past_its_travel(method: str) -> None:
    for side in (1.0, -1.0):
        bench = Bench(method=method)
        assert not bench.at(100.0 + side * 300.0)
        with pytest.raises(HomingFailed, match=r"axis\.homing\.travel is 300 mm"):
            bench.at(100.0 + side * 300.1)


def test_a_search_fails_after_twice_the_time_of_its_travel_and_ten_seconds() -> None:
    """2 x 300 mm at 20 mm/s take 30 s: with 10 s more, 4000 ticks."""
    bench = Bench(method="index")
    for _ in range(3999):
        bench.at(99.0)
    with pytest.raises(HomingFailed, match="no index within 1 mm"):
        bench.at(99.0)
