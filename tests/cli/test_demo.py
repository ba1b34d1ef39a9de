"""`demo --fast`: the contract's JSON and the moves that it promises, in this process and in simulated time."""

import csv
import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from twostage_servo.cli.main import main
from twostage_servo.cli.output import CommandError, ExitCode
from twostage_servo.config.loader import Config, LoadedConfig

QUANTUM = 0.001  # of the effort in the shipped DBC


def demo(capsys: pytest.CaptureFixture[str], *arguments: str, exit_code: int = 0) -> dict[str, Any]:
    assert main(["demo", "--fast", "--json", *arguments]) == exit_code
    (line,) = capsys.readouterr().out.splitlines()
    result: dict[str, Any] = json.loads(line)
    return result


PAPER = ("--set", "axis.law.type=paper")


def test_the_default_move_is_one_that_a_servo_engineer_respects(capsys: pytest.CaptureFixture[str]) -> None:
    """400 mm at 100 mm/s with 2000 mm/s²: 4.05 s to its band at best."""
    result = demo(capsys)
    assert result["law"]["type"] == "adaptive"
    assert result["trip"] is None
    assert abs(result["final_error"]) <= 0.005
    assert result["overshoot"] < 0.01
    assert result["settling_time_s"] <= 4.08
    assert result["peak_velocity"] < 101.0


def test_the_default_move_of_the_papers_law(capsys: pytest.CaptureFixture[str]) -> None:
    result = demo(capsys, *PAPER)
    assert set(result) >= {
        "target", "final_error", "overshoot", "settling_time_s", "peak_velocity", "changeover", "ticks", "frames",
        "trip", "trace_sha256",
    }  # fmt: skip
    assert result["target"] == 400.0
    assert abs(result["final_error"]) < 0.05
    assert 0.0 <= result["overshoot"] < 4.0
    assert 4.0 < result["settling_time_s"] < 7.0
    assert 100.0 < result["peak_velocity"] < 105.0
    # Equation (19) gives 54.53 mm; the change-over comes up to a tick, 1 mm, later. The estimate may be a quantum off.
    assert 53.5 <= result["changeover"]["distance"] <= 54.54
    assert result["changeover"]["effort_step"] <= result["changeover"]["ordinary_effort_step"] + QUANTUM
    assert result["changeover"]["effort_step"] <= 2 * QUANTUM
    assert 3.0 < result["changeover"]["time_s"] < 4.0
    assert result["ticks"]["missed"] == 0
    assert result["ticks"]["lateness_us"] == {"p50": 0.0, "p90": 0.0, "p99": 0.0, "max": 0.0}
    assert result["frames"]["sent"] >= result["ticks"]["count"] - 5
    assert result["frames"]["rejected"] == 0
    assert result["trip"] is None


@pytest.mark.parametrize(
    ("target", "velocity"), [(400, 100), (-400, 100), (5, 100), (0.05, 100), (2000, 100), (2000, 200), (-2000, 250)]
)
@pytest.mark.parametrize(
    "drive",
    [
        (),
        pytest.param(("simulation.noise_std=0.0316", "simulation.quantum=0.01"), marks=pytest.mark.long),
        pytest.param(("simulation.gain=234", "simulation.pole=9.8"), marks=pytest.mark.long),
    ],
    ids=["nominal", "noise", "30 percent off"],
)
def test_moves_settle_with_no_trip(
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
    target: float,
    velocity: float,
    drive: tuple[str, ...],
) -> None:
    if "simulation.noise_std=0.0316" in drive and target == 0.05:
        reason = (
            "a noise that has not been measured at rest yet, and a move as short as it: docs/adaptive-law.md, limits"
        )
        request.applymarker(pytest.mark.xfail(strict=True, reason=reason))
    overrides = [argument for override in drive for argument in ("--set", override)]
    result = demo(capsys, "--to", str(target), "--velocity", str(velocity), *overrides)
    assert result["trip"] is None
    assert result["settling_time_s"] is not None
    assert abs(result["final_error"]) <= 0.06
    if changeover := result["changeover"]:
        # Rounding of a difference of two rounded efforts: half a quantum each.
        assert changeover["effort_step"] <= changeover["ordinary_effort_step"] + 1.01 * QUANTUM


