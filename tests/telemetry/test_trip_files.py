"""What is kept of a trip on disk, and that no disk ever changes what the axis does."""

import asyncio
import concurrent.futures
import errno
import fcntl
import itertools
import json
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.service.rig import World, simulate
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.telemetry import trip_files
from twostage_servo.telemetry.sample import FIELDS, Sample
from twostage_servo.telemetry.trip_files import KEPT, TripFiles, default_folder, write_file
from twostage_servo.timing.virtual_clock import run

Trace = list[tuple[int, str, int, bytes]]


def trip_in_mid_move(
    folder: Path | None, *overrides: str, disk: Callable[[], object] = lambda: None
) -> tuple[Trace, dict[str, Any]]:
    """Let the disk do something and the drive fail in mid-move; return the frames on the bus and the last snapshot."""

    async def script(world: World) -> tuple[Trace, dict[str, Any]]:
        if folder is not None:
            world.loop.trip_files.use(TripFiles(folder))
        await world.cruising()
        await world.seconds(1.0)
        disk()
        world.drive.change(asyncio.get_running_loop().time(), ignores_effort=True, load=-5.0)
        await world.until(lambda: world.state() is State.TRIPPED)
        await world.seconds(0.5)
        assert world.service.statistics.missed == 0
        return world.trace, world.loop.snapshot()

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
    assert document["fields"] == list(FIELDS)
    trip = document["snapshot"]["trip"]
    assert {key: trip[key] for key in ("code", "cause", "next_action", "tick")} == {
        key: snapshot["trip"][key] for key in ("code", "cause", "next_action", "tick")
    }
    records = [Sample(*record) for record in document["records"]]
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
        files = TripFiles(tmp_path)
        world.loop.trip_files.use(files)
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
            assert world.loop.snapshot()["trip"] is None

    simulate(script)


def test_numbers_that_are_not_finite_are_null_in_the_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    async def script(world: World) -> None:
        world.loop.trip_files.use(TripFiles(tmp_path))
        await world.cruising()
        step = TwoStageLaw.step
        monkeypatch.setattr(TwoStageLaw, "step", lambda law, sample: step(law, sample) + math.nan)
        monkeypatch.setattr(Motion, "finite", False)
        await world.until(lambda: world.axis.trip is not None)
        monkeypatch.setattr(world.axis, "estimate", SimpleNamespace(position=0.0, velocity=math.nan, disturbance=0.0))
        await world.seconds(0.05)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.NOT_FINITE

    simulate(script)
    document = json.loads(only_file(tmp_path).read_text(encoding="utf-8"))
    assert document["snapshot"]["trip"]["code"] == "not_finite"


def test_records_that_are_not_finite_are_null(tmp_path: Path) -> None:
    async def write() -> None:
        TripFiles(tmp_path).write("x", "stall", {"fields": ("a", "b", "c")}, ((1, math.nan, 2.5), (2, -math.inf, None)))

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
        TripFiles(tmp_path).write("x", "stall", {}, ((1,),))

    monkeypatch.setattr(os, "fsync", spy)
    run(write())
    # The file's content first, under another name; then the folder's entry.
    assert seen == [([".part"], True), ([".json"], True)]


def test_an_axis_name_cannot_lead_out_of_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "trips"

    async def write() -> None:
        TripFiles(folder).write("../../etc/x y:\n", "stall", {}, ())

    run(write())
    assert only_file(tmp_path) == folder
    assert only_file(folder).name.endswith("-______etc_x_y__-stall.json")


# A disk that fails ----------------------------------------------------------------------------------------------------


