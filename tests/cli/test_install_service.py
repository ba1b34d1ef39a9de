"""The units, and how they are placed and removed."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from twostage_servo.axis.settings import AxisSettings
from twostage_servo.cli.install_service import service_files
from twostage_servo.cli.main import main
from twostage_servo.service.settings import ServiceSettings, longest_end_s

PROGRAM = Path("/opt/twostage-servo/bin/twostage-servo")
FILES = service_files(PROGRAM, 250_000)
UNITS = [path for path in FILES if path.endswith(".service")]


def install(root: Path, *arguments: str, code: int = 0) -> None:
    assert main(["install-service", "--program", str(PROGRAM), "--root", str(root), "--json", *arguments]) == code


def tree(root: Path) -> dict[str, str]:
    return {str(path.relative_to(root)): path.read_text() for path in root.rglob("*") if path.is_file()}


def outcomes(capsys: pytest.CaptureFixture[str]) -> set[str]:
    return {one["outcome"] for one in json.loads(capsys.readouterr().out)["files"]}


def test_it_is_placed_once_and_removed_without_a_trace(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seen = []
    for arguments in ((), (), ("--bit-rate", "250000"), ("--uninstall",), ("--uninstall",)):
        install(tmp_path, *arguments)
        seen.append(outcomes(capsys))
        if arguments == ("--bit-rate", "250000"):
            assert tree(tmp_path) == FILES
    assert seen == [{"written"}, {"unchanged"}, {"written", "unchanged"}, {"removed"}, {"absent"}]
    assert tree(tmp_path) == {}


def test_a_file_of_somebody_else_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    theirs = tmp_path / UNITS[0]
    theirs.parent.mkdir(parents=True)
    theirs.write_text("[Unit]\n")
    for arguments in ((), ("--uninstall",)):
        install(tmp_path, *arguments, code=3)
        assert str(theirs) in json.loads(capsys.readouterr().out)["error"]["message"]
    assert tree(tmp_path) == {UNITS[0]: "[Unit]\n"}


def test_a_package_has_the_same_files_where_the_administrators_outrank_them(tmp_path: Path) -> None:
    install(tmp_path, "--bit-rate", "250000", "--vendor")
    assert tree(tmp_path) == {path.replace("etc/", "usr/lib/", 1): text for path, text in FILES.items()}
    assert {Path(path).parts[:2] for path in tree(tmp_path)} == {("usr", "lib")}


def test_printing_places_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    install(tmp_path, "--print", "--bit-rate", "250000")
    assert json.loads(capsys.readouterr().out)["files"] == {f"/{path}": text for path, text in FILES.items()}
    assert tree(tmp_path) == {}


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--program", "/home/me/bin/twostage-servo"], "are hidden from it"),
        (["--program", "/opt/my servo/twostage-servo"], "cannot be used in a unit"),
        (["--program", "/opt/100%/twostage-servo"], "cannot be used in a unit"),
        (["--program", str(PROGRAM), "--bit-rate", "0"], "1 to 1000000 bit/s"),
    ],
)
def test_what_cannot_work_is_refused(
    arguments: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["install-service", "--root", str(tmp_path), "--json", *arguments]) == 2
    assert text in json.loads(capsys.readouterr().out)["error"]["message"]
    assert tree(tmp_path) == {}


def test_nothing_is_left_to_fill_in() -> None:
    assert not [path for path, text in FILES.items() if "@PROGRAM@" in text or "@BIT_RATE@" in text]
    assert "BitRate=250000" in FILES["etc/systemd/network/80-twostage-servo-can.network"]
    plain = FILES["etc/systemd/system/twostage-servo.service"]
    assert "%i" not in plain
    assert "NAME" not in plain
    assert f"ExecStart={PROGRAM} run --config /etc/twostage-servo/servo.toml\n" in plain
    assert "RuntimeDirectory=twostage-servo\n" in plain  # where the operators' commands look by themselves


@pytest.mark.parametrize("unit", UNITS, ids=lambda path: Path(path).name)
def test_the_manager_waits_for_the_default_braking_and_for_what_the_service_asks(unit: str) -> None:
    told = dict(line.split("=", 1) for line in FILES[unit].splitlines() if "=" in line and not line.startswith("#"))
    assert float(told["TimeoutStopSec"]) >= longest_end_s(
        ServiceSettings(), [AxisSettings.model_fields["arming_timeout_ms"].default]
    )
    assert (told["Type"], told["NotifyAccess"]) == ("notify", "main")  # so that it takes EXTEND_TIMEOUT_USEC


@pytest.mark.parametrize("unit", UNITS, ids=lambda path: Path(path).name)
def test_no_signal_is_taken_for_a_clean_end(unit: str) -> None:
    """Which SIGHUP and SIGPIPE would be by default, and nothing would start the service again."""
    assert "RestartForceExitStatus=SIGHUP SIGPIPE\n" in FILES[unit]
    assert "SuccessExitStatus" not in FILES[unit]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
@pytest.mark.parametrize("unit", UNITS, ids=lambda path: Path(path).name)
def test_the_units_expose_at_most_a_tenth(unit: str, tmp_path: Path) -> None:
    path = tmp_path / Path(unit).name.replace("@", "@x")
    path.write_text(service_files(Path("/bin/true"), 500_000)[unit])
    command = ["systemd-analyze", "security", "--offline=true", "--threshold=10", "--no-pager", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own words
    assert done.returncode == 0, done.stdout[-300:]
    assert "Overall exposure level" in done.stdout
