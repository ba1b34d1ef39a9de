"""What a law has learned outlives the service, if the configuration says so: over frames, in simulated time."""

import asyncio
import errno
import json
import os
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
import structlog

from tests.demo_file import DEMO, LAW_OF_THE_DEMO
from tests.service.rig import World, simulate
from tests.service.test_reload import change, reloading
from tests.service.test_request_handler import Client
from tests.service.test_several_axes import Plant, axis_page, machine_file, operate
from twostage_servo.api.requests import ForgetRequest
from twostage_servo.api.status import Status
from twostage_servo.app.build import build_requests
from twostage_servo.app.closed_loop import ClosedLoop
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.cli.axis_text import describe
from twostage_servo.service.law_memory import LawMemory
from twostage_servo.service.runtime import Runtime
from twostage_servo.telemetry.learned_files import LearnedFiles

OFF_THE_MODEL = ("axis.law.type=adaptive", "simulation.gain=225", "simulation.pole=10.5")
"""A plant that has five quarters of the model's gain, and three of its pole."""
KEPT = (*OFF_THE_MODEL, "axis.law.memory=file")
RESTORED = "the law goes on with what it had learned"
IGNORED = "what the law had learned is not used: the first move begins with the configured plant"
UNWRITABLE = "what a law has learned cannot be written, and ends with the service"

Logs = list[dict[str, Any]]


def kept_in(folder: Path, loop: ClosedLoop) -> tuple[LawMemory, LearnedFiles]:
    """Do what the service does as it starts."""
    files = LearnedFiles(folder)
    memory = LawMemory(loop.parts.axis_loops, files)
    memory.restore()
    loop.listen(memory.publish)
    return memory, files


def run(folder: Path, script: Callable[[World], Awaitable[None]], *overrides: str) -> Logs:
    """Run a service from its start to its end, and return what it has logged of its memory."""

    async def whole(world: World) -> None:
        memory, files = kept_in(folder, world.loop)
        await world.armed()
        await script(world)
        memory.finish()
        await files.close()

    with structlog.testing.capture_logs() as logs:
        simulate(whole, *(overrides or KEPT))
    ours = (RESTORED, IGNORED, UNWRITABLE)
    return [dict(line) for line in logs if line["event"] in ours or "learned" in line["event"]]


async def settled(world: World, target: float, velocity: float = 100.0) -> int:
    """Move after a rest; return the ticks after which the true position stays within 0.1 mm."""
    await world.seconds(1.0)
    world.axis.move_to(target, velocity)
    last = 0
    for tick in range(600):
        await asyncio.sleep(0.01)
        if abs(world.drive.position - target) > 0.1:
            last = tick + 1
    assert world.axis.trip is None
    return last


def moves(world: World) -> int:
    assert world.axis.learned is not None
    return world.axis.learned.moves


async def one_move(world: World) -> None:
    await settled(world, 400.0)


async def nothing(world: World) -> None:
    await world.seconds(0.1)


def only_file(folder: Path) -> Path:
    (file,) = folder.iterdir()
    return file


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def edited(file: Path, **changed: Any) -> None:
    document = json.loads(file.read_text("utf-8"))
    for key, value in changed.items():
        part = document if key in document else document["learned"]
        assert key in part
        part[key] = value
    file.write_text(json.dumps(document), "utf-8")


@pytest.mark.long
@pytest.mark.parametrize(("distance", "velocity", "gained"), [(400.0, 100.0, 0), (5.0, 200.0, 2)])
def test_the_first_move_after_a_restart_is_as_good_as_the_third_before_it(
    tmp_path: Path, distance: float, velocity: float, gained: int
) -> None:
    ticks: list[list[int]] = []

    async def three_moves(world: World) -> None:
        ticks.append([await settled(world, target, velocity) for target in (distance, 0.0, distance)])

    assert run(tmp_path, three_moves) == []
    (line,) = run(tmp_path, three_moves)
    assert (line["event"], line["axis"], line["moves"]) == (RESTORED, "x", 3)
    before, after = ticks
    assert before[0] >= before[2] + gained
    assert after[0] == pytest.approx(before[2], abs=1)
    assert after[1:] == pytest.approx([before[2]] * 2, abs=1)


@pytest.mark.long
@pytest.mark.parametrize("memory", ["moves", "none"])
def test_without_being_asked_for_nothing_is_written_or_read(tmp_path: Path, memory: str) -> None:
    run(tmp_path, one_move)
    written = only_file(tmp_path).read_bytes()

    async def script(world: World) -> None:
        assert moves(world) == 0
        await one_move(world)
        assert only_file(tmp_path).read_bytes() == written

    assert run(tmp_path, script, *OFF_THE_MODEL, f"axis.law.memory={memory}") == []


