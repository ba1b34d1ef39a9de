"""Reading the configuration again: while disarmed only, whole or not at all."""

from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tests.demo_file import DEMO, LAW_OF_THE_DEMO
from tests.service.rig import World, simulate
from twostage_servo.api.requests import ArmRequest, MoveRequest, ReloadRequest
from twostage_servo.app.assembly import prepare_axes
from twostage_servo.app.build import replace_axes, traits_of
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.loader import load
from twostage_servo.config.machine import Machine
from twostage_servo.drives.dbc.compiler import dbc_digest
from twostage_servo.drives.dbc.drive import DbcDrive
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.drives.protocol_error import ProtocolError
from twostage_servo.service.reload import Change

RELOAD = ReloadRequest()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "axis.toml"
    path.write_text(DEMO, encoding="utf-8")
    return path


def change(file: Path, old: str, new: str) -> None:
    text = file.read_text(encoding="utf-8")
    assert text.count(old) == 1
    file.write_text(text.replace(old, new), encoding="utf-8")


def reloading(world: World, file: Path) -> Callable[[], Awaitable[Change]]:
    running = Machine.of(load(file))

    async def prepare() -> Change:
        parts = world.parts
        axes = prepare_axes(traits_of(parts.axis_loops), running, Machine.of(load(file)), parts.period_s)
        return lambda: replace_axes(parts, axes)

    return prepare


def test_what_has_changed_is_in_force_and_the_axis_stays_disarmed(file: Path) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        world.prepare = reloading(world, file)
        change(file, "cruise_velocity = 100.0", "cruise_velocity = 40.0")
        change(file, "position_maximum = 2500.0", "position_maximum = 60.0")
        answer = await world.reload()
        assert answer["axis"]["state"] == "disarmed"
        await world.seconds(1.0)
        assert world.state() is State.DISARMED
        assert world.loop.snapshot()["axis"]["position"] == 0.0
        world.requests.handle(ArmRequest())
        await world.until(lambda: world.state() is State.HOLDING)
        with pytest.raises(Refused, match="from -2500 to 60 mm"):
            world.requests.handle(MoveRequest(position=61.0))
        assert world.requests.handle(MoveRequest(position=50.0))["move"]["velocity"] == 40.0
        await world.until(lambda: world.axis.move is not None and world.axis.move.outcome == "reached")
        assert world.service.statistics.missed == 0

    simulate(script)


def test_the_place_that_was_given_is_forgotten(file: Path) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        world.axis.set_position(50.0)
        world.prepare = reloading(world, file)
        change(file, "[simulation] ", "[axis.homing]\nrequired = true\n\n[simulation] ")
        await world.reload()
        await world.armed()
        assert world.loop.snapshot()["axis"]["referenced"] is False
        with pytest.raises(Refused, match="`home` it first"):
            world.axis.move_to(1.0, 10.0)

    simulate(script)


@pytest.mark.parametrize("lost", [True, False])
def test_what_is_known_of_the_place_is_neither_lost_nor_given_back(file: Path, *, lost: bool) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        world.axis.set_position(50.0)
        if lost:
            world.axis.reference.lose("a test")
        world.prepare = reloading(world, file)
        change(file, "cruise_velocity = 100.0", "cruise_velocity = 40.0")
        await world.reload()
        await world.seconds(0.05)
        shown = world.loop.snapshot()["axis"]
        assert (shown["position"], shown["referenced"]) == (50.0, not lost)

    simulate(script)


def test_a_drive_that_reboots_is_noticed_across_a_reload(file: Path) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        boots = world.axis.drive.heartbeat.state.boots
        world.prepare = reloading(world, file)
        await world.reload()
        world.axis.record_heartbeat(77)
        assert world.axis.drive.heartbeat.state.boots == boots + 1
        assert not world.axis.referenced

    simulate(script)


