"""What is kept of a trip on disk, and that no disk ever changes what the axis does."""

import asyncio
import errno
import itertools
import json
import math
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.service.rig import World, simulate
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.service.recorder import Record
from twostage_servo.service.trip_files import KEPT, TripFiles, default_folder
from twostage_servo.simulation.virtual_clock import run

Trace = list[tuple[int, str, int, bytes]]


def trip_in_mid_move(
    folder: Path | None, *overrides: str, disk: Callable[[], object] = lambda: None
) -> tuple[Trace, dict[str, Any]]:
    """Let the disk do something and the drive fail in mid-move; return the frames on the bus and the last snapshot."""

    async def script(world: World) -> tuple[Trace, dict[str, Any]]:
        if folder is not None:
            world.station.reporter.trip_files = TripFiles(folder)
        await world.cruising()
        await world.seconds(1.0)
        disk()
        world.drive.change(asyncio.get_running_loop().time(), ignores_effort=True, load=-5.0)
        await world.until(lambda: world.state() is State.TRIPPED)
        await world.seconds(0.5)
        assert world.service.statistics.missed == 0
        return world.trace, world.service.snapshot()

    return simulate(script, *overrides)


def only_file(folder: Path) -> Path:
    (file,) = folder.iterdir()
    return file


def test_a_trip_leaves_a_file_with_what_led_to_it(tmp_path: Path) -> None:
    folder = tmp_path / "state" / "trips"
    _, snapshot = trip_in_mid_move(folder)
    file = only_file(folder)
    assert (snapshot["trip"]["file"], snapshot["trip"]["file_error"]) == (str(file), None)
    assert file.name.endswith(f"-x-{snapshot['trip']['code']}.json")
    document = json.loads(file.read_text(encoding="utf-8"))
    assert set(document) == {"snapshot", "fields", "records"}
    assert document["fields"] == list(Record._fields)
    trip = document["snapshot"]["trip"]
    assert {key: trip[key] for key in ("code", "cause", "next_action", "tick")} == {
        key: snapshot["trip"][key] for key in ("code", "cause", "next_action", "tick")
    }
    records = [Record(*record) for record in document["records"]]
    assert len(records) == 200  # 2 s, up to the tick of the trip
    assert records[-1].tick == trip["tick"]
    assert [after.tick - before.tick for before, after in itertools.pairwise(records)] == [1] * 199
    assert records[0].state == State.SPEED_STAGE
    assert records[-1].state in {State.TRIPPED, State.TRIPPED_QUICK_STOP}


def test_the_length_is_the_recordings(tmp_path: Path) -> None:
    trip_in_mid_move(tmp_path, "service.recording_s=0.5")
    assert len(json.loads(only_file(tmp_path).read_text(encoding="utf-8"))["records"]) == 50


def test_each_trip_has_its_file(tmp_path: Path) -> None:
    async def script(world: World) -> None:
        world.station.reporter.trip_files = files = TripFiles(tmp_path)
        for number in range(1, 4):
            await world.armed()
            world.axis.raise_trip(TripCode.OVERSPEED, f"number {number}")
            await world.until(lambda: world.state() is State.TRIPPED)
            await world.seconds(0.05)
            assert len(os.listdir(tmp_path)) == number  # noqa: PTH208
            assert files.latest is not None
            assert (
                json.loads(files.latest.read_text(encoding="utf-8"))["snapshot"]["trip"]["cause"] == f"number {number}"
            )
            world.axis.reset()
            assert world.service.snapshot()["trip"] is None

    simulate(script)


def test_numbers_that_are_not_finite_are_null_in_the_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    async def script(world: World) -> None:
        world.station.reporter.trip_files = TripFiles(tmp_path)
        await world.cruising()
        step = type(world.axis.law).step
        monkeypatch.setattr(type(world.axis.law), "step", lambda law, sample: step(law, sample) + math.nan)
        monkeypatch.setattr(type(world.axis.motion), "finite", False)
        await world.until(lambda: world.axis.trip is not None)
        world.axis.law.observer.velocity = math.nan
        await world.seconds(0.05)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.NOT_FINITE

    simulate(script)
    document = json.loads(only_file(tmp_path).read_text(encoding="utf-8"))
    assert document["snapshot"]["trip"]["code"] == "not_finite"


def test_records_that_are_not_finite_are_null(tmp_path: Path) -> None:
    async def write() -> None:
        TripFiles(tmp_path).write("x", {"fields": ("a", "b", "c")}, ((1, math.nan, 2.5), (2, -math.inf, None)))

    run(write())
    document = json.loads(only_file(tmp_path).read_text(encoding="utf-8"))
    assert document["records"] == [[1, None, 2.5], [2, None, None]]


