"""What `check` says of limits that are valid and protect from nothing."""

import json
from pathlib import Path
from typing import Any

import pytest

from twostage_servo.axis.settings import LimitSettings
from twostage_servo.cli.main import main

CONFIG = Path(__file__).parents[2] / "config"
TRULY = {"example1.toml": ["axis.limits.overspeed"], "example2.toml": ["axis.limits.overspeed"]}
"""The paper's examples, whose plant does not come to the speed at which they trip."""
NOT_BY_BEING_LARGE = {
    "position_minimum", "position_maximum", "velocity", "acceleration", "quick_stop_deceleration", "effort",
    "effort_rate",
}  # fmt: skip
"""Limits that bound what the axis is asked for: how large they are is for the machine to say."""


def check(capsys: pytest.CaptureFixture[str], *overrides: str, config: str = "demo.toml") -> tuple[int, dict[str, Any]]:
    arguments = [argument for override in overrides for argument in ("--set", override)]
    code = main(["check", "--json", str(CONFIG / config), *arguments])
    return code, json.loads(capsys.readouterr().out)


def warned(capsys: pytest.CaptureFixture[str], *overrides: str) -> list[dict[str, Any]]:
    code, told = check(capsys, *overrides)
    assert (code, told["valid"]) == (0, True)
    return list(told["warnings"])


@pytest.mark.parametrize("name", sorted(path.name for path in CONFIG.glob("*.toml")))
def test_shipped_files_are_warned_of_what_is_true_alone(capsys: pytest.CaptureFixture[str], name: str) -> None:
    code, told = check(capsys, config=name)
    assert code == 0
    keys = [warning["key"] for one in told.get("axes", [told]) for warning in one["warnings"]]
    assert keys == TRULY.get(name, [])


def test_a_drive_with_a_clock_of_its_own_may_misdate_samples_by_half_a_tick(capsys: pytest.CaptureFixture[str]) -> None:
    code, told = check(capsys, "axis.limits.innovation_time_ms=3", config="free_running.toml")
    (one,) = told["warnings"]
    assert (code, one["key"], one["value"]) == (0, "axis.limits.innovation_time_ms", 3.0)
    assert "wrongly by 5 ms, 1.25 mm at 250 mm/s" in one["disables"]
    assert one["do"] == "set at least 5"


@pytest.mark.parametrize(
    ("override", "disables"),
    [
        ("axis.limits.missed_ticks=40", "a suspended host: at 250 mm/s the axis moves 100 mm in that time"),
        ("axis.limits.stale_feedback_ms=100", "a silent drive: at 250 mm/s the axis moves 25 mm"),
        ("axis.limits.overspeed=410", "the trip for overspeed: at full effort the axis reaches 308.6 mm/s"),
        ("axis.limits.following_error_minimum=2600", "the trip for following error"),
        ("axis.limits.following_error_time_s=11", "the trip for following error: 2750 mm are allowed"),
        ("axis.limits.innovation_gate=21", "the trip for an encoder that jumps"),
        ("axis.window.position=60", "begins 4.5 mm before the set-point, so it counts as reached immediately"),
        ("axis.window.position=0.0004", "the encoder has steps of 0.001 mm"),
        ("axis.limits.stall_time_ms=30000", "the trip for a stall: at its largest velocity the axis crosses"),
        ("axis.limits.stall_time_ms=501", "the trip for a stall: effort_saturation_ms is shorter"),
        ("axis.limits.heartbeat_ms=20001", "whole travel in 2e+04 ms"),
        ("axis.limits.effort_saturation_ms=20001", "the trip for an effort that stays at its limit"),
        ("axis.limits.feedback_errors=67", "the trip for bad frames: with more than 67 in 100 ticks"),
        ("axis.limits.position_overrun=5001", "the position limits"),
        ("axis.limits.undetected_travel=5001", "the bound on travel with a wrong encoder"),
        ("axis.arming_timeout_ms=20001", "a drive that does not disable"),
        ("axis.homing.slow_velocity=1e-8", "motion: at less than 2.78e-07 mm/s"),
    ],
)
def test_a_limit_that_disables_its_protection_is_named_with_value_and_place(
    capsys: pytest.CaptureFixture[str], override: str, disables: str
) -> None:
    warnings = warned(capsys, override)
    key, _, value = override.partition("=")
    (warning,) = warnings
    assert (warning["key"], warning["value"]) == (key, float(value))
    assert (warning["file"], warning["line"]) == (f"--set {override}", None)
    assert disables in warning["disables"]
    assert warning["do"]
    assert main(["check", str(CONFIG / "demo.toml"), "--set", override]) == 0
    out = capsys.readouterr().out
    assert f"\nWarning: --set {override}: {key} = " in out
    assert warning["do"] in out


