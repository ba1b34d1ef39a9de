"""Limits that protect from nothing: on which side of which number each is told, with which numbers, and what to do."""

import dataclasses
from typing import Any

import pytest

from tests.axis.rig import DEMO, PERIOD_S, paper
from twostage_servo.axis.design import AxisDesign, design_axis
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.weak_limits import WeakLimit, weak_limits
from twostage_servo.control.plant import Plant

DESIGN = design_axis(AxisSettings.model_validate(DEMO), PERIOD_S)
"""5,000 mm at 250 mm/s, 20 mm to stop in past the limits, a tick of 10 ms."""

LIMITS = DEMO["limits"]


def changed(tick_s: float = PERIOD_S, **tables: Any) -> AxisDesign:
    """Return the demo's axis with other settings; "limits", "plant" and "window" only as far as they are given."""
    merged = {
        name: DEMO[name] | table if name in DEMO and name != "cruise_velocity" else table
        for name, table in tables.items()
    }
    settings = AxisSettings.model_validate(DEMO | merged)
    limits, law = settings.limits, paper(DESIGN)
    task = dataclasses.replace(
        law.task,
        plant=Plant(settings.plant.gain, settings.plant.pole),
        period_s=tick_s,
        effort_limit=limits.effort,
        effort_rate_limit=limits.effort_rate,
    )
    return dataclasses.replace(DESIGN, settings=settings, period_s=tick_s, law=dataclasses.replace(law, task=task))


def value_of(design: AxisDesign, key: tuple[str, ...]) -> object:
    value: object = design.settings
    for name in key:
        value = getattr(value, name)
    return value


def weak(
    tick_s: float = PERIOD_S, resolution: float = 0.001, *, heartbeat: bool = True, **tables: Any
) -> list[WeakLimit]:
    design = changed(tick_s, **tables)
    found = list(weak_limits(design, resolution, heartbeat=heartbeat))
    for one in found:
        assert one.value == value_of(design, one.key)
        assert ": " in one.disables
        assert "None" not in one.disables
        assert one.do
    return found


@pytest.mark.parametrize(("tick_s", "time_ms", "warns"), [(0.01, 4.9, True), (0.01, 5.0, False), (0.02, 5.0, True)])
@pytest.mark.parametrize("is_cyclic", [True, False])
def test_a_drive_that_samples_on_its_own_clock_needs_half_a_tick(
    tick_s: float, time_ms: float, warns: bool, is_cyclic: bool
) -> None:
    design = changed(tick_s, limits={"innovation_time_ms": time_ms})
    found = [one.key for one in weak_limits(design, 0.001, heartbeat=True, is_cyclic=is_cyclic)]
    assert (("limits", "innovation_time_ms") in found) is (warns and is_cyclic)


def keys(**tables: Any) -> list[str]:
    return [".".join(one.key) for one in weak(**tables)]


def of_limits(**limits: Any) -> list[str]:
    return [key.removeprefix("limits.") for key in keys(limits=limits)]


def test_nothing_is_said_of_the_demo() -> None:
    assert weak() == []


# On which side of which number ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "last", "first"),
    [
        ("missed_ticks", 8, 9),  # 20 mm are 80 ms at 250 mm/s
        ("stale_feedback_ms", 80.0, 80.1),
        ("innovation_gate", 20.0, 20.01),
        ("innovation_time_ms", 80.0, 80.1),
        ("position_overrun", 5000.0, 5000.1),
        ("undetected_travel", 5000.0, 5000.1),
        ("overspeed", 401.0, 401.2),  # 24 V make 308.57 mm/s, and 30 % more
        ("following_error_minimum", 2500.0, 2500.1),
        ("following_error_time_s", 10.0, 10.01),
        ("stall_time_ms", 500.0, 500.1),  # effort_saturation_ms
        ("feedback_errors", 66, 67),  # stale after 30 ms: two of three are lost
        ("effort_saturation_ms", 20_000.0, 20_000.1),
        ("heartbeat_ms", 20_000.0, 20_000.1),
    ],
)
def test_the_first_value_that_protects_from_nothing_is_told(name: str, last: float, first: float) -> None:
    assert of_limits(**{name: last}) == []
    assert of_limits(**{name: first}) == [name]
    (told,) = weak(limits={name: first})
    assert told.value == first


