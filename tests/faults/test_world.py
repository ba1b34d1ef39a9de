"""The world of a fault by itself: what its clients ask, and the defect that a tick of its service may have."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest

from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.state import State
from twostage_servo.config.machine import load_machine
from twostage_servo.faults.defects import PARTS, Part
from twostage_servo.faults.world import World, operate
from twostage_servo.service.log import open_log
from twostage_servo.timing.virtual_clock import VirtualClockLoop

DEMO = load_machine(None)
TWO_AXES = load_machine(Path("config/two_axes.toml"))


@pytest.fixture(autouse=True)
def _quiet(tmp_path: Path) -> Iterator[None]:
    with (tmp_path / "log").open("w") as nowhere:
        writer = open_log("critical", nowhere)
        yield
        writer.close()


def play(script: Callable[[World], Awaitable[None]], machine: object = DEMO, axis: str | None = None) -> None:
    async def main() -> None:
        async with operate(machine, axis) as world:  # type: ignore[arg-type]
            assert await world.until(lambda: all(one.axis.ready_to_arm for one in world.loop.parts.axis_loops), 3.0)
            await script(world)

    with asyncio.Runner(loop_factory=VirtualClockLoop) as runner:
        runner.run(main())


def test_where_there_are_several_axes_clients_ask_the_one_that_has_the_fault() -> None:
    async def script(world: World) -> None:
        assert world.clients.ask({"op": "arm"}) is None
        assert await world.until(lambda: world.axis.state is State.HOLDING, 3.0)
        assert [one.axis.state for one in world.loop.parts.axis_loops] == [State.DISARMED, State.HOLDING]
        assert world.clients.ask('{"op":"release"}') is None

    play(script, TWO_AXES, TWO_AXES.axes[1].config.axis.name)


@pytest.mark.parametrize("line", ['{"op": "reload"}', '{"op":"reload"}', '{"op" : "reload"} '])
def test_a_request_that_is_about_no_axis_names_none_however_it_is_written(line: str) -> None:
    async def script(world: World) -> None:
        assert world.clients.ask({"op": "arm"}) is None
        assert world.clients.ask(line) != RefusalCode.BAD_REQUEST

    play(script, TWO_AXES)


@pytest.mark.parametrize("line", ["", "{", '{"op": "move", "position": NaN}', '{"op": "move", "position": 1e400}'])
@pytest.mark.parametrize("machine", [DEMO, TWO_AXES])
def test_what_is_no_request_is_refused_as_such(line: str, machine: object) -> None:
    async def script(world: World) -> None:
        assert world.clients.ask(line) == RefusalCode.BAD_REQUEST

    play(script, machine)


@pytest.mark.parametrize("part", PARTS)
def test_a_defect_shows_once_where_it_was_injected_and_the_service_ends_with_it(part: Part) -> None:
    async def script(world: World) -> None:
        assert world.clients.ask({"op": "arm"}) is None
        assert await world.until(lambda: world.axis.state is State.HOLDING, 3.0)
        world.defects.show_in(part)
        await world.until(world.serving.done, 3.0)
        assert str(world.serving.exception()) == f"a defect, injected where the loop is to {part}"
        assert world.axis.state is State.TRIPPED
        assert not world.drive.enabled

    play(script)
