"""`check` and `design`: every broken file ends with exit code 2, its line and its key; the bus is never touched."""

import json
import re
from importlib.resources import files
from pathlib import Path

import can
import pytest

from tests.demo_file import DEMO, LAW_OF_THE_DEMO
from twostage_servo.cli.main import main

SHIPPED = Path(str(files("twostage_servo_config")))

# (what is replaced in demo.toml, by what, the key that must be named, words that must be there)
BROKEN = [
    ("gain = 180.0 ", "gian = 180.0 ", "axis.plant.gian", "unknown key; did you mean axis.plant.gain"),
    ("gain = 180.0 ", 'gain = "180" ', "axis.plant.gain", "a number is needed"),
    ("gain = 180.0 ", "gain = 0.0 ", "axis.plant", "effort would not move this plant"),
    ("gain = 180.0 ", "gain = nan ", "axis.plant.gain", "not finite"),
    ("gain = 180.0 ", "gain = inf ", "axis.plant.gain", "not finite"),
    ("gain = 180.0 ", "gain = true ", "axis.plant.gain", "a number is needed"),
    ("gain = 180.0 ", "gain = [180.0] ", "axis.plant.gain", "a number is needed"),
    ("pole = 14.0 ", "pole = -14.0 ", "axis.plant.pole", "at least 0.001"),
    ("pole = 14.0 ", "pole = 0 ", "axis.plant.pole", "at least 0.001"),
    ("effort = 24.0", "effort = -24.0", "axis.limits.effort", "greater than 0"),
    ("effort = 24.0", "effort = 10.0", "axis.limits.effort", "lower the velocity limit"),
    ("effort = 24.0", "effort = 40.0", "axis.limits.effort", "carries at most 32"),
    ("effort = 24.0", "", "axis.limits.effort", "is missing"),
    ("overspeed = 320.0", "overspeed = 200.0", "axis.limits", "is not above velocity"),
    ("position_minimum = -2500.0", "position_minimum = 2600.0", "axis.limits", "is not below position_maximum"),
    ("missed_ticks = 2 ", "missed_ticks = 5.5 ", "axis.limits.missed_ticks", "whole number"),
    ("missed_ticks = 2 ", "missed_ticks = -1 ", "axis.limits.missed_ticks", "at least 0"),
    ("cruise_velocity = 100.0", "cruise_velocity = 300.0", "axis", "is above limits.velocity"),
    ('unit = "mm"', "unit = 5", "axis.unit", "a text"),
    ('unit = "mm"', 'unit = "deg"', "axis.unit", "Set axis.unit to 'mm'"),
    ('unit = "mm"', 'unit = ""', "axis.unit", "not empty"),
    ("tick_ms = 10.0", "tick_ms = 0.0", "service.tick_ms", "at least 1"),
    ("tick_ms = 10.0", "tick_ms = 10.0\ntick_ms = 20.0", "service.tick_ms", "each key and table must appear once"),
    ("[axis.plant]", "[axis.plannt]", "axis.plannt", "unknown key"),
    ("[axis.limits]", "[axis.limits", "", "not TOML"),
    ('interface = "virtual"', 'interface = "virtuall"', "bus.interface", "virtual"),
    ('interface = "virtual"', "interface = 3", "bus.interface", "a text"),
    (
        LAW_OF_THE_DEMO + "performance_index_ratio = 5.0e-5",
        '[axis.law]\ntype = "paper"\nperformance_index_ratio = 10.0',
        "axis.law.performance_index_ratio",
        "unstable",
    ),
    (
        "performance_index_ratio = 5.0e-5",
        "performance_index_ratio = -1",
        "axis.law.performance_index_ratio",
        "at least",
    ),
    ("[simulation]", '[protocol]\ndbc = "missing.dbc"\n\n[simulation]', "protocol.dbc", "missing.dbc"),
    (
        "[simulation]",
        '[protocol.feedback]\nposition = "Positoin"\n\n[simulation]',
        "protocol.feedback.position",
        "Position",
    ),
    (
        "[simulation]",
        '[protocol.command]\nmessage = "Command"\n\n[simulation]',
        "protocol.command.message",
        "DriveCommand",
    ),
    ("frame_loss = 0.0", "frame_loss = 1.5", "simulation.frame_loss", "at most 1"),
    ("seed = 1", "seed = one", "", "not TOML"),
]


