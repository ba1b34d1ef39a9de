"""Without an extra the verbs that need it say so, and how to install it; all others do without."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from twostage_servo.cli.extras import MODULES
from twostage_servo.cli.main import main

PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"
EXTRAS = tomllib.loads(PYPROJECT.read_text("utf-8"))["project"]["optional-dependencies"]


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch) -> None:
    for modules in MODULES.values():
        for module in modules:
            monkeypatch.setitem(sys.modules, module, None)


@pytest.fixture
def multicast(tmp_path: Path) -> Path:
    path = tmp_path / "multicast.toml"
    shipped = (PYPROJECT.parent / "config" / "demo.toml").read_text("utf-8")
    path.write_text(
        shipped.replace('interface = "virtual"', 'interface = "udp_multicast"').replace(
            'channel = "demo"', 'channel = "239.74.163.2"'
        ),
        "utf-8",
    )
    assert "udp_multicast" in path.read_text("utf-8")
    return path


@pytest.mark.usefixtures("without")
def test_the_report_of_the_paper_names_what_it_lacks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "--out", str(tmp_path / "report"), "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == "not_installed"
    assert "latex2mathml" in error["message"]
    assert "pip install 'twostage-servo[paper]'" in error["message"]
    assert not (tmp_path / "report").exists()


@pytest.mark.usefixtures("without")
@pytest.mark.parametrize("verb", ["run", "drive"])
def test_a_multicast_bus_names_what_it_lacks(verb: str, multicast: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb, "--config", str(multicast)]) == 2
    shown = capsys.readouterr().err
    assert "msgpack" in shown
    assert "pip install 'twostage-servo[multicast]'" in shown


@pytest.mark.usefixtures("without")
@pytest.mark.parametrize(
    "arguments", [["check"], ["design"], ["demo", "--fast", "--json"]], ids=lambda one: str(one[0])
)
def test_nothing_else_needs_an_extra(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 0
    assert "pip install" not in "".join(capsys.readouterr())


@pytest.mark.usefixtures("without")
def test_a_configuration_with_a_multicast_bus_can_be_checked_without(multicast: Path) -> None:
    assert main(["check", str(multicast)]) == 0


def test_the_extras_are_those_of_the_package_and_the_tests_and_developers_have_them() -> None:
    for extra, modules in MODULES.items():
        assert [requirement.partition(">")[0] for requirement in EXTRAS[extra]] == list(modules)
        assert any(requirement.startswith("twostage-servo[") and extra in requirement for requirement in EXTRAS["test"])
    assert any("test" in requirement for requirement in EXTRAS["dev"])


def test_no_verb_loads_an_extra_by_importing_the_command_line() -> None:
    listed = sorted(module for modules in MODULES.values() for module in modules)
    script = f"import sys, twostage_servo.cli.main; print(*(set(sys.modules) & set({listed!r})))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)  # noqa: S603 - our own text
    assert done.stdout == "\n"