def test_it_is_written_when_a_move_has_taught_something_and_not_every_tick(tmp_path: Path) -> None:
    written: list[int] = []

    async def script(world: World) -> None:
        for target in (400.0, 0.0):
            world.axis.move_to(target, 100.0)
            await world.until(lambda: world.state() is State.HOLDING)
            await world.seconds(1.0)
            written.append(json.loads(only_file(tmp_path).read_text("utf-8"))["learned"]["moves"])

    counted: list[Path] = []

    async def counting(world: World) -> None:
        def write(path: Path, _: object) -> None:
            counted.append(path)

        memory = LawMemory(world.loop.parts.axis_loops, LearnedFiles(tmp_path, write))
        world.loop.listen(memory.publish)
        await script(world)

    run(tmp_path, counting)
    assert written == [1, 2]
    assert 2 <= len(counted) <= 4


def test_what_a_move_has_taught_that_the_service_ends_in_is_written_too(tmp_path: Path) -> None:
    async def script(world: World) -> None:
        world.axis.move_to(400.0, 100.0)
        await world.until(lambda: moves(world) == 1)
        assert world.state() is not State.HOLDING

    run(tmp_path, script)
    (line,) = run(tmp_path, nothing)
    assert (line["event"], line["moves"]) == (RESTORED, 1)


def test_a_trip_erases_it(tmp_path: Path) -> None:
    async def script(world: World) -> None:
        await one_move(world)
        assert names(tmp_path) == ["learned-x.json"]
        world.axis.raise_trip(TripCode.STALE_FEEDBACK, "test")
        await world.seconds(0.02)
        assert names(tmp_path) == []

    run(tmp_path, script)
    assert names(tmp_path) == []
    assert run(tmp_path, nothing) == []


def test_a_trip_erases_it_also_while_the_settings_do_not_keep_it(tmp_path: Path) -> None:
    """They may be changed back, and what was learned before the fault would be believed again."""
    run(tmp_path, one_move)

    async def script(world: World) -> None:
        world.axis.raise_trip(TripCode.STALE_FEEDBACK, "test")
        await world.seconds(0.02)
        assert names(tmp_path) == []

    run(tmp_path, script, "axis.law.type=paper")


def test_an_operator_erases_it(tmp_path: Path) -> None:
    async def script(world: World) -> None:
        await one_move(world)
        world.requests.handle(ForgetRequest())
        await world.seconds(0.02)
        assert names(tmp_path) == []

    run(tmp_path, script)
    assert run(tmp_path, nothing) == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (("axis.plant.gain=185",), "configured_gain was 180.0 and is 185.0"),
        (("axis.plant.pole=14.5",), "configured_pole was 14.0 and is 14.5"),
        (("service.tick_ms=8",), "tick_ms was 10.0 and is 8.0"),
    ],
)
def test_what_was_learned_of_another_plant_or_tick_is_not_believed(
    tmp_path: Path, overrides: tuple[str, ...], told: str
) -> None:
    run(tmp_path, one_move)

    async def script(world: World) -> None:
        assert moves(world) == 0

    (line,) = run(tmp_path, script, *KEPT, *overrides)
    assert (line["event"], line["log_level"], line["axis"]) == (IGNORED, "warning", "x")
    assert told in line["error"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"unit": "deg"}, "unit was 'deg' and is 'mm'"),
        ({"effort_unit": "A"}, "effort_unit was 'A' and is 'V'"),
        ({"axis": "y"}, "axis was 'y' and is 'x'"),
        ({"law": "paper"}, "law was 'paper' and is 'adaptive'"),
        ({"format": 2}, "format was 2 and is 1"),
        ({"gain": 500.0}, "gain is 2.77778 times the configured one, and must be 0.6 to 1.65 times that"),
        ({"gain": float("nan")}, "NaN is no number of JSON"),
        ({"gain": 10**400}, "too large"),
        ({"gain": True}, "learned: gain: True is of another type"),
        ({"gain": "225"}, "of another type"),
        ({"pole": -11.2}, "pole is -0.8 times"),
        ({"gain_share": 0.0}, "gain_share is 0, and must be from 0.01 to 0.17"),
        ({"load": [0.0]}, "load has 1 values, and must have 2"),
        ({"load": [1e9, None]}, "load is 1e+09, and must be from -24 to 24"),
        ({"delay_ticks": 7}, "delay_ticks is 7, and must be from 0 to 1"),
        ({"moves": 0}, "moves is 0, and must be from 1"),
        ({"moves": 1.5}, "of another type"),
        ({"learned": None}, "learned: LearnedPlant: an object is needed"),
    ],
)
def test_a_file_is_believed_no_more_than_identification_itself(
    tmp_path: Path, changed: dict[str, Any], told: str
) -> None:
    run(tmp_path, one_move)
    edited(only_file(tmp_path), **changed)

    async def script(world: World) -> None:
        assert moves(world) == 0
        assert await settled(world, 400.0) > 0

    (line,) = run(tmp_path, script)
    assert (line["event"], line["log_level"]) == (IGNORED, "warning")
    assert told in line["error"]
    (line,) = run(tmp_path, nothing)  # the move has replaced it
    assert line["event"] == RESTORED


