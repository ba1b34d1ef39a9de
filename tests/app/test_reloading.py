"""`reload` as an operator sees it: prepared outside the loop, swapped in within one tick."""

import asyncio
import dataclasses
import pickle
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import structlog

from tests.demo_file import DEMO, LAW_OF_THE_DEMO
from tests.laws_of_others import cascade
from tests.service.rig import World, simulate
from tests.service.test_reload import change
from twostage_servo.api.requests import ReloadRequest
from twostage_servo.app import assembly
from twostage_servo.app import reloading as module
from twostage_servo.app.assembly import design
from twostage_servo.app.axes_preparation import Job, Prepared, prepare
from twostage_servo.app.build import traits_of
from twostage_servo.app.reloading import ReadingError, Reloading, by_a_process
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import State
from twostage_servo.client.asynchronous import connect_async
from twostage_servo.config.loader import load
from twostage_servo.config.machine import Machine
from twostage_servo.control.laws.registry import LAWS, LawType
from twostage_servo.control.laws.tracking import TrackingDesign

__all__ = ["cascade"]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "axis.toml"
    path.write_text(DEMO, encoding="utf-8")
    return path


def reloading(world: World, file: Path, carry_out: Callable[[Job], Prepared] = prepare) -> Reloading:
    parts = dataclasses.replace(world.parts, machine=Machine.of(load(file)))
    return Reloading(parts, file, (), carry_out)


@pytest.mark.parametrize("law", ["paper", "adaptive"])
def test_a_process_of_its_own_does_the_same_as_this_one(file: Path, law: str) -> None:
    change(file, LAW_OF_THE_DEMO, f'[axis.law]\ntype = "{law}"\n')

    async def script(world: World) -> tuple[Prepared, Prepared]:
        job = Job(
            file,
            ("axis.cruise_velocity=40.0",),
            pickle.dumps(Machine.of(load(file))),
            traits_of(world.service.axis_loops),
            0.01,
        )
        return by_a_process(job), prepare(job)

    apart, here = simulate(script)
    assert apart.problem is None
    assert apart.source == here.source
    one, other = (pickle.loads(prepared.designs[0] or b"") for prepared in (apart, here))  # noqa: S301 - made here
    assert isinstance(one, AxisDesign)
    assert one.settings.cruise_velocity == 40.0
    assert one.settings.law.type == law
    assert one == other


def test_a_file_that_is_wrong_is_told_by_the_process(file: Path) -> None:
    async def script(world: World) -> Prepared:
        job = Job(file, (), pickle.dumps(Machine.of(load(file))), traits_of(world.service.axis_loops), 0.01)
        change(file, 'unit = "mm"', 'unit = "deg"')
        return by_a_process(job)

    problem = simulate(script).problem or ""
    assert "axis.unit" in problem
    assert "restart the service" in problem


def test_a_process_that_fails_changes_nothing(file: Path) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        axis = world.axis
        job = Job(file, (), b"no pickle", traits_of(world.service.axis_loops), 0.01)
        world.prepare = reloading(world, file, lambda _: by_a_process(job)).prepare
        with (
            structlog.testing.capture_logs() as logs,
            pytest.raises(
                Refused, match=r"could not be read again, and nothing has changed: \w+\.UnpicklingError: "
            ) as no,
        ):
            await world.requests.prepare_reload("somebody")
        assert no.value.code is RefusalCode.RELOAD_FAILED
        assert re.search(r"axes_preparation\.py:\d+\)\. The log has more$", str(no.value))
        (line,) = logs
        assert (line["event"], line["log_level"]) == ("the configuration could not be read again", "error")
        assert line["exception"].startswith("Traceback (most recent call last):")
        assert world.axis is axis
        await world.armed()

    simulate(script)


def rewrite(file: Path, law: str) -> None:
    file.write_text(DEMO.replace(LAW_OF_THE_DEMO, law), encoding="utf-8")


