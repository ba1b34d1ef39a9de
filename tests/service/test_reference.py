"""A drive that is switched off and on beside a running service: its positions are right, or nobody trusts them."""

import asyncio
from pathlib import Path
from typing import Any

import can
import pytest
import structlog

from tests.service.rig import World, simulate
from tests.service.test_several_axes import Plant, axis_page, machine_file, operate
from twostage_servo.api.request_reading import read_request
from twostage_servo.api.status import Status
from twostage_servo.axis.reference import ReferenceSource
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.canbus.link import BusSettings, LinkError
from twostage_servo.cli.axis_text import describe
from twostage_servo.simulation.bus import Wire

REQUIRED = "axis.homing.required=true"
NO_HEARTBEAT = (
    "protocol.heartbeat.message=false", "protocol.heartbeat.state=false", "protocol.heartbeat.boot_counter=false",
)  # fmt: skip
LONG = pytest.mark.long
PLACE = 300.0


async def at_its_place(world: World, doing: str) -> None:
    """Bring a homed axis to where its encoder counts so much, and let it do something there."""
    await world.until(lambda: world.axis.ready_to_arm)
    await world.seconds(0.3)  # a heartbeat
    world.axis.set_position(world.drive.position)
    await world.armed()
    world.axis.move_to(PLACE if doing != "moving" else 2.0 * PLACE, 200.0)
    if doing == "moving":
        await world.until(lambda: world.drive.position > PLACE)
        return
    await world.until(lambda: world.state() is State.HOLDING)
    if doing == "disarmed":
        world.axis.disarm()
        await world.until(lambda: world.axis.ready_to_arm)


async def never_moves_wrongly(world: World, zero: float) -> None:
    """Reset and arm as an operator does, ask for a set-point, and see whether the axis then is where it says."""
    if world.axis.trip is not None:
        await world.until(lambda: world.state() is State.TRIPPED)
        world.axis.reset()
    await world.armed()
    with pytest.raises(Refused, match=r"does not know its position \(.+\): `home` it first"):
        world.axis.move_to(0.0, 100.0)
    world.axis.set_position(40.0)
    world.axis.move_to(50.0, 100.0)
    await world.until(lambda: world.state() is State.HOLDING)
    assert world.drive.position == pytest.approx(zero + 10.0, abs=0.2)


@pytest.mark.parametrize("doing", ["disarmed", pytest.param("holding", marks=LONG), "moving"])
@pytest.mark.parametrize("off_s", [0.015, pytest.param(0.2, marks=LONG), 2.0])
@pytest.mark.parametrize("told_by", ["a boot counter", "an old boot counter", "no heartbeat"])
def test_a_drive_that_was_off_is_never_taken_for_the_one_before(doing: str, off_s: float, told_by: str) -> None:
    async def script(world: World) -> None:
        await at_its_place(world, doing)
        world.drive.reboot(asyncio.get_running_loop().time(), off_s, counts=told_by == "a boot counter")
        await world.seconds(off_s + 1.5)
        shown = world.loop.snapshot()["axis"]
        assert (shown["referenced"], shown["reference"]) == (False, None)
        assert shown["reference_lost"]
        await never_moves_wrongly(world, world.drive.position)

    simulate(script, REQUIRED, *(NO_HEARTBEAT if told_by == "no heartbeat" else ()))


def suspend(world: World, stage: str, suspended_s: float) -> None:
    """Let the service stand still between two ticks, or in the next one before it reads."""
    if stage == "between two ticks":
        world.ticks.hold_s = suspended_s
    else:
        world.ticks.late_s = suspended_s