@pytest.mark.parametrize(
    "override",
    [
        "axis.limits.missed_ticks=8", "axis.limits.stale_feedback_ms=79", "axis.limits.overspeed=400",
        "axis.limits.innovation_gate=10", "axis.limits.stall_time_ms=499", "axis.limits.feedback_errors=66",
        "axis.window.position=4", "axis.window.position=0.0005", "axis.approach.distance=1e9",
    ],
)  # fmt: skip
def test_what_still_protects_is_not_warned_of(capsys: pytest.CaptureFixture[str], override: str) -> None:
    assert warned(capsys, override) == []


@pytest.mark.parametrize(
    "overrides",
    [
        ("axis.approach.distance=1e9", 'axis.approach.direction="positive"'),
        ("axis.homing.travel=1e9", 'axis.homing.method="switch"'),
        ("axis.homing.stop_time_ms=6e4", 'axis.homing.method="hard_stop"'),
    ],
)
def test_what_is_in_use_only_by_another_key_is_warned_of_then(
    capsys: pytest.CaptureFixture[str], overrides: tuple[str, str]
) -> None:
    assert warned(capsys, overrides[0]) == []
    assert [one["key"] for one in warned(capsys, *overrides)] == [overrides[0].partition("=")[0]]


def test_a_warning_names_the_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    text = (CONFIG / "demo.toml").read_text("utf-8").replace("overspeed = 320.0", "overspeed = 1e9")
    (tmp_path / "wide.toml").write_text(text, "utf-8")
    code, told = check(capsys, config=str(tmp_path / "wide.toml"))
    (warning,) = told["warnings"]
    line = next(number for number, one in enumerate(text.split("\n"), 1) if "overspeed = 1e9" in one)
    assert (code, warning["file"], warning["line"]) == (0, str(tmp_path / "wide.toml"), line)


@pytest.mark.parametrize("name", sorted(set(LimitSettings.model_fields) - NOT_BY_BEING_LARGE))
def test_no_limit_can_be_taken_to_its_bound_in_silence(capsys: pytest.CaptureFixture[str], name: str) -> None:
    bounds = [bound.le for bound in LimitSettings.model_fields[name].metadata if hasattr(bound, "le")]
    largest = bounds[0] if bounds else 1e9
    code, told = check(capsys, f"axis.limits.{name}={largest:g}")
    if code == 0:
        assert f"axis.limits.{name}" in [warning["key"] for warning in told["warnings"]]
    else:
        assert code == 2


@pytest.mark.parametrize(("stated_ms", "is_warned"), [(800.0, True), (5571.0, True), (5573.0, False), (None, False)])
def test_a_time_to_brake_in_which_the_axis_does_not_come_to_rest_is_warned_of(
    capsys: pytest.CaptureFixture[str], stated_ms: float | None, is_warned: bool
) -> None:
    stated = [] if stated_ms is None else [f"service.shutdown_timeout_ms={stated_ms}"]
    code, told = check(capsys, *stated, config="metres.toml")
    keys = [(warning["key"], warning["value"]) for warning in told["warnings"]]
    assert (code, keys) == (0, [("service.shutdown_timeout_ms", stated_ms)] if is_warned else [])
    if is_warned:
        (warning,) = told["warnings"]
        assert "axis gantry takes 5572 ms to stop from 1 m/s, but its drive is disabled earlier" in warning["disables"]
        assert warning["do"] == "remove it, or set at least 5572"
    elif stated_ms is None:
        assert told["longest_end_s"] == pytest.approx(12.5 + 2.0 * 5.572, abs=0.01)


def test_an_effort_rate_that_lets_no_move_end_is_a_problem(capsys: pytest.CaptureFixture[str]) -> None:
    code, told = check(capsys, "axis.law.type=paper", "axis.limits.effort_rate=1e-3")
    assert code == 2
    (problem,) = told["error"]["problems"]
    assert "trips (position_limit) even if the plant is as axis.plant says" in problem["message"]
