"""What a move will be like: as the demo then finds it, over an uncertainty, and against what the limits allow."""

import json
from pathlib import Path
from typing import Any

import pytest

from twostage_servo.app.assembly import build_drive, design
from twostage_servo.app.expected_response import (
    Expectation,
    PlannedMove,
    Response,
    bound_s,
    configured_move,
    corner_moves,
    expect,
    respond,
    trace,
    traces,
    worst_of,
)
from twostage_servo.app.tight_limit import tight_limit
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.axis.trips import TripCode
from twostage_servo.cli.main import main
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.loader import load

MOVE = PlannedMove(400.0, 100.0)

PAPER = "axis.law.type=paper"


def axis(*overrides: str, name: str = "demo.toml") -> tuple[AxisDesign, DriveTraits]:
    loaded = load(shipped_configuration(name), list(overrides))
    return design(loaded), build_drive(loaded).traits


def demo(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main(["demo", "--fast", "--json", *arguments]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


@pytest.mark.parametrize("law", ["paper", "adaptive"])
def test_the_response_is_the_one_that_the_demo_finds_over_frames(capsys: pytest.CaptureFixture[str], law: str) -> None:
    """The demo counts from the request on, a tick before the first effort; its encoder is the same."""
    found = demo(capsys, "--set", f"axis.law.type={law}")
    response = respond(*axis(f"axis.law.type={law}"), MOVE)
    assert response.settling_time_s == pytest.approx(found["settling_time_s"], abs=0.0201)
    assert response.overshoot == pytest.approx(found["overshoot"], rel=0.01, abs=0.005)  # of steps of 0.001 mm
    assert response.peak_velocity == pytest.approx(found["peak_velocity"], rel=0.002)
    assert response.trip is None


def test_off_its_model_a_plant_responds_as_the_demo_finds_it(capsys: pytest.CaptureFixture[str]) -> None:
    found = demo(capsys, "--set", "simulation.gain=234", "--set", "simulation.pole=9.8")
    response = respond(*axis(), MOVE, 1.3, 0.7)
    assert response.settling_time_s == pytest.approx(found["settling_time_s"], abs=0.0201)
    assert response.overshoot == pytest.approx(found["overshoot"], abs=0.005)
    assert response.peak_velocity == pytest.approx(found["peak_velocity"], rel=0.002)


@pytest.mark.long
def test_the_worst_of_an_uncertainty_is_that_of_its_corners() -> None:
    parts = axis()
    expected = expect(*parts, MOVE, 0.3)
    assert expected.nominal == respond(*parts, MOVE)
    corners = [respond(*parts, MOVE, gain, pole) for gain in (0.7, 1.3) for pole in (0.7, 1.3)]
    assert expected.worst == worst_of([expected.nominal, *corners])
    assert expected.worst.overshoot == max(one.overshoot for one in corners) > 2.0 * expected.nominal.overshoot
    assert expect(*parts, MOVE, 0.0).worst == expected.nominal


def test_a_response_that_trips_or_does_not_settle_is_the_worst() -> None:
    one, other = Response(4.0, 0.5, 100.0, 8.0), Response(5.0, 0.1, 120.0, 7.0)
    assert worst_of([one, other]) == Response(5.0, 0.5, 120.0, 8.0)
    tripped = Response(None, 0.0, 90.0, 24.0, TripCode.OVERSPEED)
    assert worst_of([one, tripped, other]) == Response(None, 0.5, 120.0, 24.0, TripCode.OVERSPEED)


def test_a_cruise_that_takes_more_than_the_effort_ends_in_a_trip() -> None:
    """250 mm/s with 70 % of the gain and 130 % of the pole take 36 V of 24."""
    response = respond(*axis(), PlannedMove(1000.0, 250.0), 0.7, 1.3)
    assert response.trip in {TripCode.SPEED_UNREACHABLE, TripCode.FOLLOWING_ERROR}
    assert response.settling_time_s is None


@pytest.mark.parametrize(("gain", "pole"), [(1.0, 1.0), (0.7, 1.3), (1.3, 0.7), (0.7, 0.7), (1.3, 1.3)])
def test_a_first_move_of_the_adaptive_law_comes_to_rest_without_a_trip(gain: float, pole: float) -> None:
    """Weak plants tripped by `stall` as they came to rest: no accepted plant brakes that hard."""
    response = respond(*axis("axis.law.type=adaptive"), MOVE, gain, pole)
    assert response.trip is None
    assert response.settling_time_s == pytest.approx(bound_s(axis()[0], MOVE), abs=0.05)
    assert response.overshoot < 0.005


@pytest.mark.parametrize(
    ("rate", "factor"),
    [
        (1000.0, 1.0),
        *[
            pytest.param(rate, factor, marks=pytest.mark.long)
            for rate in (300.0, 600.0, 3000.0)
            for factor in (0.75, 1.0, 1.25)
        ],
    ],
)
def test_on_a_short_tick_the_adaptive_law_asks_for_no_more_than_the_efforts_rate(rate: float, factor: float) -> None:
    """At 1000 V/s it oscillated by 20 V: loops as quick as a tick of 2 ms allows need five times that rate."""
    parts = axis("axis.law.type=adaptive", f"axis.limits.effort_rate={rate}", name="fast_tick.toml")
    for move in (MOVE, PlannedMove(20.0, 200.0)):
        response = respond(*parts, move, factor, factor)
        assert response.trip is None
        assert response.settling_time_s is not None
        assert response.settling_time_s < bound_s(parts[0], move) + 0.15
        assert response.overshoot < 0.05
        assert response.peak_velocity < 1.05 * move.velocity


def test_a_drive_without_counter_and_enabled_bit_is_one_that_answers() -> None:
    assert respond(*axis(name="plain_drive.toml"), MOVE).trip is None


def test_an_axis_that_has_to_be_homed_is_taken_for_homed(tmp_path: Path) -> None:
    assert respond(*axis("axis.homing.required=true"), MOVE) == respond(*axis(), MOVE)


@pytest.mark.long
def test_a_trace_is_a_move_tick_by_tick() -> None:
    parts = axis()
    response, points = trace(*parts, MOVE)
    assert response == respond(*parts, MOVE)
    assert [point.time_s for point in points[:3]] == pytest.approx([0.01, 0.02, 0.03])
    assert points[0].error == pytest.approx(-400.0, abs=0.1)
    assert max(point.error for point in points) == response.overshoot
    assert max(point.velocity for point in points) == response.peak_velocity
    assert max(abs(point.effort) for point in points) == response.peak_effort
    named = traces(*parts, MOVE, 0.2)
    assert list(named) == [
        "as the model", "gain -20 %, pole -20 %", "gain -20 %, pole +20 %", "gain +20 %, pole -20 %",
        "gain +20 %, pole +20 %",
    ]  # fmt: skip
    assert named["as the model"] == points


def test_the_configured_move_is_the_demos_and_the_corners_are_short_long_and_fast() -> None:
    settings = axis()[0].settings
    assert configured_move(settings, 100.0) == MOVE
    assert corner_moves(settings) == [
        PlannedMove(2.5, 100.0), MOVE, PlannedMove(2.5, 250.0), PlannedMove(1000.0, 250.0),
    ]  # fmt: skip
    narrow = axis("axis.limits.position_minimum=-100", "axis.limits.position_maximum=50")[0].settings
    assert configured_move(narrow, 100.0) == PlannedMove(150.0, 100.0)


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("axis.limits.overspeed=251", "overspeed"),
        ("axis.limits.following_error_minimum=1e-5", None),  # the other one allows enough
    ],
)
def test_a_limit_that_ends_a_move_is_named_with_what_would_do(override: str, key: str | None) -> None:
    parts = axis(PAPER, override)
    move = PlannedMove(1000.0, 250.0)
    tight = tight_limit(*parts, expect(*parts, move, 0.0))
    assert (None if tight is None else tight.key) == key
    if tight is not None:
        assert tight.enough is not None
        assert respond(*axis(PAPER, f"axis.limits.{key}={tight.enough}"), move).trip is None
        assert respond(*axis(PAPER, f"axis.limits.{key}={tight.value}"), move).trip is tight.trip


def test_a_limit_of_which_no_larger_value_would_do_is_named_as_well() -> None:
    parts = axis(PAPER, "axis.limits.effort_rate=1e-3")
    tight = tight_limit(*parts, expect(*parts, MOVE, 0.0))
    assert tight is not None
    assert tight.enough is None


def test_a_move_without_a_trip_breaks_no_limit() -> None:
    parts = axis()
    response = respond(*parts, MOVE)
    assert tight_limit(*parts, Expectation(MOVE, 4.0, response, response)) is None


def test_a_trip_that_is_about_no_limit_names_none() -> None:
    parts = axis()
    tripped = Response(None, 0.0, 90.0, 24.0, TripCode.NOT_FINITE)
    tight = tight_limit(*parts, Expectation(MOVE, 4.0, tripped, tripped))
    assert tight is not None
    assert (tight.key, tight.value, tight.enough) == (None, None, None)
