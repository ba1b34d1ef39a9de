"""A law that another package brings by an entry point: its keys, its design, and an axis that it drives."""

import json
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from pydantic import Field

from tests.axis.rig import DEMO, PERIOD_S, TRAITS, AxisRig
from tests.laws_of_others import cascade, forget_laws, install
from twostage_servo.app.assembly import design
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.cli.main import main
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.loader import load
from twostage_servo.control.laws import registry
from twostage_servo.control.laws.adaptive.adaptive_type import ADAPTIVE
from twostage_servo.control.laws.paper_design import design_paper
from twostage_servo.control.laws.paper_type import PAPER
from twostage_servo.control.laws.registry import LawType
from twostage_servo.control.laws.tracking import TrackingDesign
from twostage_servo.drives.dbc.drive_type import DBC
from twostage_servo.drives.registry import DriveType
from twostage_servo.settings.base import Settings

__all__ = ["cascade"]

ROOT = Path(__file__).parents[2]
SHIPPED = [path for path in sorted((ROOT / "config").glob("*.toml")) if path.name != "two_axes.toml"]
OTHER = "axis.law.type=cascade"


def run(capsys: pytest.CaptureFixture[str], verb: str, *arguments: str) -> tuple[int, str, str]:
    code = main([verb, *arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def refused(*overrides: str, file: Path | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        load(file, overrides)
    return "\n".join(str(problem) for problem in caught.value.problems)


@pytest.mark.usefixtures("cascade")
def test_it_drives_an_axis_through_the_command_line_unchanged(capsys: pytest.CaptureFixture[str]) -> None:
    paper, quick, slow = (
        json.loads(run(capsys, "demo", "--fast", "--json", *overrides)[1])
        for overrides in ((), ("--set", OTHER), ("--set", OTHER, "--set", "axis.law.cascade.bandwidth=3"))
    )
    assert paper["trip"] is quick["trip"] is slow["trip"] is None
    assert len({one["trace_sha256"] for one in (paper, quick, slow)}) == 3
    assert abs(quick["final_error"]) < 0.01


@pytest.mark.usefixtures("cascade")
def test_check_and_design_show_what_the_law_says(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "design", "--set", OTHER)
    assert code == 0
    assert "gains      kp 0.2, kv -0.01111   (bandwidth 6/s)" in out
    assert "change-over 16.67 mm before" in run(capsys, "check", "--set", OTHER)[1]
    told = json.loads(run(capsys, "design", "--json", "--set", OTHER)[1])
    assert told["gains"] == {"kp": pytest.approx(0.2), "kv": pytest.approx(-2.0 / 180.0)}
    assert told["stages"] == {}
    assert "axis.law.cascade.bandwidth" in run(capsys, "check", "--explain")[1]


@pytest.mark.usefixtures("cascade")
@pytest.mark.parametrize("file", SHIPPED, ids=lambda path: path.stem)
def test_changing_the_type_alone_always_validates(file: Path) -> None:
    loaded = load(file, [OTHER])
    design = design_axis(loaded.config.axis, 1e-3 * loaded.config.service.tick_ms)
    assert isinstance(design.law, TrackingDesign)


@pytest.mark.usefixtures("cascade")
def test_the_tables_of_both_laws_may_stand_side_by_side(tmp_path: Path) -> None:
    text = (ROOT / "config" / "demo.toml").read_text(encoding="utf-8")
    text = text.replace(
        "performance_index_ratio = 5.0e-5", "cascade.bandwidth = 4.0\npaper.performance_index_ratio = 1e-4"
    )
    file = tmp_path / "both.toml"
    file.write_text(text, encoding="utf-8")
    axis = load(file).config.axis
    assert axis.law.paper.performance_index_ratio == 1e-4
    assert axis.law.type == "adaptive"
    keys: Any = load(file, [OTHER]).config.axis.law.keys
    assert keys.bandwidth == 4.0


@pytest.mark.usefixtures("cascade")
def test_wrong_keys_of_it_are_told_with_what_would_be_right() -> None:
    assert "did you mean axis.law.cascade.bandwidth?" in refused("axis.law.cascade.bandwith=1")
    assert "greater than 0, at most 1000 (Both closed-loop poles)" in refused("axis.law.cascade.bandwidth=-1")
    assert "no law is called 'cascad'; there are: adaptive, cascade, paper" in refused("axis.law.type=cascad")
    assert "did you mean axis.law.paper?" in refused("axis.law.papr.x=1")


def test_the_ratio_in_both_places_is_an_error_that_names_both(tmp_path: Path) -> None:
    text = (ROOT / "config" / "demo.toml").read_text(encoding="utf-8")
    file = tmp_path / "both.toml"
    file.write_text(text + "\n[axis.law.paper]\nperformance_index_ratio = 1e-4\n", encoding="utf-8")
    told = refused(file=file)
    for number in (text.splitlines().index("performance_index_ratio = 5.0e-5") + 1, len(text.splitlines()) + 3):
        assert f"both.toml:{number}: axis.law." in told
    assert told.count("is set in axis.law and in axis.law.paper: remove one of the two") == 2


def test_the_older_place_of_the_ratio_means_the_same() -> None:
    old = load(None, ["axis.law.type=paper", "axis.law.performance_index_ratio=1e-4"]).config.axis
    assert old.law.paper.performance_index_ratio == 1e-4
    assert design_axis(old, 0.01).law.origin() == "Q/R 0.0001"


@pytest.mark.parametrize(
    ("entry", "why"),
    [
        ("broken = cascade_law:NOTHING", "cannot be loaded from cascade_law:NOTHING: module"),
        ("broken = no_such_module:LAW", "cannot be loaded from no_such_module:LAW: No module named"),
        ("broken = cascade_law:design", "is a function, not a LawType"),
    ],
)
def test_a_package_that_is_broken_is_told(
    entry: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, entry)
    monkeypatch.syspath_prepend(tmp_path)
    forget_laws()
    told = refused("axis.law.type=broken")
    assert f"the law 'broken' {why}" in told
    forget_laws()


class WithList(Settings):
    bandwidths: list[float] = Field([6.0], description="Poles")


def test_a_key_of_a_law_may_be_a_list(monkeypatch: pytest.MonkeyPatch) -> None:
    law = LawType(WithList, lambda settings, task: design_paper(1e-5 * settings.bandwidths[0], task))
    monkeypatch.setitem(registry.LAWS._loaded, "listed", law)
    loaded = load(None, ["axis.law.type=listed", "axis.law.listed.bandwidths=[3.0]"])
    assert design(loaded).law.origin() == "Q/R 3e-05"


def test_settings_that_another_process_could_not_import_are_told_before_a_reload_needs_them() -> None:
    class Local(Settings):
        pass

    with pytest.raises(TypeError, match=r"Local of tests\..* cannot be imported .*: define it at the top level"):
        LawType(Local, ADAPTIVE.design)
    with pytest.raises(TypeError, match="cannot be imported by its name"):
        DriveType[Any, Any](Local, DBC.build, DBC.side)


@pytest.mark.parametrize(("name", "law"), [("paper", PAPER), ("adaptive", ADAPTIVE)])
def test_a_built_in_law_is_declared_as_any_other(name: str, law: LawType) -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    (point,) = metadata.entry_points(group=registry.GROUP, name=name)
    assert point.value == declared[registry.GROUP][name]
    assert point.load() is registry.LAWS.get(name) is law


@pytest.mark.long
@pytest.mark.usefixtures("cascade")
def test_the_fault_campaign_holds_it_to_the_bounds_of_the_papers_law(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "faults", "--simulated", "--fault", "1", "--phase", "idle", "--json", "--set", OTHER)
    (cell,) = json.loads(out)["cells"]
    assert (code, cell["met"]) == (0, True)


@pytest.mark.usefixtures("cascade")
def test_a_speed_override_slows_it_down_holds_it_and_lets_it_go_on() -> None:
    settings = AxisSettings.model_validate(DEMO | {"law": {"type": "cascade"}})
    rig = AxisRig(Axis(design_axis(settings, PERIOD_S), TRAITS)).armed()
    move = rig.axis.move_to(300.0, 100.0)
    for percent, velocity in ((100.0, 100.0), (30.0, 30.0), (0.0, 0.0), (150.0, 150.0), (0.0, 0.0)):
        rig.axis.set_override(percent)
        rig.seconds(0.8)
        assert rig.velocity == pytest.approx(velocity, rel=0.02, abs=0.5)
    for ticks in range(20):  # also while it brakes
        rig.axis.set_override(100.0 if ticks % 2 else 0.0)
        rig.seconds(0.05)
    rig.seconds(5.0)
    assert (move.outcome, rig.axis.trip) == ("reached", None)
    assert rig.position == pytest.approx(300.0, abs=0.06)
