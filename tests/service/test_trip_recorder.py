"""What is kept of each trip; of an axis loop that is written by hand, and of two axes on a bus."""

import asyncio
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import structlog

from tests.service.test_several_axes import Plant, axis_page, machine_file, operate
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import Trip, TripCode, TripFile
from twostage_servo.service.status_line import status_line
from twostage_servo.service.trip_recorder import TripRecorder
from twostage_servo.telemetry.sample import FIELDS
from twostage_servo.telemetry.trip_files import TripFiles
from twostage_servo.timing.ticks import Tick


class Files:
    """Trip files that remember what they were asked for."""

    def __init__(self) -> None:
        self.written: list[tuple[Any, ...]] = []
        self.failed: list[tuple[str, str, BaseException, TripFile]] = []

    def write(self, *arguments: Any) -> None:
        self.written.append(arguments)

    def fail(self, axis: str, code: str, error: BaseException, file: TripFile) -> None:
        self.failed.append((axis, code, error, file))


class Kept:
    """A recorder of trips with the axis that it looks at."""

    def __init__(self, files: Files | None) -> None:
        self.kept = 0
        self.axis = SimpleNamespace(trip=None)
        axis_loop: Any = SimpleNamespace(name="x", axis=self.axis, recorder=self)
        self._recorder = TripRecorder(axis_loop, lambda one: {"a snapshot of": one.name}, files)

    def keep(self) -> list[str]:
        self.kept += 1
        return ["records"]

    def trip(self, code: TripCode = TripCode.STALL) -> Trip:
        trip = Trip(code, "cause", 10)
        self.axis.trip = trip
        return trip

    def tick(self) -> list[dict[str, Any]]:
        with structlog.testing.capture_logs() as logs:
            self._recorder.publish(Tick(1, 0.0, 0.0, 0))
        return [dict(line) for line in logs]


def no_memory() -> list[str]:
    raise MemoryError


def test_a_recording_is_written_once_with_what_the_axis_was_and_the_names_of_its_columns() -> None:
    files = Files()
    kept = Kept(files)
    kept.tick()
    assert files.written == []
    trip = kept.trip()
    kept.tick()
    kept.tick()
    document = {"snapshot": {"a snapshot of": "x"}, "fields": FIELDS}
    assert files.written == [("x", "stall", document, ["records"], trip.file)]
    assert (files.failed, kept.kept) == ([], 1)
    kept.axis.trip = None
    kept.tick()
    again = kept.trip(TripCode.OVERSPEED)
    kept.tick()
    assert files.written[1][:2] == ("x", "overspeed")
    assert files.written[1][4] is again.file


def test_for_want_of_memory_the_file_of_this_trip_has_failed() -> None:
    files = Files()
    kept = Kept(files)
    kept.keep = no_memory  # type: ignore[method-assign]
    trip = kept.trip()
    assert kept.tick() == []
    ((axis, code, error, file),) = files.failed
    assert (axis, code, type(error), file) == ("x", "stall", MemoryError, trip.file)
    assert files.written == []


def test_for_want_of_memory_without_files_the_log_says_so() -> None:
    kept = Kept(None)
    kept.keep = no_memory  # type: ignore[method-assign]
    kept.trip()
    text = "no recording of the trip: out of memory"
    assert kept.tick() == [{"event": text, "log_level": "error", "axis": "x", "code": "stall"}]


def test_two_axes_that_trip_one_after_the_other_name_each_its_own_file(tmp_path: Path) -> None:
    pages = {name: axis_page(name, "can0", offset=offset) for offset, name in enumerate("xy")}
    folder = tmp_path / "trips"

    async def script(plant: Plant) -> None:
        plant.loop.trip_files.use(TripFiles(folder))
        await plant.armed()
        for name in "xy":
            plant.axis(name).raise_trip(TripCode.OVERSPEED, f"of {name}")
            await plant.until(lambda name=name: plant.axis(name).state is State.TRIPPED)  # type: ignore[misc]
            await asyncio.sleep(3.0)
        told.update({name: plant.ask(op="status", axis=name)["trip"] for name in "xy"})
        lines.append(status_line(plant.service.axis_loops, 0, is_ending=False))

    told: dict[str, dict[str, Any]] = {}
    lines: list[str] = []
    with structlog.testing.capture_logs() as logs:
        operate(machine_file(tmp_path, pages, 'when_one_trips = "continue"\n'), script)
    files = {name: next(folder.glob(f"*-{name}-overspeed.json")) for name in "xy"}
    assert {name: trip["file"] for name, trip in told.items()} == {name: str(file) for name, file in files.items()}
    for name, file in files.items():
        trip = json.loads(file.read_text(encoding="utf-8"))["snapshot"]["trip"]
        assert (trip["cause"], trip["file"], trip["file_error"]) == (f"of {name}", str(file), None)
    written = [line for line in logs if line["event"] == "trip file"]
    assert {(line["axis"], line["code"], line["path"]) for line in written} == {
        (name, "overspeed", str(file)) for name, file in files.items()
    }
    assert "Besides" not in lines[0]


@pytest.mark.parametrize("trips", [(TripCode.STALL, TripCode.OVERSPEED)])
def test_a_trip_that_follows_another_is_of_the_same_file(trips: tuple[TripCode, ...], tmp_path: Path) -> None:
    async def script(plant: Plant) -> None:
        plant.loop.trip_files.use(TripFiles(tmp_path / "trips"))
        await plant.armed()
        for code in trips:
            plant.axis("x").raise_trip(code, "one after the other")
            await asyncio.sleep(0.5)

    operate(machine_file(tmp_path, {"x": axis_page("x", "can0")}), script)
    (file,) = (tmp_path / "trips").iterdir()
    assert file.name.endswith("-x-stall.json")