@pytest.mark.parametrize("stage", ["between two ticks", "in a tick"])
@pytest.mark.parametrize("suspended_s", [0.05, pytest.param(0.2, marks=LONG), 1.0, pytest.param(5.0, marks=LONG)])
@pytest.mark.parametrize("velocity", [pytest.param(20.0, marks=LONG), 100.0, 250.0])
def test_a_service_that_was_suspended_in_a_move_keeps_its_reference_where_the_axis_only_coasted(
    stage: str, suspended_s: float, velocity: float
) -> None:
    """The first sample after it may answer the last command before it; the drive's own time-out has ended the move."""

    async def script(world: World) -> None:
        await at_its_place(world, "holding")
        world.axis.move_to(2.0 * PLACE, velocity)
        await world.seconds(0.7)
        suspend(world, stage, suspended_s)
        await world.seconds(suspended_s + 1.5)
        assert world.state() is State.TRIPPED
        assert world.axis.reference.lost_because == ""
        assert world.axis.reference.source is ReferenceSource.HOMED
        assert world.axis.drive.position == pytest.approx(world.drive.position, abs=0.01)

    simulate(script, REQUIRED)


@pytest.mark.parametrize("stage", ["between two ticks", "in a tick"])
@pytest.mark.parametrize("suspended_s", [0.05, 1.0])
@pytest.mark.parametrize("off_s", [0.015, 0.2])
@pytest.mark.parametrize("told_by", ["a boot counter", pytest.param("an old boot counter", marks=LONG), "no heartbeat"])
def test_a_drive_that_was_off_while_the_service_was_suspended_is_not_taken_for_the_one_before(
    stage: str, suspended_s: float, off_s: float, told_by: str
) -> None:
    async def script(world: World) -> None:
        await at_its_place(world, "moving")
        suspend(world, stage, suspended_s)
        await world.seconds(0.03)
        world.drive.reboot(asyncio.get_running_loop().time(), off_s, counts=told_by == "a boot counter")
        await world.seconds(suspended_s + off_s + 1.5)
        assert world.axis.reference.source is None
        await never_moves_wrongly(world, world.drive.position)

    simulate(script, REQUIRED, *(NO_HEARTBEAT if told_by == "no heartbeat" else ()))


@pytest.mark.parametrize("heartbeat", [True, False])
@pytest.mark.parametrize("restarted", [True, False])
@pytest.mark.parametrize("away_s", [0.0, 0.4])
def test_across_a_lost_bus(away_s: float, *, heartbeat: bool, restarted: bool) -> None:
    """A cable that was pulled costs a homing only where nothing proves that the drive was not off meanwhile."""
    back_s = 0.0

    def opener(wire: Wire) -> can.BusABC:
        if asyncio.get_running_loop().time() < back_s:
            raise OSError("no such device")
        return wire.attach("service")

    async def script(world: World) -> None:
        nonlocal back_s
        await at_its_place(world, "disarmed")
        now_s = asyncio.get_running_loop().time()
        back_s = now_s + away_s
        world.axis_loop.bus._lose(LinkError("the cable was pulled"))
        if restarted:
            world.drive.reboot(now_s, 0.1)
        await world.seconds(away_s)
        await world.until(lambda: world.axis.ready_to_arm)
        await world.seconds(0.3)
        assert world.axis.referenced is (not restarted and (heartbeat or away_s == 0.0))
        if not world.axis.referenced:
            await never_moves_wrongly(world, world.drive.position)

    bus = BusSettings(interface="socketcan", channel="can0", reopen_interval_ms=50.0)
    simulate(script, REQUIRED, *(() if heartbeat else NO_HEARTBEAT), bus=bus, opener=opener)


@pytest.mark.parametrize("counts", [True, False])
def test_of_several_axes_on_a_bus_the_one_whose_drive_was_off_loses_its_place(tmp_path: Path, *, counts: bool) -> None:
    async def script(plant: Plant) -> None:
        await plant.armed()
        for name in ("x", "y"):
            plant.ask(op="home", axis=name, position=0.0)
            plant.ask(op="move", axis=name, position=PLACE, velocity=200.0)
        await plant.until(lambda: set(plant.states()) == {State.HOLDING} and plant.drives["y"].position > 299.0)
        plant.ask(op="disarm")
        await plant.until(lambda: all(axis_loop.axis.ready_to_arm for axis_loop in plant.service.axis_loops))
        plant.drives["y"].reboot(asyncio.get_running_loop().time(), 0.2, counts=counts)
        await plant.until(lambda: not plant.axis("y").referenced)
        shown = plant.loop.snapshot()["axes"]
        assert [shown[name]["axis"]["reference"] for name in ("x", "y")] == ["homed", None]

    operate(machine_file(tmp_path, {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1)}), script)