@pytest.mark.parametrize("state", [State.ARMING, State.HOLDING, State.SPEED_STAGE, State.DISARMING, State.TRIPPED])
def test_an_axis_that_is_not_disarmed_is_left_as_it_is(state: State) -> None:
    async def script(world: World) -> None:
        called: list[bool] = []

        async def prepare() -> Change:
            called.append(True)
            return lambda: None

        world.prepare = prepare
        axis = world.axis
        if state is State.ARMING:
            await world.until(lambda: axis.ready_to_arm)
            axis.arm()
        elif state is State.HOLDING:
            await world.armed()
        else:
            await world.cruising()
        if state is State.DISARMING:
            axis.disarm()
        elif state is State.TRIPPED:
            world.drive.change(world.service.statistics.uptime_s, fault_code=3)
            await world.until(lambda: axis.state is State.TRIPPED)
        with pytest.raises(Refused, match=f"axis x is {state}") as refused:
            await world.reload()
        assert refused.value.code == "armed"
        assert world.state() is state
        assert (world.axis, called) == (axis, [])

    simulate(script)


@pytest.mark.parametrize(
    ("old", "new", "key", "said"),
    [
        ("cruise_velocity = 100.0 ", "cruise_velocity = 1000.0 ", "axis", "is above limits.velocity"),
        ("pole = 14.0                     # 1/s", "pole = -1.0", "axis.plant.pole", "at least 0.001"),
        (
            LAW_OF_THE_DEMO + "performance_index_ratio = 5.0e-5",
            '[axis.law]\ntype = "paper"\nperformance_index_ratio = 10.0',
            "axis.law.performance_index_ratio",
            "unstable",
        ),
        ("effort = 24.0 ", "effort = 40.0 ", "axis.limits.effort", "carries at most 32"),
        ('effort_unit = "V"', "effort_unit = 5", "axis.effort_unit", "a text"),
        ("tick_ms = 10.0", "tick_ms = 20.0", "service", "restart the"),
        ('channel = "twostage-servo-demo"', 'channel = "another"', "bus", "restart the"),
        ("[simulation] ", '[protocol.feedback]\nsampling = "cyclic"\n\n[simulation] ', "protocol", "restart the"),
        ('unit = "mm"', 'unit = "deg"', "axis.unit", "restart the"),
        ("[axis.limits]", "[axis.limits", "", "not TOML"),
    ],
)  # fmt: skip
def test_a_file_that_is_wrong_or_changes_too_much_is_told_with_line_and_key(
    file: Path, old: str, new: str, key: str, said: str
) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        axis, reload = world.axis, reloading(world, file)
        change(file, old, new)
        with pytest.raises(ConfigError) as error:
            await reload()
        problem = error.value.problems[0]
        assert said in str(error.value)
        assert problem.key == key
        assert world.axis is axis
        lines.append(problem.line or 0)
        await world.armed()

    lines: list[int] = []
    simulate(script)
    assert key.rpartition(".")[2] in file.read_text(encoding="utf-8").split("\n")[lines[0] - 1]


def test_a_dbc_file_that_has_changed_since_the_start_is_told_and_not_passed_over(file: Path) -> None:
    """Its frames were compiled at the start: `reload` said that all was done, and the axis went on at the old scale."""

    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        axis, reload = world.axis, reloading(world, file)
        drive = world.axis_loop.drive
        assert isinstance(drive, DbcDrive)
        drive.traits = replace(drive.traits, digest="of another content")
        with pytest.raises(ConfigError, match="the content of the DBC file has changed: restart the service") as error:
            await reload()
        assert error.value.problems[0].key == "protocol.dbc"
        assert world.axis is axis

    simulate(script)


def test_the_content_of_a_dbc_file_is_known_by_its_digest(tmp_path: Path) -> None:
    dbc = tmp_path / "my.dbc"
    shipped = shipped_configuration("servo_drive.dbc").read_bytes()
    dbc.write_bytes(shipped)
    profile = DriveProfile.compile(ProtocolSettings(dbc="my.dbc"), tmp_path, "mm")
    assert profile.traits.digest == dbc_digest("my.dbc", tmp_path) == dbc_digest("", tmp_path)
    dbc.write_bytes(shipped.replace(b"(0.001,0)", b"(0.01,0)", 1))
    assert profile.traits.digest != dbc_digest("my.dbc", tmp_path)
    with pytest.raises(ProtocolError, match="there is no such file"):
        dbc_digest("gone.dbc", tmp_path)


def test_settings_that_stand_in_no_file_cannot_be_read_again() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        with pytest.raises(Refused) as refused:
            await world.reload()
        assert refused.value.code == "no_configuration"

    simulate(script)