@pytest.mark.usefixtures("cascade")
@pytest.mark.parametrize("carry_out", [prepare, by_a_process])
def test_a_design_that_cannot_be_sent_is_made_again_outside_the_loop(
    file: Path, carry_out: Callable[[Job], Prepared], monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of the example of a law: it holds a function that it has made."""
    in_a_turn: list[bool] = []

    async def script(world: World) -> None:
        def noted(*arguments: Any) -> AxisDesign:
            in_a_turn.append(world.parts.background._occupied)
            return design(*arguments)

        monkeypatch.setattr(module, "design", noted)
        await world.until(lambda: world.axis.ready_to_arm)
        world.prepare = reloading(world, file, carry_out).prepare
        for bandwidth in (4.0, 5.0):  # the law of the example takes the place of another one, and of itself
            rewrite(file, f'[axis.law]\ntype = "cascade"\ncascade.bandwidth = {bandwidth}\n')
            await world.reload()
            assert world.axis.design.law.origin() == f"bandwidth {bandwidth:g}/s"
        await world.armed()
        move = world.axis.move_to(20.0, 100.0)
        await world.until(lambda: move.outcome != "moving")
        assert (move.outcome, world.axis.trip) == ("reached", None)

    simulate(script)
    assert in_a_turn == [False, False]


@pytest.mark.usefixtures("cascade")
def test_a_law_that_fails_is_told_with_its_own_error_and_the_file_is_not_blamed(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    change(file, LAW_OF_THE_DEMO, '[axis.law]\ntype = "cascade"\n')

    def broken(*_: Any) -> TrackingDesign:
        raise ZeroDivisionError("no plant without a gain")

    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        world.prepare = reloading(world, file).prepare
        monkeypatch.setitem(LAWS._loaded, "cascade", LawType(LAWS.get("cascade").settings, broken))
        with pytest.raises(Refused, match=r"ZeroDivisionError: no plant without a gain \(.*test_reloading") as refused:
            await world.reload()
        assert refused.value.code is RefusalCode.RELOAD_FAILED

    simulate(script)


def test_the_loop_designs_nothing_and_swaps_all_axes_in_one_turn(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The work that a tick may have to wait for: counted, not timed."""

    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        world.axis.set_position(50.0)
        designed, done = 0, []

        def elsewhere(job: Job) -> Prepared:
            done.append(prepare(job))
            monkeypatch.setattr(assembly, "build_axis", counting)  # from here on it is the loop's
            return done[0]

        def counting(*_: Any) -> Axis:
            nonlocal designed
            designed += 1
            raise AssertionError

        world.prepare = reloading(world, file, elsewhere).prepare
        control = world.loop.control_socket(tmp_path / "control.sock")
        await control.start()
        change(file, "cruise_velocity = 100.0", "cruise_velocity = 40.0")
        async with connect_async(tmp_path / "control.sock") as client:
            await client.reload()
        assert world.axis.settings.cruise_velocity == 40.0
        assert world.state() is State.DISARMED
        assert (designed, len(done)) == (0, 1)
        assert world.service.statistics.missed == 0
        await world.seconds(0.05)
        assert world.loop.snapshot()["axis"]["position"] == 50.0
        await control.stop()

    simulate(script)


def test_while_one_is_prepared_another_is_refused_and_an_axis_that_was_armed_keeps_its_settings(file: Path) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        requests, axis = world.requests, world.axis
        go_on = asyncio.Event()
        usual = reloading(world, file).prepare

        async def slowly() -> Callable[[], None]:
            await go_on.wait()
            return await usual()

        world.prepare = slowly
        first = asyncio.create_task(requests.prepare_reload("first"))
        await world.seconds(0.02)
        with pytest.raises(Refused, match="is reloading the configuration") as refused:
            await requests.prepare_reload("first")
        assert refused.value.code == "busy"
        axis.arm()
        go_on.set()
        await first
        assert requests._reload.is_prepared("first")
        with pytest.raises(Refused, match="settings are read again only while disarmed") as refused:
            world.requests.handle(ReloadRequest(), "first")
        assert refused.value.code == "armed"
        assert world.axis is axis
        assert not requests._reload.is_prepared("first")

    simulate(script)


def test_what_was_read_again_is_compared_with_what_is_read_next(file: Path) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        requests = world.requests
        world.prepare = reloading(world, file).prepare
        for velocity in ("40.0", "60.0"):
            change(
                file,
                "cruise_velocity = " + ("100.0" if velocity == "40.0" else "40.0"),
                f"cruise_velocity = {velocity}",
            )
            await requests.prepare_reload("this process")
            with structlog.testing.capture_logs() as logs:
                world.requests.handle(ReloadRequest())
            assert world.axis.settings.cruise_velocity == float(velocity)
            assert logs == [{"event": "configuration read again", "log_level": "info", "config": str(file)}]
        change(file, 'channel = "twostage-servo-demo"', 'channel = "another"')
        with pytest.raises(Refused, match=r"\[bus\] has changed: restart the service"):
            await requests.prepare_reload("this process")

    simulate(script)


@pytest.fixture
def ending(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """Let the process run a program that fails; return what is said of it."""

    def run_it(program: str) -> str:
        monkeypatch.setattr(module, "_COMMAND", (sys.executable, "-c", program))
        with pytest.raises(ReadingError) as failed:
            by_a_process(Job(None, (), b"", {}, 0.01))
        return str(failed.value)

    return run_it


def test_of_a_process_that_fails_the_last_line_is_told_from_its_beginning(ending: Callable[[str], str]) -> None:
    said = ending(r"import sys; sys.stderr.write('Traceback\nImportError: ' + 'x' * 1000 + '\n\n'); sys.exit(3)")
    assert said.startswith("the process that reads it ended with code 3: ImportError: xxx")
    assert len(said) < 600
    assert ending("import os; os.kill(os.getpid(), 9)").endswith("was ended by signal 9 (Killed)")


def test_the_process_finds_the_modules_and_the_environment_of_this_one(
    ending: Callable[[str], str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("A_SETTING", "kept")
    said = ending("import os, sys; sys.exit(str(sys.path[1] + ' ' + os.environ['A_SETTING']))")
    assert said.endswith(f"code 1: {tmp_path} kept")


def test_a_process_that_takes_too_long_is_ended(ending: Callable[[str], str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LONGEST_S", 0.2)
    assert "had not ended after 0.2 s" in ending("import time; time.sleep(60)")