def test_the_name_shows_only_when_the_file_is_whole_and_on_the_disk(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[tuple[list[str], bool]] = []
    fsync = os.fsync

    def spy(descriptor: int) -> None:
        names = [path.suffix for path in tmp_path.iterdir()]
        content = [path.read_text(encoding="utf-8") for path in tmp_path.iterdir()]
        seen.append((names, all(json.loads(text)["records"] == [[1]] for text in content)))
        fsync(descriptor)

    async def write() -> None:
        TripFiles(tmp_path).write("x", {}, ((1,),))

    monkeypatch.setattr(os, "fsync", spy)
    run(write())
    # The file's content first, under another name; then the folder's entry.
    assert seen == [([".part"], True), ([".json"], True)]


def test_an_axis_name_cannot_lead_out_of_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "trips"

    async def write() -> None:
        TripFiles(folder).write("../../etc/x y:\n-jam", {}, ())

    run(write())
    assert only_file(tmp_path) == folder
    assert only_file(folder).name.endswith("-______etc_x_y__-jam.json")


# A disk that fails ----------------------------------------------------------------------------------------------------


def no_space(*_: object, **__: object) -> Any:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("where", ["fsync", "open", "replace", "mkdir"])
def test_a_full_disk_changes_nothing_but_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, where: str) -> None:
    undisturbed, _ = trip_in_mid_move(None)

    def fill() -> None:
        monkeypatch.setattr(os if where == "fsync" else Path, where, no_space)

    trace, snapshot = trip_in_mid_move(tmp_path, disk=fill)
    monkeypatch.undo()
    assert trace == undisturbed
    assert "No space left on device" in snapshot["trip"]["file_error"]
    assert str(tmp_path) in snapshot["trip"]["file_error"]
    assert snapshot["trip"]["file"] is None
    assert list(tmp_path.iterdir()) == []  # nothing that is half written


def test_a_folder_that_cannot_be_made_changes_nothing_but_says_so(tmp_path: Path) -> None:
    undisturbed, _ = trip_in_mid_move(None)
    (tmp_path / "file").write_text("not a folder", encoding="utf-8")
    trace, snapshot = trip_in_mid_move(tmp_path / "file" / "trips")
    assert trace == undisturbed
    assert "Not a directory" in snapshot["trip"]["file_error"]


@pytest.mark.skipif(os.geteuid() == 0, reason="to root no folder is read-only")
def test_a_read_only_folder_changes_nothing_but_says_so(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    _, snapshot = trip_in_mid_move(tmp_path)
    assert "Permission denied" in snapshot["trip"]["file_error"]


def test_the_next_trip_is_written_when_the_disk_is_well_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    async def write_two() -> None:
        files = TripFiles(tmp_path)
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", no_space)
            files.write("first", {}, ())
            await asyncio.sleep(0.1)
        assert (files.latest, files.error is None) == (None, False)
        files.write("second", {}, ())
        await asyncio.sleep(0.1)
        assert (files.latest, files.error) == (only_file(tmp_path), None)

    run(write_two())


def test_a_disk_that_hangs_is_not_waited_for(tmp_path: Path) -> None:
    hanging, let_go = threading.Event(), threading.Event()

    def hang(path: Path, *_: object) -> None:
        hanging.set()
        assert let_go.wait(60)

    async def write() -> None:
        files = TripFiles(tmp_path, hang)
        files.write("x", {}, ())
        assert await asyncio.to_thread(hanging.wait, 60)
        assert files.latest is None  # this loop has gone on meanwhile
        let_go.set()
        await asyncio.wait(files._writing)
        await asyncio.sleep(0)
        assert files.latest is not None

    asyncio.run(write())


# What is kept, and where ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("year", [2001, 2999], ids=["older", "of a clock that was ahead"])
def test_only_so_many_files_are_kept_and_the_new_one_is_among_them(tmp_path: Path, year: int) -> None:
    old = [tmp_path / f"{year}0101T0000{second:02}Z-7-1-x-jam.json" for second in range(60)]
    for path in (*old, tmp_path / "recipe.json", tmp_path / "notes.txt"):
        path.write_text("{}", encoding="utf-8")

    async def write() -> Path | None:
        files = TripFiles(tmp_path)
        files.write("x", {}, ())
        await asyncio.sleep(0.1)
        return files.latest

    new = run(write())
    assert new is not None
    left = {path for path in tmp_path.iterdir() if path not in {tmp_path / "recipe.json", tmp_path / "notes.txt"}}
    assert left == {new, *old[-(KEPT - 1) :]}
    assert (tmp_path / "recipe.json").exists()  # what is not ours stays
    assert (tmp_path / "notes.txt").exists()


def test_where_they_go(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_folder() == tmp_path / ".local" / "state" / "twostage-servo" / "trips"
    monkeypatch.setenv("XDG_STATE_HOME", "/var/me")
    assert default_folder() == Path("/var/me/twostage-servo/trips")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/twostage-servo:/var/lib/other")
    assert default_folder() == Path("/var/lib/twostage-servo/trips")