@pytest.mark.long
@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_torn_file_is_not_believed(tmp_path: Path, share: float) -> None:
    run(tmp_path, one_move)
    file = only_file(tmp_path)
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    (line,) = run(tmp_path, nothing)
    assert (line["event"], line["log_level"]) == (IGNORED, "warning")


def test_a_folder_that_cannot_be_written_is_told_once_and_the_service_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    folder.write_text("a file where the folder should be", "utf-8")

    async def script(world: World) -> None:
        for target in (100.0, 0.0, 100.0):
            await settled(world, target)
        assert moves(world) == 3
        world.axis.raise_trip(TripCode.STALE_FEEDBACK, "test")
        await world.seconds(0.1)
        assert world.service.statistics.missed == 0

    (line,) = run(folder, script)
    assert (line["event"], line["log_level"], line["folder"]) == (UNWRITABLE, "warning", str(folder))


@pytest.mark.long
@pytest.mark.parametrize(("key", "moves_after"), [("cruise_velocity = 100.0", 1), ("pole = 14.0  ", 0)])
def test_a_configuration_that_is_read_again_keeps_the_file_and_a_trip_then_erases_it(
    tmp_path: Path, key: str, moves_after: int
) -> None:
    config, folder = tmp_path / "axis.toml", tmp_path / "state"
    config.write_text(DEMO.replace(LAW_OF_THE_DEMO, '[axis.law]\ntype = "adaptive"\nmemory = "file"\n'), "utf-8")

    async def script(world: World) -> None:
        await one_move(world)
        world.axis.disarm()
        await world.seconds(0.1)
        world.prepare = reloading(world, config)
        change(config, key, key.replace("0.0", "1.0").replace("4.0", "4.5"))
        await world.reload()
        await world.seconds(0.1)
        assert moves(world) == moves_after
        assert names(folder) == ["learned-x.json"]
        world.axis.raise_trip(TripCode.DRIVE_NOT_DISABLED, "test")
        await world.seconds(0.02)
        assert names(folder) == []

    assert run(folder, script) == []


def test_two_axes_keep_what_is_their_own(tmp_path: Path) -> None:
    law = '[axis.law]\ntype = "adaptive"\nmemory = "file"\n'
    page = DEMO.replace(LAW_OF_THE_DEMO, law)
    assert page != DEMO
    pages = {"x": axis_page("x", "can0", page=page), "y": axis_page("y", "can1", page=page)}
    head, _, simulation = pages["y"].partition("[simulation]")
    pages["y"] = head + "[simulation]" + simulation.replace("gain = 180.0", "gain = 225.0")
    assert "gain = 225.0" in pages["y"]
    machine, folder = machine_file(tmp_path, pages), tmp_path / "learned"
    gains: list[dict[str, float]] = []

    def learned(plant: Plant) -> dict[str, float]:
        found = {name: plant.axis(name).learned for name in pages}
        return {name: one.gain for name, one in found.items() if one is not None and one.moves}

    async def script(plant: Plant) -> None:
        memory, files = kept_in(folder, plant.loop)
        gains.append(learned(plant))
        await plant.armed()
        if not gains[0]:
            plant.ask(op="move", positions={"x": 100.0, "y": 100.0})
            await plant.until(lambda: set(plant.states()) == {State.HOLDING})
            gains.append(learned(plant))
        else:
            plant.axis("x").raise_trip(TripCode.STALE_FEEDBACK, "test")
            await asyncio.sleep(0.02)
        memory.finish()
        await files.close()

    operate(machine, script)
    assert {one.name for one in folder.iterdir()} == {"learned-x.json", "learned-y.json"}
    before = gains[-1]
    assert before["x"] == pytest.approx(180.0, rel=0.02)
    assert before["y"] == pytest.approx(225.0, rel=0.02)
    gains.clear()
    gains.append(before)
    operate(machine, script)
    assert gains[1] == before
    assert {one.name for one in folder.iterdir()} == {"learned-y.json"}