def no_space(*_: object, **__: object) -> Any:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("where", ["fsync", "open", "replace", "mkdir"])
def test_a_full_disk_changes_nothing_but_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, where: str) -> None:
    undisturbed, _ = trip_in_mid_move(None)

    def fill() -> None:
        monkeypatch.setattr(os if where in {"fsync", "open"} else Path, where, no_space)

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
            files.write("first", "stall", {}, ())
            await asyncio.sleep(0.1)
        assert (files.latest, files.error is None) == (None, False)
        files.write("second", "stall", {}, ())
        await asyncio.sleep(0.1)
        assert (files.latest, files.error) == (only_file(tmp_path), None)

    run(write_two())


def test_a_disk_that_hangs_is_not_waited_for(tmp_path: Path) -> None:
    hanging, let_go = threading.Event(), threading.Event()

    def hang(folder: Path, *_: object) -> Path:
        hanging.set()
        assert let_go.wait(60)
        return folder / "it"

    async def write() -> None:
        files = TripFiles(tmp_path, hang)
        files.write("x", "stall", {}, ())
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
    old = [tmp_path / f"{year}0101T0000{second:02}Z-7-1-x-stall.json" for second in range(60)]
    for path in (*old, tmp_path / "recipe.json", tmp_path / "notes.txt"):
        path.write_text("{}", encoding="utf-8")

    async def write() -> Path | None:
        files = TripFiles(tmp_path)
        files.write("x", "stall", {}, ())
        await asyncio.sleep(0.1)
        return files.latest

    new = run(write())
    assert new is not None
    left = {path for path in tmp_path.iterdir() if path not in {tmp_path / "recipe.json", tmp_path / "notes.txt"}}
    assert left == {new, *old[-(KEPT - 1) :]}
    assert (tmp_path / "recipe.json").exists()  # what is not ours stays
    assert (tmp_path / "notes.txt").exists()


def test_a_folder_that_has_to_be_made_is_not_for_everybody(tmp_path: Path) -> None:
    folder = tmp_path / "state" / "trips"
    before = os.umask(0o022)
    try:
        write_several(folder, "x")
    finally:
        os.umask(before)
    assert folder.stat().st_mode & 0o777 == 0o750
    assert only_file(folder).stat().st_mode & 0o777 == 0o644


