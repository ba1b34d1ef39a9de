"""What the operator's commands show of a bus that is closed, a silent drive, and a trip file that is not there."""

import json
from pathlib import Path

import pytest

from tests.cli.test_disabled_drive import Snapshots, run
from tests.service.rig import World, simulate
from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import Request, StopRequest
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.trips import TripCode
from twostage_servo.client.errors import Refused
from twostage_servo.telemetry.trip_files import TripFiles

CLOSED = "the bus is closed: socketcan can0 cannot be opened: Network is down"
SILENT = "no fresh feedback from the drive for 90 ms"


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Snapshots:
    told: Snapshots = {}
    folder = tmp_path_factory.mktemp("trips")
    (folder / "file").write_text("not a folder", encoding="utf-8")

    def tell(name: str, world: World) -> None:
        told[name] = json.loads(json.dumps(world.loop.snapshot()))

    async def script(world: World) -> None:
        told["start"] = json.loads(json.dumps(world.loop.snapshot()))
        await world.until(lambda: world.axis.ready_to_arm)
        tell("disarmed", world)
        world.wire.disturb(lambda sender, message, _: [] if sender == "drive" else [(0.0, message)])
        await world.seconds(0.1)
        tell("silent", world)
        world.axis_loop.bus.error = "socketcan can0 cannot be opened: Network is down."
        world.axis.drive.forget()
        tell("closed", world)
        world.axis_loop.bus.error = None
        world.wire.restore()
        world.loop.trip_files.use(TripFiles(folder / "file" / "trips"))
        await world.armed()
        world.axis.raise_trip(TripCode.SPEED_UNREACHABLE, "it does not come to that")
        world.axis.raise_trip(TripCode.DRIVE_FAULT, "the drive reports fault code 7")
        await world.seconds(0.5)
        tell("no file", world)
        told["line"] = {"line": world.line()}

    simulate(script)
    return told


@pytest.mark.parametrize("verb", ["disarm", "reset"])
@pytest.mark.parametrize(("name", "why"), [("closed", CLOSED), ("silent", SILENT)])
def test_a_verb_after_which_the_drive_should_be_off_says_that_nobody_knows_whether_it_is(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    shown: Snapshots,
    verb: str,
    name: str,
    why: str,
) -> None:
    assert run(monkeypatch, verb, shown[name])[0] == 3
    out = capsys.readouterr().out
    assert out.startswith(f"x: disarmed, position unknown; {why}\n")
    assert "x: nobody knows whether the drive is off; its own command time-out should have stopped it" in out
    assert run(monkeypatch, verb, shown["disarmed"])[0] == 0
    assert "not known" not in capsys.readouterr().out


@pytest.mark.parametrize("verb", ["watch", "status", "release", "reload"])
def test_each_verb_names_a_bus_that_is_closed_and_a_drive_that_has_never_been_heard(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], shown: Snapshots, verb: str
) -> None:
    assert run(monkeypatch, verb, shown["closed"])[0] == 0
    assert CLOSED in capsys.readouterr().out
    never_heard = shown["start"] | {"bus": shown["disarmed"]["bus"]}
    assert run(monkeypatch, verb, never_heard)[0] == 0
    assert "no position has come from the drive" in capsys.readouterr().out


def test_a_stop_of_what_is_disarmed_is_done_if_the_drive_is_off(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], shown: Snapshots
) -> None:
    told: list[JsonObject] = []

    def refuse(self: object, request: Request, patience_s: float | None = None) -> JsonObject:
        if isinstance(request, StopRequest):
            raise Refused(RefusalCode.DISARMED, "there is nothing to stop.")
        return told[0]

    monkeypatch.setattr("tests.cli.test_disabled_drive.Told.ask", refuse)
    for name, code in (("disarmed", 0), ("closed", 3)):
        told[:] = [shown[name]]
        assert run(monkeypatch, "stop", shown[name])[0] == code
        captured = capsys.readouterr()
        assert captured.out.startswith("x: disarmed")
        assert "there is nothing to stop" in captured.err


def test_a_trip_file_that_could_not_be_written_is_told_and_so_is_each_later_trip(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], shown: Snapshots
) -> None:
    assert run(monkeypatch, "status", shown["no file"])[0] == 3
    out = capsys.readouterr().out
    assert "\nfile: no trip file can be written in /" in out
    assert "Not a directory" in out
    assert "status --recording FILE" in out
    assert "\nfurther trips: drive_fault" in out
    assert "no trip file can be written in /" in shown["line"]["line"]


def test_a_relative_folder_is_shown_whole(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert TripFiles(Path("trips")).folder == tmp_path / "trips"