@pytest.mark.parametrize(("tick_s", "last"), [(0.005, 16), (0.01, 8), (0.02, 4)])
def test_missed_ticks_count_by_their_length(tick_s: float, last: int) -> None:
    assert weak(tick_s, limits={"missed_ticks": last, "stale_feedback_ms": 60.0}) == []
    (told,) = weak(tick_s, limits={"missed_ticks": last + 1, "stale_feedback_ms": 60.0})
    assert told.do == f"lower it to {last} at most"
    assert f"a suspended host: at 250 mm/s the axis moves {250 * tick_s * (last + 1):.4g} mm" in told.disables
    (told,) = weak(tick_s, limits={"stale_feedback_ms": 90.0})
    assert told.do == "lower it to 80 at most"
    assert "a silent drive: at 250 mm/s the axis moves 22.5 mm in that time" in told.disables


def test_an_overrun_of_more_than_the_travel_allows_no_more_than_that() -> None:
    """10 mm of travel at 250 mm/s are 40 ms."""
    short = {"position_minimum": 0.0, "position_maximum": 10.0, "position_overrun": 30.0}
    assert "missed_ticks" not in of_limits(**short, missed_ticks=4)
    (told,) = [one for one in weak(limits=short | {"missed_ticks": 5}) if one.key[-1] == "missed_ticks"]
    assert told.do == "lower it to 4 at most"


@pytest.mark.parametrize("name", ["innovation_gate", "innovation_time_ms"])
def test_a_gate_is_told_with_how_far_it_is_open(name: str) -> None:
    (told,) = weak(limits={name: 90.0})
    width = {"innovation_gate": "90", "innovation_time_ms": "22.5"}[name]
    assert f"up to {width} mm are accepted, more than the 20 mm in which" in told.disables


@pytest.mark.parametrize(
    ("table", "name", "last", "first"),
    [
        ("window", "position", 54.0, 55.0),  # the change-over distance at 100 mm/s is 54.53 mm
        ("window", "position", 0.0005, 0.000499),  # half a step of the encoder
        ("homing", "slow_velocity", 0.001 / 3600.0, 0.00099 / 3600.0),
        ("homing", "velocity", 0.001 / 3600.0, 0.00099 / 3600.0),
    ],
)
def test_of_moves_and_searches_likewise(table: str, name: str, last: float, first: float) -> None:
    assert keys(**{table: {name: last}}) == []
    tables: dict[str, Any] = {table: {name: first}}
    (told,) = weak(**tables)
    assert (told.key, told.value) == ((table, name), first)


def test_a_cruise_that_is_none_is_told() -> None:
    assert keys(cruise_velocity=0.001 / 3600.0, window={"position": 0.0005}) == ["window.position"]
    assert keys(cruise_velocity=0.0009 / 3600.0, window={"position": 0.0005}) == ["window.position", "cruise_velocity"]


def test_a_window_wider_than_the_travel_is_told_whatever_the_law_does() -> None:
    short = {"position_minimum": 0.0, "position_maximum": 10.0}
    assert "window.position" not in keys(limits=short, window={"position": 10.0})
    assert "window.position" in keys(limits=short, window={"position": 10.1})


@pytest.mark.parametrize("name", ["arming_timeout_ms", "jog_timeout_ms"])
def test_a_time_in_which_the_axis_crosses_its_travel_is_told(name: str) -> None:
    short = {"position_minimum": 0.0, "position_maximum": 25.0}  # 100 ms at 250 mm/s
    long: dict[str, Any] = {name: 101.0}
    assert name not in keys(limits=short, **{name: 100.0})
    (told,) = [one for one in weak(limits=short, **long) if one.key == (name,)]
    assert told.value == 101.0
    assert "crosses its whole travel in 100 ms" in told.disables
    assert told.do == "lower it well below that"


# What is in use only by something else -------------------------------------------------------------------------------


def test_a_heartbeat_that_the_drive_does_not_have_is_not_missed() -> None:
    assert weak(limits={"heartbeat_ms": 30_000.0}, heartbeat=False) == []