def test_moves_go_to_the_set_point_and_back(capsys: pytest.CaptureFixture[str]) -> None:
    result = demo(capsys, "--to", "120", "--moves", "3")
    assert [move["target"] for move in result["moves"]] == [120.0, 0.0, 120.0]
    for move in result["moves"]:
        assert abs(move["final_error"]) < 0.05
        assert move["peak_velocity"] > 99.0
        assert move["changeover"]["time_s"] > 0.5
    of_the_first = {name: result[name] for name in result["moves"][0] if name != "target"}
    assert of_the_first == {name: figure for name, figure in result["moves"][0].items() if name != "target"}
    alone, first = demo(capsys, "--to", "120"), result["moves"][0]
    assert alone["settling_time_s"] == first["settling_time_s"]
    assert alone["overshoot"] == pytest.approx(first["overshoot"], abs=1e-3)


def test_a_trip_in_the_second_move_ends_the_demo_with_the_figures_of_both(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--to", "120", "--moves", "3", "--set", "simulation.load=-40", "--set", "simulation.load_at_s=3"]
    result = demo(capsys, *arguments, exit_code=3)
    assert [move["target"] for move in result["moves"]] == [120.0, 0.0]
    assert abs(result["moves"][0]["final_error"]) < 0.05
    assert result["trip"] is not None
    assert "tripped" in result["failure"]


@pytest.mark.parametrize("count", ["0", "-1", "1001", "2.5"])
def test_a_number_of_moves_that_makes_no_sense_is_refused(count: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["demo", "--fast", "--moves", count])
    assert caught.value.code == 2
    assert "moves" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("jerk", "settling_s", "changeover"), [(40_000, 4.07, 6.6), (5_000, 4.22, 15.7), (900, 4.55, 35.9)]
)
def test_a_smooth_reference_takes_longer_and_overshoots_no_more(
    jerk: int, settling_s: float, changeover: float, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The S-curve takes ``v/a + a/j``, or twice the root of v/j; the braking is planned with nine tenths of j."""
    trace = tmp_path / "trace.csv"
    keys = ("axis.law.type=adaptive", f"axis.law.jerk={jerk}")
    result = demo(capsys, "--trace", str(trace), *(part for key in keys for part in ("--set", key)))
    assert result["trip"] is None
    assert result["settling_time_s"] == pytest.approx(settling_s, abs=0.015)
    assert result["overshoot"] < 0.005
    assert abs(result["final_error"]) < 0.002
    assert result["changeover"]["distance"] == pytest.approx(changeover, abs=1.0)
    assert result["changeover"]["effort_step"] <= result["changeover"]["ordinary_effort_step"] + QUANTUM
    with trace.open(encoding="utf-8") as file:
        speeds = [float(row["speed_reference"]) for row in csv.DictReader(file)]
    slopes = [after - before for before, after in pairwise(speeds)]
    assert max(abs(after - before) for before, after in pairwise(slopes)) <= jerk * 1e-4 * 1.001
    peak_s = min(2000.0 / jerk, (100.0 / jerk) ** 0.5)
    rise_s = 100.0 / min(2000.0, (100.0 * jerk) ** 0.5) + peak_s
    assert sum(slope > 0.0 for slope in slopes) == pytest.approx(rise_s / 0.01, abs=7.0)


def test_the_adaptive_law_moves_like_a_servo_and_shows_what_it_has_found(capsys: pytest.CaptureFixture[str]) -> None:
    off = ("--set", "simulation.gain=216", "--set", "simulation.pole=11.2")
    result = demo(capsys, "--set", "axis.law.type=adaptive", "--moves", "3", *off)
    assert result["trip"] is None
    for move in result["moves"]:
        assert move["settling_time_s"] < 4.12
        assert move["overshoot"] < 0.05
        assert move["peak_velocity"] < 112.0
    law = result["law"]
    assert (law["type"], law["accepted"]) == ("adaptive", True)
    identified = law["identified"]
    assert identified["gain"] == pytest.approx(216.0, rel=0.02)
    assert identified["pole"] == pytest.approx(11.2, rel=0.02)
    assert identified["delay_ticks"] == 0
    assert identified["load"]["forward"] == pytest.approx(0.0, abs=0.15)
    assert identified["load"]["backward"] == pytest.approx(0.0, abs=0.15)
    assert law["rejection"] is None
    assert demo(capsys, *PAPER)["law"] == {"type": "paper", "identified": None, "accepted": None, "rejection": None}


@pytest.mark.parametrize(
    ("changed", "codes"),
    [
        (("simulation.resonance_hz=15",), {"fit_residual", "unexplained_motion"}),
        (("simulation.resonance_hz=15", "simulation.resonance_damping=0.05"), {"fit_residual", "unexplained_motion"}),
        (("simulation.backlash=0.2",), {"fit_residual"}),
    ],
)
def test_on_a_plant_of_another_form_the_adaptive_law_degrades_and_says_so(
    changed: tuple[str, ...], codes: set[str], capsys: pytest.CaptureFixture[str]
) -> None:
    sets = [argument for key in ("axis.law.type=adaptive", *changed) for argument in ("--set", key)]
    result = demo(capsys, "--moves", "3", *sets)
    assert result["trip"] is result["failure"] is None
    assert result["law"]["rejection"]["code"] in codes
    assert result["law"]["rejection"]["degrades"]
    assert not result["law"]["accepted"]
    for move in result["moves"]:
        assert move["overshoot"] < 1.0
        assert abs(move["final_error"]) < 0.05


def test_a_pole_three_times_the_models_is_named_when_the_model_monitor_trips(
    capsys: pytest.CaptureFixture[str],
) -> None:
    sets = ("--set", "axis.law.type=adaptive", "--set", "simulation.pole=42")
    result = demo(capsys, *sets, exit_code=ExitCode.FAILED)
    assert result["trip"]["code"] == "model_mismatch"
    assert result["law"]["rejection"]["code"] == "pole_out_of_bounds"


@pytest.mark.parametrize("example", ["example1.toml", "example2.toml"])
def test_the_papers_examples_settle(capsys: pytest.CaptureFixture[str], example: str) -> None:
    result = demo(capsys, "--config", example)
    assert result["trip"] is None
    assert abs(result["final_error"]) < 0.1


def test_a_load_in_mid_move_is_worked_off(capsys: pytest.CaptureFixture[str]) -> None:
    result = demo(capsys, "--set", "simulation.load=3", "--set", "simulation.load_at_s=2")
    assert result["trip"] is None
    assert abs(result["final_error"]) < 0.05


def test_a_drive_that_speaks_can_fd_can_be_tried(capsys: pytest.CaptureFixture[str]) -> None:
    result = demo(capsys, "--to", "60", "--set", "bus.fd=true")
    assert result["trip"] is None
    assert result["frames"]["rejected"] == 0
    assert result["final_error"] == demo(capsys, "--to", "60")["final_error"]


def test_a_drive_mounted_the_other_way_round_can_be_tried(capsys: pytest.CaptureFixture[str]) -> None:
    turned = demo(capsys, "--to", "60", "--set", "axis.plant.gain=-180", "--set", "simulation.gain=-180")
    straight = demo(capsys, "--to", "60")
    assert turned["trip"] is None
    assert turned["final_error"] == pytest.approx(straight["final_error"], abs=2e-3)


def test_the_trace_hash_depends_on_the_seed_and_on_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    noisy = ("--to", "60", "--set", "simulation.noise_std=0.01")
    first, again = demo(capsys, *noisy), demo(capsys, *noisy)
    other = demo(capsys, *noisy, "--set", "simulation.seed=2")
    assert first == again
    assert first["trace_sha256"] != other["trace_sha256"]
    quiet = ("--to", "60")
    assert demo(capsys, *quiet) == demo(capsys, *quiet, "--set", "simulation.seed=2")


def test_a_trip_ends_with_exit_code_3_and_says_why(capsys: pytest.CaptureFixture[str]) -> None:
    # Dry friction beyond axis.limits.stall_effort cannot be told from a stall.
    result = demo(capsys, *PAPER, "--set", "simulation.coulomb_friction=5", exit_code=3)
    assert result["trip"]["code"] == "stall"
    assert "axis.limits.stall_effort is 2.5" in result["trip"]["cause"]
    assert "reset" in result["trip"]["next_action"]
    assert result["settling_time_s"] is None


def test_a_trip_while_it_is_being_armed_is_told_with_its_cause(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--fast", "--set", "simulation.load=-24"]) == 3
    assert re.search(r"no move to 400 mm: the axis did not arm: .+ mm", capsys.readouterr().out)


def test_a_silent_drive_ends_with_exit_code_3(capsys: pytest.CaptureFixture[str]) -> None:
    result = demo(capsys, "--set", "simulation.frame_loss=1", exit_code=3)
    assert "there is no fresh feedback" in result["failure"]
    assert result["changeover"] is None


def test_dry_friction_below_the_stall_effort_is_worked_off(capsys: pytest.CaptureFixture[str]) -> None:
    result = demo(capsys, "--set", "simulation.coulomb_friction=0.5")
    assert result["trip"] is None
    assert abs(result["final_error"]) < 0.1


@pytest.mark.parametrize(
    ("arguments", "limits"),
    [
        ((), (100.0, 20, 250.0)),
        (("--set", "axis.limits.missed_ticks=7"), (100.0, 7, 250.0)),  # what the operator says comes last
        (("--fast",), (30.0, 2, 100.0)),
        (("--config", "demo.toml"), (30.0, 2, 100.0)),
    ],
)
def test_only_the_embedded_demo_in_real_time_is_patient(
    monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], limits: tuple[float, int, float]
) -> None:
    loaded: list[Config] = []

    def refuse(configuration: LoadedConfig[Config], *_: object) -> None:
        loaded.append(configuration.config)
        raise CommandError(ExitCode.FAILED, "test", "seen enough")

    monkeypatch.setattr("twostage_servo.app.demonstration.demonstrate", refuse)
    assert main(["demo", *arguments]) == 3
    (config,) = loaded
    axis, simulation = config.axis.limits, config.simulation
    assert (axis.stale_feedback_ms, axis.missed_ticks, simulation.command_timeout_ms) == limits


@pytest.mark.parametrize("arguments", [("--to", "2501"), ("--to", "nan"), ("--velocity", "0"), ("--velocity", "inf")])
def test_a_set_point_out_of_range_is_bad_usage(capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...]) -> None:
    result = demo(capsys, *arguments, exit_code=2)
    assert result["error"]["code"] in {"position_limit", "velocity_limit"}


def test_for_people_it_prints_a_summary(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--fast", "--to", "60"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("moved to 60 mm\ntrue position: within ±0.06 mm after")
    assert "set-point; the effort changed by" in out


def test_the_trace_holds_every_tick(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    result = demo(capsys, "--to", "60", "--trace", str(tmp_path / "trace.csv"))
    with (tmp_path / "trace.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == result["ticks"]["count"]
    last = [row for row in rows if row["state"] == "holding"][-1]
    assert float(last["true_position"]) == pytest.approx(60.0 + result["final_error"], abs=1e-9)


def test_an_axis_that_cannot_be_armed_says_why(capsys: pytest.CaptureFixture[str]) -> None:
    result = demo(capsys, "--set", "simulation.initial_position=5000", exit_code=3)
    told = "the axis cannot be armed: the axis stands at 5000 mm, more than 20 mm outside its limits -2500 to 2500"
    assert result["failure"].startswith(told)


def test_a_trace_that_cannot_be_written_is_told(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    result = demo(capsys, "--to", "1", "--trace", str(tmp_path / "missing" / "trace.csv"), exit_code=3)
    assert result["error"]["code"] == "trace"
