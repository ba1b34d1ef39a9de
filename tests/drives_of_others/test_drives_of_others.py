"""A type of drives that another package brings by an entry point: keys, frames, start-up, simulation."""

import json
import sys
import tomllib
from pathlib import Path

import pytest
import structlog

from tests.drives_of_others import EXAMPLE, install, node
from tests.service.rig import World, simulate
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.cli.main import main
from twostage_servo.config.errors import ConfigError, Problem
from twostage_servo.config.loader import load
from twostage_servo.drives import registry

__all__ = ["node"]

NODE = ("protocol.type=node", "protocol.node=5")
DEMO = (Path(__file__).parents[2] / "config" / "demo.toml").read_text(encoding="utf-8")


def with_protocol(folder: Path, *lines: str) -> Path:
    file = folder / "axis.toml"
    file.write_text("\n".join((DEMO, "[protocol]", *lines)), encoding="utf-8")
    return file


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return with_protocol(tmp_path, 'type = "node"', "node = 5")


def run(capsys: pytest.CaptureFixture[str], verb: str, *arguments: str) -> tuple[int, str, str]:
    code = main([verb, *arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def refused(file: Path, *overrides: str) -> Problem:
    with pytest.raises(ConfigError) as caught:
        load(file, overrides)
    (problem,) = caught.value.problems
    return problem


@pytest.mark.usefixtures("node")
def test_check_takes_its_table_and_shows_its_identifiers(capsys: pytest.CaptureFixture[str], file: Path) -> None:
    code, out, _ = run(capsys, "check", "--config", str(file), "--json")
    assert code == 0
    told = json.loads(out)
    assert told["dead_host"] == "by a time-out of 100 ms, which cannot be switched off"
    assert told["frames"] == {"command": 0x205, "feedback": 0x185, "effort_quantum": 0.001, "position_quantum": 0.001}


@pytest.mark.usefixtures("node")
def test_it_moves_an_axis_through_the_command_line_unchanged(capsys: pytest.CaptureFixture[str], file: Path) -> None:
    code, out, err = run(capsys, "demo", "--fast", "--json", "--config", str(file))
    assert code == 0, err
    result = json.loads(out)
    assert result["trip"] is None
    assert abs(result["final_error"]) < 0.01


@pytest.mark.usefixtures("node")
def test_a_drive_that_does_not_start_is_not_used_and_says_what_to_look_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has an answer of its own to each frame, and reports: but never the one that its start-up waits for."""
    load(None, NODE)  # which imports it
    monkeypatch.setattr(sys.modules["node_drive"].NodeDrive, "is_running", lambda *_: False)

    async def script(world: World) -> None:
        await world.seconds(1.0)
        assert world.axis_loop.bus.link.counters.received > 90
        with pytest.raises(Refused) as refused:
            world.axis.arm()
        assert refused.value.code is RefusalCode.NO_FEEDBACK

    with structlog.testing.capture_logs() as lines:
        simulate(script, *NODE)
    told = [line for line in lines if line["event"] == "the drive does not start up"]
    failure = "node 5 does not start: look at protocol.node and the drive's supply"
    assert told == [{"event": "the drive does not start up", "axis": "x", "error": failure, "log_level": "error"}]


@pytest.mark.usefixtures("node")
def test_a_drive_that_was_lost_with_its_bus_is_started_again() -> None:
    async def script(world: World) -> None:
        await world.armed()
        started = [data for _, _, number, data in world.trace if number == 0]
        world.wire.node("service").take_down()
        await world.seconds(0.1)
        world.wire.node("service").bring_up()
        await world.until(lambda: world.axis_loop.bus.error is None)
        await world.seconds(0.1)
        assert [data for _, _, number, data in world.trace if number == 0] == 2 * started == 2 * [bytes((1, 5))]

    simulate(script, *NODE)


@pytest.mark.usefixtures("node")
def test_what_is_wrong_with_its_table_is_told_by_its_own_keys(tmp_path: Path) -> None:
    problem = refused(with_protocol(tmp_path, 'type = "node"', "node = 200"))
    assert (problem.key, problem.value, problem.line) == ("protocol.node", "200", len(DEMO.split("\n")) + 3)
    assert "at least 1, at most 127 (Number of the drive's node)" in problem.message
    problem = refused(with_protocol(tmp_path, 'type = "node"', "node = 2", 'dbc = "mine.dbc"'))
    assert (problem.key, problem.message) == ("protocol.dbc", "unknown key; keys of [protocol]: type, node")
    problem = refused(with_protocol(tmp_path, 'type = "node"'))
    assert (problem.key, problem.message[:10]) == ("protocol.node", "is missing")


@pytest.mark.usefixtures("node")
def test_a_type_that_is_not_installed_is_told_with_those_that_are(tmp_path: Path) -> None:
    file = with_protocol(tmp_path, 'type = "nod"', "node = 5")
    problem = refused(file)
    assert (problem.file, problem.key, problem.value) == (str(file), "protocol.type", '"nod"')
    assert file.read_text(encoding="utf-8").split("\n")[(problem.line or 0) - 1] == 'type = "nod"'
    assert "no type of drives is called 'nod'; there are: dbc, node." in problem.message
    assert refused(file, "protocol.type=node2").file == "--set protocol.type=node2"
    assert refused(file, "protocol.type=3").key == "protocol.type"


def test_a_table_without_a_type_is_that_of_a_dbc(tmp_path: Path) -> None:
    explicit = load(with_protocol(tmp_path, 'type = "dbc"', 'checksum = "crc8_j1850"')).config.protocol
    assert load(with_protocol(tmp_path, "identifier_offset = 0")).config.protocol == explicit
    assert load(None).config.protocol == explicit


@pytest.mark.parametrize(
    ("entry_point", "text"),
    [
        ("node = node_drive:GONE", "cannot be loaded from node_drive:GONE"),
        ("node = no_such_module:DRIVE", "cannot be loaded from no_such_module:DRIVE: No module"),
        ("node = node_drive:NodeDrive", ", not a DriveType: correct its package"),
    ],
)
def test_a_package_that_is_broken_is_told_as_a_wrong_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, entry_point: str, text: str
) -> None:
    install(tmp_path, entry_point)
    monkeypatch.syspath_prepend(tmp_path)
    registry.DRIVES.forget()
    problem = refused(with_protocol(tmp_path, 'type = "node"', "node = 5"))
    assert problem.key == "protocol.type"
    assert text in problem.message


@pytest.mark.usefixtures("node")
def test_design_and_doctor_need_to_know_nothing_of_it(capsys: pytest.CaptureFixture[str], file: Path) -> None:
    code, out, err = run(capsys, "design", "--config", str(file))
    assert code == 0, err
    assert "change" in out
    code, out, _ = run(capsys, "doctor", "--json", "--config", str(file))
    checks = {check["name"] for check in json.loads(out)["checks"]}
    assert "bus load" in checks  # which comes of the drive's frames


@pytest.mark.usefixtures("node")
@pytest.mark.parametrize("of_several", [False, True])
def test_the_fault_campaign_refuses_what_no_dbc_describes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, *, of_several: bool
) -> None:
    file = named = with_protocol(tmp_path, 'type = "node"', "node = 5")
    if of_several:  # also where only the second axis has such a drive, before anything has run
        (tmp_path / "other.toml").write_text(DEMO.replace('name = "x"', 'name = "y"'), encoding="utf-8")
        named = tmp_path / "machine.toml"
        named.write_text('[machine]\naxes = ["other.toml", "axis.toml"]\n', encoding="utf-8")
    code, out, err = run(capsys, "faults", "--config", str(named), "--simulated", "--fault", "1")
    assert (code, out) == (2, "")
    line = file.read_text(encoding="utf-8").split("\n").index('type = "node"') + 1
    knows = 'the fault campaign knows the frames of drives of type "dbc" alone'
    assert f'{file}:{line}: protocol.type = "node": {knows}' in err
    assert "run it on a copy of this file without [protocol]" in err


def test_the_example_declares_the_entry_point_that_these_tests_install() -> None:
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["entry-points"] == {registry.GROUP: {"node": "node_drive:DRIVE"}}