@pytest.mark.parametrize("method", ["set_here", "switch", "hard_stop", "index"])
def test_a_search_has_an_end_and_a_push_too(method: str) -> None:
    searches, pushes = method != "set_here", method == "hard_stop"
    ends = 2.0 * (5000.0 + 20.0)
    assert keys(homing={"method": method, "travel": ends}) == []
    assert keys(homing={"method": method, "travel": ends + 0.1}) == ["homing.travel"] * searches
    assert keys(homing={"method": method, "stop_time_ms": 20_000.0}) == []
    assert keys(homing={"method": method, "stop_time_ms": 20_000.1}) == ["homing.stop_time_ms"] * pushes
    for told in weak(homing={"method": method, "travel": ends + 0.1}):
        assert told.value == ends + 0.1
        assert told.disables == "the end of a search that finds nothing: the whole travel is 5000 mm"
        assert told.do


@pytest.mark.parametrize("direction", ["either", "positive", "negative"])
def test_an_approach_is_looked_at_where_there_is_one(direction: str) -> None:
    assert keys(approach={"direction": direction, "distance": 2500.0}) == []
    assert keys(approach={"direction": direction, "distance": 2500.1}) == ["approach.distance"] * (
        direction != "either"
    )


# A stall, and frames --------------------------------------------------------------------------------------------------


def test_a_stall_time_is_told_once_by_whatever_makes_it_useless() -> None:
    (told,) = weak(limits={"stall_time_ms": 20_000.0})
    assert told.disables.startswith("the trip for a stall: effort_saturation_ms is shorter")
    (told,) = weak(limits={"stall_time_ms": 20_000.1})
    assert "crosses its whole travel" in told.disables
    long = {"effort_saturation_ms": 30_000.0}
    assert of_limits(**long, stall_time_ms=20_000.0) == ["effort_saturation_ms"]
    assert of_limits(**long, stall_time_ms=25_000.0) == ["effort_saturation_ms", "stall_time_ms"]


@pytest.mark.parametrize(
    ("stale_ms", "errors", "told"),
    [(10.0, 100, 0), (20.0, 50, 0), (20.0, 51, 1), (30.0, 66, 0), (30.0, 67, 1), (70.0, 85, 0), (70.0, 86, 1)],
)
def test_bad_frames_are_counted_in_vain_where_the_feedback_is_stale_before(
    stale_ms: float, errors: int, told: int
) -> None:
    found = weak(limits={"stale_feedback_ms": stale_ms, "feedback_errors": errors})
    assert [one.key for one in found] == [("limits", "feedback_errors")] * told
    for one in found:
        assert (one.value, one.do) == (errors, f"lower it to {errors - 1} at most")


# Stops ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("limits", "told"),
    [
        ({"acceleration": 12.4}, [("acceleration", "a stop")]),  # 250²/(2 · 12.5) are 2,500 mm, half of the travel
        (
            {"acceleration": 12.4, "quick_stop_deceleration": 12.4},
            [("acceleration", "a stop"), ("quick_stop_deceleration", "a quick stop")],
        ),
        ({"acceleration": 12.51, "quick_stop_deceleration": 12.51}, [("effort_rate", "a stop")]),
        ({"acceleration": 14.0, "quick_stop_deceleration": 14.0}, []),
        ({"effort_rate": 0.5}, [("effort_rate", "a stop")]),  # named once: a quick stop has it as well
        ({"acceleration": 12.51}, [("effort_rate", "a stop")]),  # not the ramp, but the tick until it begins
    ],
)
def test_a_stop_that_takes_half_of_the_travel_is_none(limits: dict[str, float], told: list[tuple[str, str]]) -> None:
    found = [one for one in weak(limits=limits) if one.key[1] != "overspeed"]
    assert [(one.key[1], one.disables.partition(":")[0]) for one in found] == told
    for one in found:
        assert one.value == (LIMITS | limits)[one.key[1]]
        assert "and the whole travel is 5000 mm" in one.disables


def test_a_plant_that_is_mounted_the_other_way_round_is_as_fast() -> None:
    assert keys(plant={"gain": -180.0}) == []
    assert keys(plant={"gain": -180.0}, limits={"overspeed": 402.0}) == ["limits.overspeed"]
