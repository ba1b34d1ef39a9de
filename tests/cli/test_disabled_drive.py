"""What the operator's commands say, and end with, when a drive does not report that it is disabled."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.rig import World, simulate
from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import ReleaseRequest, Request, WatchRequest
from twostage_servo.api.status import Status
from twostage_servo.app.serve import Served
from twostage_servo.axis.state import State
from twostage_servo.cli.main import main
from twostage_servo.client import blocking

Snapshots = dict[str, JsonObject]


@pytest.fixture(scope="module")
def snapshots() -> Snapshots:
    """What a service tells of an axis that is disarmed, and of a drive that does not obey."""
    told: Snapshots = {}

    def tell(name: str, world: World) -> None:
        told[name] = json.loads(json.dumps(world.loop.snapshot()))

    async def script(world: World) -> None:
        await world.armed()
        world.axis.disarm()
        tell("disabling", world)
        await world.seconds(0.1)
        tell("disabled", world)
        world.axis.record_foreign_command("0x201 [00], which disables the drive", enables=False)
        tell("foreign", world)
        await world.seconds(0.6)
        await world.armed()
        world.drive.change(world.ticks._index * 0.01 + 0.001, stays_enabled=True, load=-1.0)
        world.axis.disarm()
        await world.seconds(0.1)
        world.wire.disturb(lambda sender, message, _: [] if sender == "drive" else [(0.0, message)])
        await world.seconds(0.1)
        tell("silent", world)
        world.wire.restore()
        await world.until(lambda: world.state() is State.TRIPPED)
        await world.seconds(0.5)
        tell("not disabled", world)
        world.drive.change(world.ticks._index * 0.01 + 0.001, stays_enabled=False)
        await world.seconds(0.1)
        tell("tripped", world)

    simulate(script)
    return told


class Told:
    """A connection to a service that answers with what was told, one after the other; the last one for ever."""

    def __init__(self, answers: list[JsonObject]) -> None:
        self.path = Path("socket")
        self._answers = answers
        self.requests: list[JsonObject] = []

    def ask(self, request: Request, patience_s: float | None = None) -> JsonObject:
        if isinstance(request, ReleaseRequest):
            return self._answers[-1]
        self.requests.append(request.to_json())
        return self._answers[0] if len(self._answers) == 1 else self._answers.pop(0)

    def snapshots(self, _: WatchRequest) -> Iterator[Status]:
        while len(self._answers) > 1:
            yield Status.from_json(self._answers.pop(0))
        yield Status.from_json(self._answers[0])

    def close(self) -> None:
        pass


def run(monkeypatch: pytest.MonkeyPatch, verb: str, *answers: JsonObject) -> tuple[int, Told]:
    told = Told(list(answers))
    monkeypatch.setattr(blocking, "Connection", lambda *_: told)
    return main([verb, "--socket", "socket"]), told


@pytest.mark.parametrize("verb", ["disarm", "reset", "stop"])
def test_a_command_waits_until_the_drive_is_seen_to_be_off(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], snapshots: Snapshots, verb: str
) -> None:
    disabling, disabled = snapshots["disabling"], snapshots["disabled"]
    code, client = run(monkeypatch, verb, disabling, disabling, disabling, disabled)
    assert code == 0
    assert [request["op"] for request in client.requests] == [verb, "status"]
    assert capsys.readouterr().out.startswith("x: disarmed at 0.000 mm\n")


@pytest.mark.parametrize("verb", ["disarm", "reset", "stop", "status"])
def test_a_drive_that_does_not_obey_is_told_and_ends_each_command_with_3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], snapshots: Snapshots, verb: str
) -> None:
    code, _ = run(monkeypatch, verb, snapshots["disabling"], snapshots["disabling"], snapshots["not disabled"])
    if verb == "status":
        code, _ = run(monkeypatch, verb, snapshots["not disabled"])
    assert code == 3
    out = capsys.readouterr().out
    assert "mm while disabled" in out
    assert "trip drive_not_disabled: the drive was told to disable" in out
    assert "next: The drive does not obey: switch off its power" in out
    assert "lasts drive_not_disabled: the drive was told to disable" in out


@pytest.mark.parametrize("verb", ["disarm", "reset", "status"])
def test_somebody_elses_commands_to_a_disarmed_axis_are_told_and_end_each_command_with_3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], snapshots: Snapshots, verb: str
) -> None:
    assert snapshots["foreign"]["trip"] is None
    code, _ = run(monkeypatch, verb, snapshots["foreign"])
    assert code == 3
    out = capsys.readouterr().out
    assert "\nlasts foreign_command: another node on the bus commands this drive: 0x201 [00]" in out
    assert "\nnext: Keep away from the axis" in out


def test_disarm_does_not_take_the_silence_of_a_drive_that_was_enabled_for_an_answer(
    monkeypatch: pytest.MonkeyPatch, snapshots: Snapshots
) -> None:
    drive = snapshots["silent"]["drive"]
    assert (drive["enabled"], drive["disabling"], drive["moved"]) == (True, False, None)
    assert run(monkeypatch, "disarm", snapshots["silent"])[0] == 3


def test_status_says_that_nobody_knows_whether_a_silent_drive_is_off(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], snapshots: Snapshots
) -> None:
    assert run(monkeypatch, "status", snapshots["silent"])[0] == 3
    out = capsys.readouterr().out
    assert "\nlasts stale_feedback: the drive was told to disable" in out
    assert "nobody knows whether it is off" in out


def test_disarm_of_an_axis_that_has_tripped_is_done_when_its_drive_is_off(
    monkeypatch: pytest.MonkeyPatch, snapshots: Snapshots
) -> None:
    assert snapshots["tripped"]["trip"]["code"] == "drive_not_disabled"
    assert run(monkeypatch, "disarm", snapshots["tripped"])[0] == 0
    assert run(monkeypatch, "status", snapshots["tripped"])[0] == 3


@pytest.mark.parametrize(("not_disabled", "code"), [([], 0), (["x"], 3)])
def test_run_ends_with_3_if_a_drive_was_not_seen_to_be_disabled(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, not_disabled: list[str], code: int
) -> None:
    monkeypatch.setattr("twostage_servo.app.serve.serve", lambda *_: Served({}, not_disabled))
    config = Path(__file__).parents[2] / "config" / "two_processes.toml"
    arguments = ["--config", str(config), "--set", f"service.socket={tmp_path / 'socket'}"]
    assert main(["run", *arguments]) == code