def asking(world: World, memory: LawMemory) -> Callable[[], Awaitable[dict[str, Any]]]:
    """Return what asks the service to forget, as a client of its socket does."""
    handler = build_requests(world.parts, Runtime(world.ticks), erase_learned=memory.erase)

    async def ask() -> dict[str, Any]:
        client = Client(arrived_after_s=asyncio.get_running_loop().time())
        reply = await handler.prepare(ForgetRequest(), client) or handler.answer(ForgetRequest(), client)
        answer: dict[str, Any] = json.loads(b"".join(reply.pieces))
        return answer

    return ask


def read_only(*_: object, **__: object) -> None:
    raise OSError(errno.EROFS, "Read-only file system")


def test_who_forgets_is_told_when_the_file_has_gone(tmp_path: Path) -> None:
    async def script(world: World) -> None:
        memory, files = kept_in(tmp_path, world.loop)
        await world.armed()
        await one_move(world)
        answer = await asking(world, memory)()
        assert (names(tmp_path), moves(world)) == ([], 0)
        assert answer["law"] == {
            "type": "adaptive", "identified": None, "accepted": None, "rejection": None, "file_error": None,
        }  # fmt: skip
        await world.seconds(0.1)
        memory.finish()
        await files.close()
        assert names(tmp_path) == []

    simulate(script, *KEPT)


async def forgets(world: World, ask: Callable[[], Awaitable[dict[str, Any]]]) -> None:
    await ask()


async def trips(world: World, _: Callable[[], Awaitable[dict[str, Any]]]) -> None:
    world.axis.raise_trip(TripCode.STALE_FEEDBACK, "test")
    await world.seconds(0.02)


@pytest.mark.long
@pytest.mark.parametrize("what", [forgets, trips])
@pytest.mark.parametrize("is_marked", [True, False])
def test_a_file_that_cannot_be_erased_is_told_and_is_not_used_again_where_it_can_be_marked(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    what: Callable[[World, Callable[[], Awaitable[dict[str, Any]]]], Awaitable[None]],
    is_marked: bool,
) -> None:
    run(tmp_path, one_move)
    file = only_file(tmp_path)

    async def script(world: World) -> None:
        memory, files = kept_in(tmp_path, world.loop)
        await world.armed()
        assert moves(world) == 1
        await what(world, asking(world, memory))
        assert moves(world) == 0
        (told,) = [line for line in describe(Status.from_json(world.loop.snapshot())).splitlines() if "erased" in line]
        assert told.startswith(f"file of the law  {file} cannot be erased ([Errno 30] Read-only file system")
        assert told.endswith("is not used any more: remove it" if is_marked else "would use it: remove it before")
        memory.finish()
        await files.close()

    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", read_only)
        if not is_marked:
            patch.setattr(Path, "touch", read_only)
        simulate(script, *KEPT)
    (line,) = run(tmp_path, nothing)
    assert line["event"] == (IGNORED if is_marked else RESTORED)


def test_forget_is_refused_where_the_next_start_would_use_the_file_though_the_law_has_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path, one_move)

    async def script(world: World) -> None:
        memory, files = kept_in(tmp_path, world.loop)
        await world.armed()
        ask = asking(world, memory)
        with monkeypatch.context() as patch:
            patch.setattr(os, "unlink", read_only)
            patch.setattr(Path, "touch", read_only)
            error = (await ask())["error"]
        assert (error["code"], moves(world)) == ("not_erased", 0)
        assert error["message"].startswith(f"the law has forgotten, but {tmp_path}/learned-x.json cannot be erased")
        assert (await ask())["ok"]
        assert names(tmp_path) == []
        await files.close()

    simulate(script, *KEPT)


def test_a_disk_that_hangs_keeps_no_answer_and_the_law_has_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path, one_move)

    async def script(world: World) -> None:
        memory, files = kept_in(tmp_path, world.loop)
        await world.armed()
        hanging = asyncio.get_running_loop().create_future()
        with monkeypatch.context() as patch:
            patch.setattr(asyncio.get_running_loop(), "run_in_executor", lambda *_: hanging)
            error = (await asking(world, memory)())["error"]
        assert (error["code"], moves(world)) == ("not_erased", 0)
        assert "the disk does not respond" in error["message"]
        hanging.set_result(None)
        await world.seconds(0.1)
        assert world.report["law"]["file_error"] is None
        await files.close()

    simulate(script, *KEPT)
