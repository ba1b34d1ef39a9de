"""The speed override over the control socket and over frames: who may change it, and what it does."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from tests.service.operators import connect, serve
from tests.service.rig import World
from tests.service.test_several_axes import Plant, axis_page, machine_file, operate
from twostage_servo.axis.state import State
from twostage_servo.client.asynchronous import connect_async
from twostage_servo.service.control_socket import ControlSocket

LAWS = ("paper", "adaptive")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "control.sock"


def told(status: dict[str, Any]) -> tuple[str, float, float]:
    return status["move"]["outcome"], status["axis"]["override_percent"], status["axis"]["target"]


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_a_move_is_slowed_down_held_and_goes_on_to_its_set_point(path: Path, law: str) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="move", position=300.0, velocity=100.0)
        await world.seconds(1.0)
        assert told(await operator.done(op="override", percent=20)) == ("moving", 20.0, 300.0)
        await world.seconds(1.5)
        assert world.axis.estimate.velocity == pytest.approx(20.0, rel=0.1)
        await operator.done(op="override", percent=0)
        await world.seconds(1.0)
        place = world.drive.position
        await world.seconds(60.0)
        assert told(await operator.done(op="status")) == ("moving", 0.0, 300.0)
        assert world.drive.position == pytest.approx(place, abs=0.05)
        await operator.done(op="override", percent=150)
        await world.until(lambda: world.state() is State.HOLDING)
        assert told(await operator.done(op="status")) == ("reached", 150.0, 300.0)
        assert world.drive.position == pytest.approx(300.0, abs=0.5)
        assert world.axis.trip is None

    serve(path, script, f"axis.law.type={law}")


@pytest.mark.parametrize("law", LAWS)
def test_a_jog_that_is_renewed_follows_it(path: Path, law: str) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        for percent, velocity in ((100.0, 50.0), (40.0, 20.0), (0.0, 0.0), (200.0, 100.0)):
            if percent != 100.0:
                await operator.done(op="override", percent=percent)
            for _renewal in range(20):
                await operator.done(op="jog", velocity=50.0)
                await world.seconds(0.1)
            assert world.state() is State.JOGGING
            assert world.axis.estimate.velocity == pytest.approx(velocity, rel=0.1, abs=0.2)
        await world.until(lambda: world.state() is State.HOLDING)
        assert world.axis.trip is None

    serve(path, script, f"axis.law.type={law}")


def test_only_who_commands_changes_it_and_it_outlasts_the_one_who_did(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        first, second = await connect(path), await connect(path)
        assert await first.refused(op="override", percent=50) == "disarmed"
        assert (await first.done(op="status"))["authority"] == {"holder": None}
        await first.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        assert await second.refused(op="override", percent=50) == "authority_held"
        await first.done(op="override", percent=50)
        assert (await first.done(op="release"))["axis"]["override_percent"] == 50.0
        first.die()
        await world.seconds(0.1)
        await second.done(op="move", position=200.0, velocity=100.0)
        await world.seconds(2.0)
        assert world.axis.estimate.velocity == pytest.approx(50.0, rel=0.1)
        await second.done(op="disarm")
        await world.until(lambda: world.axis.ready_to_arm)
        assert (await second.done(op="arm"))["axis"]["override_percent"] == 100.0

    serve(path, script)


def test_who_waits_for_a_move_waits_while_it_is_held(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        async with connect_async(path) as axis:
            await axis.arm()
            await axis.move(100.0)
            await axis.override(0.0)
            waiting = asyncio.ensure_future(axis.wait_until_reached())
            await world.seconds(30.0)
            assert not waiting.done()
        async with connect_async(path) as other:
            await other.override(100.0)
            status = await waiting
        assert status.move is not None
        assert status.move.outcome == "reached"
        assert world.drive.position == pytest.approx(100.0, abs=0.5)

    serve(path, script)


def test_each_axis_has_its_own_and_without_a_name_all_that_are_armed_take_it(tmp_path: Path) -> None:
    machine = machine_file(tmp_path, {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1)})

    async def script(plant: Plant) -> None:
        x, y = plant.axis("x"), plant.axis("y")
        await plant.armed()
        plant.ask(op="override", axis="x", percent=50)
        assert (x.override_percent, y.override_percent) == (50.0, 100.0)
        plant.ask(op="move", positions={"x": 200.0, "y": 200.0}, velocity=100.0)
        await asyncio.sleep(2.0)
        for axis in (x, y):  # which arrive together
            assert axis.estimate.velocity == pytest.approx(50.0, rel=0.1)
        plant.ask(op="override", percent=0)
        await asyncio.sleep(1.0)
        assert abs(x.estimate.velocity) + abs(y.estimate.velocity) < 0.5
        plant.ask(op="disarm", axis="x")
        await plant.until(lambda: x.ready_to_arm)
        plant.ask(op="override", percent=100)
        assert (x.override_percent, y.override_percent) == (100.0, 100.0)
        await plant.until(lambda: y.state is State.HOLDING)
        assert plant.drives["y"].position == pytest.approx(200.0, abs=0.5)

    operate(machine, script)