def test_where_they_go(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_folder() == tmp_path / ".local" / "state" / "twostage-servo" / "trips"
    monkeypatch.setenv("XDG_STATE_HOME", "/var/me")
    assert default_folder() == Path("/var/me/twostage-servo/trips")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/twostage-servo:/var/lib/other")
    assert default_folder() == Path("/var/lib/twostage-servo/trips")


# Names that no clock decides ------------------------------------------------------------------------------------------


def write_several(folder: Path, *axes: str) -> None:
    async def write() -> None:
        files = TripFiles(folder)
        for axis in axes:
            files.write(axis, "stale_feedback", {"name": axis}, ())
        assert files.error is None

    run(write())


def names_in(folder: Path) -> list[str]:
    """Return who has a file in a folder, the oldest first."""
    return [json.loads(path.read_text(encoding="utf-8"))["name"] for path in sorted(folder.iterdir())]


def test_of_two_trips_of_one_moment_both_files_stay_although_the_clock_was_ahead(tmp_path: Path) -> None:
    for second in range(KEPT):
        (tmp_path / f"20990101T0000{second:02}Z-7-1-x-stall.json").write_text("{}", encoding="utf-8")
    write_several(tmp_path, "x", "y", "z")
    new = sorted(path.name.partition("Z-")[2] for path in tmp_path.iterdir() if path.name.startswith("0000"))
    assert new == ["x-stale_feedback.json", "y-stale_feedback.json", "z-stale_feedback.json"]
    assert len(list(tmp_path.iterdir())) == KEPT


def test_the_newest_are_kept_whatever_the_clock_is_set_to(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for number in range(KEPT + 7):
        year = (2099, 1970, 2026)[number % 3]
        monkeypatch.setattr(time, "gmtime", lambda *_, year=year: time.struct_time((year, 1, 1, 0, 0, 7, 6, 1, 0)))
        write_several(tmp_path, f"axis{number}")
    assert names_in(tmp_path) == [f"axis{number}" for number in range(7, KEPT + 7)]


def test_the_same_second_process_and_number_after_a_reboot_writes_over_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(time, "gmtime", lambda *_: time.struct_time((2023, 1, 1, 0, 0, 7, 6, 1, 0)))
    monkeypatch.setattr(os, "getpid", lambda: 1)
    for _ in range(3):
        write_several(tmp_path, "x-stall")
    assert names_in(tmp_path) == ["x-stall"] * 3


def test_services_that_share_a_folder_give_each_number_once(tmp_path: Path) -> None:
    services, each = 8, 5
    together = threading.Barrier(services)

    def serve(number: int) -> None:
        together.wait(60)
        for count in range(each):
            write_file(tmp_path, "x-stall", {"service": number, "count": count}, ())

    with concurrent.futures.ThreadPoolExecutor(services) as pool:
        list(pool.map(serve, range(services)))
    numbers = sorted(int(path.name.partition("-")[0]) for path in tmp_path.iterdir())
    assert numbers == list(range(1, services * each + 1))
    written = {
        (document["service"], document["count"])
        for document in (json.loads(path.read_text(encoding="utf-8")) for path in tmp_path.iterdir())
    }
    assert len(written) == services * each


def test_a_name_that_is_taken_is_not_written_over(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    taken = tmp_path / "000001-20230101T000007Z-x-stall.part"
    monkeypatch.setattr(time, "gmtime", lambda *_: time.struct_time((2023, 1, 1, 0, 0, 7, 6, 1, 0)))
    iterdir = Path.iterdir
    seen: list[Path] = []

    def too_early(folder: Path) -> Iterator[Path]:
        """Look just before somebody else has made a file, on a file system without locks."""
        if not seen:
            seen.append(folder)
            taken.write_text("theirs", encoding="utf-8")
            return iter(())
        return iterdir(folder)

    monkeypatch.setattr(Path, "iterdir", too_early)
    path = write_file(tmp_path, "x-stall", {}, ())
    assert path.name == "000002-20230101T000007Z-x-stall.json"


def test_what_a_power_cut_left_is_removed_and_what_another_service_writes_is_not(tmp_path: Path) -> None:
    left, earlier, theirs, recipe = (
        tmp_path / name
        for name in (
            "000007-20990101T000000Z-x-stall.part", "20990101T000000Z-7-1-x-stall.part",
            "000008-20230101T000000Z-y-stall.part", "recipe.part",
        )
    )  # fmt: skip
    for path in (left, earlier, theirs, recipe):
        path.write_text("{", encoding="utf-8")
        os.utime(path, (4e9, 4e9))  # of a clock that was ahead
    with theirs.open() as being_written:
        fcntl.flock(being_written, fcntl.LOCK_EX)
        path = write_file(tmp_path, "x-stall", {}, ())
        assert sorted(tmp_path.iterdir()) == sorted([theirs, recipe, path])
    assert path.name.startswith("000009-")


def test_a_service_that_was_stopped_while_it_had_the_folder_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(time, "sleep", pauses.append)
    directory = os.open(tmp_path, os.O_RDONLY)
    try:
        fcntl.flock(directory, fcntl.LOCK_EX)
        path = write_file(tmp_path, "x-stall", {}, ())
    finally:
        os.close(directory)
    assert path.exists()
    assert 1.0 < sum(pauses) < 10.0


# No thread, no memory -------------------------------------------------------------------------------------------------


def no_thread_left(*_: object) -> None:
    raise RuntimeError("can't start new thread")


def test_a_trip_needs_no_thread_that_is_not_there_yet(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    async def write() -> None:
        files = TripFiles(tmp_path)
        files.start()
        monkeypatch.setattr(threading.Thread, "start", no_thread_left)
        files.write("x", "stall", {"name": "x"}, ())
        await asyncio.wait(files._writing)
        await asyncio.sleep(0)
        assert (files.error, files.latest) == (None, only_file(tmp_path))
        files.close()

    asyncio.run(write())


def test_without_a_thread_the_service_goes_on_and_says_that_there_is_no_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    async def write() -> str | None:
        files = TripFiles(tmp_path)
        monkeypatch.setattr(threading.Thread, "start", no_thread_left)
        files.write("x", "stall", {}, ())
        return files.error

    error = asyncio.run(write())
    assert error is not None
    assert "can't start new thread" in error


@pytest.mark.parametrize("where", ["writer", "snapshot", "recorder"])
def test_a_trip_for_which_there_is_no_memory_is_told_and_changes_nothing_else(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, where: str
) -> None:
    undisturbed, _ = trip_in_mid_move(None)

    def no_memory(*_: object, **__: object) -> Any:
        raise MemoryError

    def exhaust() -> None:
        if where == "writer":
            monkeypatch.setattr(json, "dump", no_memory)
        elif where == "snapshot":
            monkeypatch.setattr("twostage_servo.service.trip_recorder.TripRecorder._document", no_memory)
        else:
            monkeypatch.setattr("twostage_servo.telemetry.recorder.Recorder.keep", no_memory)

    trace, snapshot = trip_in_mid_move(tmp_path, disk=exhaust)
    assert trace == undisturbed
    assert snapshot["trip"]["file"] is None
    assert "out of memory" in snapshot["trip"]["file_error"]
    assert list(tmp_path.iterdir()) == []


def test_the_end_waits_until_the_file_is_written(tmp_path: Path) -> None:
    begun, let_go = threading.Event(), threading.Event()

    def slow(folder: Path, *_: object) -> Path:
        begun.set()
        assert let_go.wait(60)
        (folder / "whole").write_text("", encoding="utf-8")
        return folder / "whole"

    async def write() -> None:
        files = TripFiles(tmp_path, slow)
        files.write("x", "stall", {}, ())
        assert await asyncio.to_thread(begun.wait, 60)
        let_go.set()
        files.close()
        assert (tmp_path / "whole").exists()

    asyncio.run(write())


def test_a_disk_that_hangs_keeps_no_service_from_ending(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(trip_files, "_LONGEST_END_S", 0.0)
    let_go = threading.Event()

    def hang(folder: Path, *_: object) -> Path:
        assert let_go.wait(60)
        return folder

    async def write() -> None:
        files = TripFiles(tmp_path, hang)
        files.write("x", "stall", {}, ())
        files.close()
        let_go.set()

    asyncio.run(write())


def test_each_axis_tells_of_its_own_file(tmp_path: Path) -> None:
    async def write() -> None:
        files = TripFiles(tmp_path)
        one, another = files.write("x", "stall", {"name": "x"}, ()), files.write("y", "stall", {"name": "y"}, ())
        await asyncio.sleep(0.1)
        assert one.path is not None
        assert another.path is not None
        assert one.path.endswith("-x-stall.json")
        assert another.path.endswith("-y-stall.json")

    run(write())


def test_the_file_of_an_earlier_trip_is_not_told_as_that_of_this_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    async def script(world: World) -> None:
        world.loop.trip_files.use(TripFiles(tmp_path))
        for is_full in (False, True):
            await world.armed()
            if is_full:
                monkeypatch.setattr(os, "fsync", no_space)
            world.axis.raise_trip(TripCode.OVERSPEED, "again")
            await world.until(lambda: world.state() is State.TRIPPED)
            await world.seconds(0.05)
            trip = world.loop.snapshot()["trip"]
            assert (trip["file"] is None, trip["file_error"] is None) == (is_full, not is_full)
            if not is_full:
                world.axis.reset()

    simulate(script)


def test_where_a_file_system_has_no_locks_the_files_are_written_and_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def none_here(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", none_here)
    write_several(tmp_path, "first", "second")
    assert names_in(tmp_path) == ["first", "second"]