@pytest.fixture(autouse=True)
def no_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    def touched(*_: object, **__: object) -> None:
        raise AssertionError("the bus was touched")

    monkeypatch.setattr(can, "Bus", touched)


@pytest.mark.parametrize(("good", "bad", "key", "said"), BROKEN)
def test_a_broken_file_is_refused_with_line_and_key(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, good: str, bad: str, key: str, said: str
) -> None:
    assert good in DEMO
    text = DEMO.replace(good, bad, 1)
    path = tmp_path / "axis.toml"
    path.write_text(text, encoding="utf-8")
    assert main(["check", str(path)]) == 2
    errors = capsys.readouterr().err
    assert "Traceback" not in errors
    assert said in errors
    place = re.search(rf"{re.escape(str(path))}:(\d+): {re.escape(key)}", errors)
    assert place, errors
    line = text.split("\n")[int(place[1]) - 1]
    if bad and key:
        assert key.rpartition(".")[2] in line or line.strip("[]") == key, line


def test_problems_come_as_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "axis.toml"
    path.write_text(DEMO.replace("gain = 180.0 ", "gian = 180.0 ", 1), encoding="utf-8")
    assert main(["check", str(path), "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert {problem["key"] for problem in error["problems"]} == {"axis.plant.gian", "axis.plant.gain"}
    assert all(problem["line"] for problem in error["problems"])


@pytest.mark.parametrize("name", ["demo", "two_processes", "socketcan", "example1", "example2"])
def test_the_shipped_files_are_valid(capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert main(["check", f"{name}.toml"]) == 0
    assert "valid" in capsys.readouterr().out


def test_an_override_at_fault_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--set", "simulation.gian=3"]) == 2
    assert "--set simulation.gian=3" in capsys.readouterr().err


def test_every_key_is_explained(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--explain", "--json"]) == 0
    rows = {row["key"]: row for row in json.loads(capsys.readouterr().out)["keys"]}
    assert rows["axis.limits.velocity"]["unit"] == "axis unit/s"
    for row in rows.values():
        assert row["description"], row["key"]


def test_the_design_of_both_examples(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["design", "--json", "--uncertainty", "0", "--set", "axis.law.type=paper"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert (
        f"{first['gains']['f11']:.2e} {first['gains']['f12']:.2e} {first['gains']['f22']:.1e}"
        == "3.78e-01 2.32e-02 6.9e-03"
    )
    assert first["changeover_distance"] == pytest.approx(54.53, abs=0.005)
    assert main(["design", "--json", "--config", "example2.toml", "--uncertainty", "0"]) == 0
    second = json.loads(capsys.readouterr().out)
    assert second["changeover_distance"] == pytest.approx(21.56, abs=0.005)
    assert set(second["stages"]) == {"speed", "position", "brake"}


def test_the_design_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["design", "--velocity", "200", "--uncertainty", "0", "--set", "axis.law.type=paper"]) == 0
    out = capsys.readouterr().out
    assert "f11 0.3775" in out
    assert "109.1 mm before the set-point at 200 mm/s" in out


@pytest.mark.parametrize("velocity", ["0", "-5", "nan", "inf", "251"])
def test_a_design_for_an_impossible_velocity_is_refused(capsys: pytest.CaptureFixture[str], velocity: str) -> None:
    assert main(["design", "--velocity", velocity, "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "velocity_limit"


def test_two_configurations_at_once_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "demo.toml", "--config", "example1.toml"]) == 2
    assert "name one configuration" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["run", "drive"])
def test_processes_that_could_never_meet_are_refused(capsys: pytest.CaptureFixture[str], verb: str) -> None:
    assert main([verb, "--config", "demo.toml"]) == 2
    assert 'bus.interface = "virtual": the virtual bus exists inside one process only' in capsys.readouterr().err


def test_an_effort_in_another_unit_than_the_drives_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    dbc = (SHIPPED / "servo_drive.dbc").read_text(encoding="utf-8")
    (tmp_path / "drive.dbc").write_text(dbc.replace('[-32|32] "1"', '[-32|32] "Nm"'), encoding="utf-8")
    path = tmp_path / "axis.toml"
    path.write_text(DEMO.replace("[simulation]", '[protocol]\ndbc = "drive.dbc"\n\n[simulation]'), encoding="utf-8")
    assert main(["check", str(path)]) == 2
    assert "axis.effort_unit = \"V\": the drive's command signal is in 'Nm'" in capsys.readouterr().err


def test_check_counts_the_longer_time_of_a_smooth_reference(capsys: pytest.CaptureFixture[str]) -> None:
    """With 2500 mm/s³ a speed of 100 mm/s takes 0.4 s: 0.35 s more to rise, 0.32 s to brake, half of each counts.

    The band of 0.4 mm is entered ``(6 d/j)^(1/3)`` = 0.10 s before the end, in place of ``(2 d/A)^(1/2)`` = 0.02 s.
    """
    found = []
    for keys in ((), ("--set", "axis.law.jerk=2500")):
        assert main(["check", "--set", "axis.law.type=adaptive", *keys, "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    plain, smooth = (one["response"][0]["nominal"]["settling_time_s"] for one in found)
    assert smooth - plain == pytest.approx(0.335 - 0.08, abs=0.03)
    assert found[1]["changeover_distance"] - found[0]["changeover_distance"] > 10.0


def test_check_refuses_a_jerk_that_the_law_cannot_keep(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--set", "axis.law.type=paper", "--set", "axis.law.jerk=2500"]) != 0
    captured = capsys.readouterr()
    text = captured.out + captured.err
    assert "axis.law.jerk" in text
    assert 'choose axis.law.type = "adaptive"' in text


@pytest.mark.parametrize("gain", [150, 180, 195, 216])
def test_check_takes_the_adaptive_law_on_plants_around_the_demos(gain: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Its cruise begins at speed, which the law once took for a move from rest."""
    assert main(["check", "--set", "axis.law.type=adaptive", "--set", f"axis.plant.gain={gain}", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["valid"]


@pytest.mark.parametrize(("shutdown_timeout_ms", "asked_s"), [(800, 13.3), (60_000, 72.5)])
def test_check_says_how_long_a_service_manager_has_to_wait(
    capsys: pytest.CaptureFixture[str], shutdown_timeout_ms: int, asked_s: float
) -> None:
    arguments = ["check", "--set", f"service.shutdown_timeout_ms={shutdown_timeout_ms}"]
    assert main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["longest_end_s"] == asked_s
    assert main(arguments) == 0
    assert (f"may take {asked_s:.3g} s to end" in capsys.readouterr().out) is (asked_s > 15.0)


@pytest.mark.long
@pytest.mark.parametrize(("name", "begins"), [("loops.png", b"\x89PNG\r\n"), ("loops.svg", b"<?xml")])
def test_the_loops_are_drawn_by_the_files_ending(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, name: str, begins: bytes
) -> None:
    paper = ["--set", "axis.law.type=paper"]
    arguments = ["design", *paper, "--uncertainty", "5", "--distance", "20", "--plot", str(tmp_path / name), "--json"]
    assert main(arguments) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["stages"]["position"]["gain_margin"] == pytest.approx(11.92, abs=0.01)
    assert f"plot written to {tmp_path / name}" in captured.err
    assert (tmp_path / name).read_bytes().startswith(begins)


def test_a_plot_of_an_unknown_kind_or_in_no_folder_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["design", "--plot", str(tmp_path / "loops.pdf")]) == 2
    assert "must end in .png or .svg" in capsys.readouterr().err
    assert main(["design", "--uncertainty", "0", "--plot", str(tmp_path / "none" / "loops.png")]) == 3
    assert "the plot cannot be written" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "settled_s", "overshoot"), [("paper", 5.64, (3.0, 4.0)), ("adaptive", 4.05, (0.0, 0.05))]
)
def test_the_expected_response_is_shown_and_told(
    capsys: pytest.CaptureFixture[str], law: str, settled_s: float, overshoot: tuple[float, float]
) -> None:
    chosen = ["--set", f"axis.law.type={law}"]
    assert main(["design", *chosen, "--uncertainty", "20", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["uncertainty"] == 20.0
    assert (told["distance"], told["velocity"]) == (400.0, 100.0)
    assert told["bound_s"] == pytest.approx(4.026, abs=0.001)
    assert told["response"]["nominal"]["settling_time_s"] == pytest.approx(settled_s)
    assert told["response"]["worst"]["overshoot"] > told["response"]["nominal"]["overshoot"]
    assert overshoot[0] < told["response"]["nominal"]["overshoot"] < overshoot[1]
    assert [(one["distance"], one["velocity"]) for one in told["corners"]] == [
        (2.5, 100.0), (400.0, 100.0), (2.5, 250.0), (1000.0, 250.0),
    ]  # fmt: skip
    assert main(["design", *chosen, "--distance", "40", "--velocity", "20", "--uncertainty", "0"]) == 0
    out = capsys.readouterr().out
    assert "move       40 mm at 20 mm/s, to 0.05 mm" in out
    assert "% off" not in out


@pytest.mark.long
def test_the_margins_are_those_of_the_position_stage(capsys: pytest.CaptureFixture[str]) -> None:
    """Independent figures of both laws on this axis: Ms 1.25 and 1.99, 21 and 2.04 ticks, 2.05 and 0.148 mm a volt."""
    for law, expected in (("paper", (1.25, 21.0, 2.05)), ("adaptive", (1.99, 2.04, 0.148))):
        assert main(["design", "--json", "--set", f"axis.law.type={law}", "--uncertainty", "0"]) == 0
        margins = json.loads(capsys.readouterr().out)["margins"]
        found = margins["peak_sensitivity"], margins["delay_margin_ticks"], margins["load_step_peak"]
        assert found == pytest.approx(expected, rel=0.005)
        assert margins["gain_margin"] > 1.0


@pytest.mark.parametrize(
    ("option", "code"),
    [
        (["--uncertainty", "100"], "usage"),
        (["--uncertainty", "-1"], "usage"),
        (["--uncertainty", "nan"], "usage"),
        (["--distance", "0.01"], "position_limit"),
        (["--distance", "5001"], "position_limit"),
        (["--distance", "nan"], "position_limit"),
    ],
)
def test_an_impossible_move_or_uncertainty_is_refused(
    capsys: pytest.CaptureFixture[str], option: list[str], code: str
) -> None:
    assert main(["design", "--json", *option]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == code


@pytest.mark.long
def test_check_tells_what_the_configured_and_the_fastest_move_come_to(capsys: pytest.CaptureFixture[str]) -> None:
    paper = ["--set", "axis.law.type=paper"]
    assert main(["check", *paper, "--json", "--uncertainty", "20"]) == 0
    usual, fastest = json.loads(capsys.readouterr().out)["response"]
    assert (usual["velocity"], fastest["velocity"]) == (100.0, 250.0)
    assert usual["nominal"]["trip"] is None
    assert fastest["worst"]["trip"] is not None
    assert main(["check", *paper, "--uncertainty", "20"]) == 0
    out = capsys.readouterr().out
    assert "as the model:   settled after 5.64 s" in out
    assert "up to 20 % off: trips (" in out


def test_a_limit_that_the_configured_move_breaks_is_a_problem_with_the_value_that_would_do(
    capsys: pytest.CaptureFixture[str],
) -> None:
    limits = ("axis.law.type=paper", "axis.limits.velocity=100.5", "axis.limits.overspeed=101")
    tight = [word for limit in limits for word in ("--set", limit)]
    assert main(["check", "--json", *tight]) == 2
    (problem,) = json.loads(capsys.readouterr().out)["error"]["problems"]
    assert problem["key"] == "axis.limits.overspeed"
    assert "trips (overspeed) even if the plant is as axis.plant says: 106.1 would do" in problem["message"]


def test_a_limit_that_the_fastest_move_breaks_is_a_note(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--json", "--set", "axis.law.type=paper", "--set", "axis.limits.overspeed=251"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert [note for note in notes if "axis.limits.overspeed is 251, 263.6 would do" in note]