def test_the_log_says_on_what_positions_rest_and_why_no_longer() -> None:
    async def script(world: World) -> list[dict[str, Any]]:
        with structlog.testing.capture_logs() as lines:
            await world.until(lambda: world.axis.ready_to_arm)
            world.axis.set_position(50.0)
            await world.seconds(0.2)
            world.drive.reboot(asyncio.get_running_loop().time(), 0.2)
            await world.seconds(0.5)
        return [line for line in lines if "position" in line["event"]]  # type: ignore[misc]

    told = [(line["event"], line.get("reason")) for line in simulate(script)]
    begins, known, lost = told
    assert begins[0].startswith("positions are the encoder's own: a reference that was set before")
    assert known == ("the position is known", None)
    assert lost == (
        "the position is no longer known: home the axis",
        "the drive has rebooted, and its encoder has restarted its count",
    )


def test_a_service_that_starts_again_says_that_a_place_is_no_longer_known() -> None:
    """Without `axis.homing.required` moves are taken as before; on what they rest is told."""

    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        shown = world.loop.snapshot()["axis"]
        assert (shown["referenced"], shown["reference"], shown["reference_lost"]) == (True, "encoder", None)
        world.axis.set_position(500.0)
        shown = world.loop.snapshot()["axis"]
        assert (shown["referenced"], shown["reference"], shown["reference_lost"]) == (True, "homed", None)
        world.axis.set_position(0.0)
        assert world.axis.reference.source is ReferenceSource.HOMED

    simulate(script)


def test_status_says_on_what_positions_rest() -> None:
    def told(world: World) -> str:
        (line,) = [
            line
            for line in describe(Status.from_json(world.loop.snapshot())).splitlines()
            if line.startswith("positions ")
        ]
        return line.removeprefix("positions").strip()

    async def script(world: World) -> None:
        assert told(world).endswith("has not been homed since the service started; no fresh feedback at present")
        await world.until(lambda: world.axis.ready_to_arm)
        assert told(world) == "as counted by the encoder; the axis has not been homed since the service started"
        world.axis.set_position(50.0)
        assert told(world) == "homed"
        world.drive.reboot(asyncio.get_running_loop().time(), 0.2)
        await world.seconds(0.1)
        assert told(world) == "homed; no fresh feedback at present"
        await world.seconds(0.3)
        assert told(world) == "not known: the drive has rebooted, and its encoder has restarted its count"

    simulate(script)


@pytest.mark.parametrize("place", [3000.0, 1e9, -2520.0, 2520.0])
@pytest.mark.parametrize("armed", [True, False])
def test_a_place_outside_the_limits_is_refused_with_the_numbers(place: float, *, armed: bool) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        if armed:
            await world.armed()
        request = read_request({"op": "home", "position": place})
        with pytest.raises(Refused, match="-2500 to 2500 mm and an overrun of 20 mm") as refused:
            world.requests.handle(request)
        assert refused.value.code == "position_limit"
        await world.seconds(0.5)
        assert (world.axis.trip, world.axis.reference.source) == (None, ReferenceSource.ENCODER)

    simulate(script)


def test_a_reference_outside_the_limits_by_default_is_refused_when_it_is_taken() -> None:
    """The reference is at 0 by default, which need not lie within the limits: then the operator tells the place."""

    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        with pytest.raises(Refused, match="cannot stand at 0 mm"):
            world.axis.home()
        world.axis.set_position(150.0)
        await world.armed()
        await world.seconds(0.3)
        assert world.state() is State.HOLDING

    simulate(script, REQUIRED, "axis.limits.position_minimum=100.0")
