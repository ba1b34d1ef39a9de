"""Several axes and buses in one service: one tick, moves together, and what one axis' trouble does to the others."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import pytest
import structlog

from tests.demo_file import DEMO
from twostage_servo.api.request_reading import read_request
from twostage_servo.app.assembly import prepare_axes
from twostage_servo.app.build import build_parts, replace_axes, traits_of
from twostage_servo.app.closed_loop import ClosedLoop, Wires, closed_loop
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.messages import Command
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.machine import Machine, load_machine
from twostage_servo.service.request_handler import RequestHandler
from twostage_servo.service.servo_service import ServoService
from twostage_servo.simulation.bus import Wire
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.timing.virtual_clock import run

EXAMPLE_2 = shipped_configuration("example2.toml").read_text(encoding="utf-8")


def axis_page(name: str, channel: str, offset: int = 0, page: str = DEMO) -> str:
    """Return a shipped configuration as that of an axis of another name, on another bus."""
    head, _, rest = page.partition("[bus]")
    _, _, rest = rest.partition("[axis]")
    bus = f'[bus]\ninterface = "socketcan"\nchannel = "{channel}"\nreopen_interval_ms = 50.0\n\n'
    old = next(line for line in rest.splitlines() if line.startswith("name = "))
    return head + bus + f"[protocol]\nidentifier_offset = {offset}\n\n[axis]" + rest.replace(old, f'name = "{name}"')


def machine_file(folder: Path, pages: dict[str, str], machine: str = "") -> Path:
    for name, page in pages.items():
        (folder / f"{name}.toml").write_text(page, encoding="utf-8")
    files = ", ".join(f'"{name}.toml"' for name in pages)
    path = folder / "machine.toml"
    path.write_text(f"[service]\ntick_ms = 10.0\n\n[machine]\naxes = [{files}]\n{machine}", encoding="utf-8")
    return path


@dataclass
class Plant:
    """A service with the drives of all its axes, each bus a wire of its own."""

    loop: ClosedLoop
    wires: dict[str, Wire]

    @property
    def service(self) -> ServoService:
        return self.loop.service

    @property
    def requests(self) -> RequestHandler:
        return self.loop.requests

    @property
    def drives(self) -> dict[str, SimulatedDrive]:
        return {name: one.drive for name, one in self.loop.axes.items()}

    def axis(self, name: str) -> Axis:
        return self.loop.axis_loop(name).axis

    def ask(self, **request: Any) -> dict[str, Any]:
        return self.requests.handle(read_request(request))

    def reload(self, running: Machine, fresh: Machine) -> None:
        parts = self.loop.parts
        replace_axes(parts, prepare_axes(traits_of(parts.axis_loops), running, fresh, parts.period_s))

    def states(self) -> list[State]:
        return [axis_loop.axis.state for axis_loop in self.service.axis_loops]

    async def until(self, condition: Callable[[], bool], longest_s: float = 60.0) -> None:
        for _ in range(round(longest_s / 0.01)):
            if condition():
                return
            await asyncio.sleep(0.01)
        raise AssertionError(f"not within {longest_s} s: {self.states()}")

    async def armed(self) -> None:
        await self.until(lambda: all(axis_loop.axis.ready_to_arm for axis_loop in self.service.axis_loops))
        self.ask(op="arm")
        await self.until(lambda: set(self.states()) == {State.HOLDING})


def operate(path: Path, script: Callable[[Plant], Awaitable[None]], *overrides: str) -> None:
    machine = load_machine(path, overrides)

    async def main() -> None:
        wires = Wires()
        async with closed_loop(machine, wires=wires) as loop:
            by_channel = {str(one.config.bus.channel): wires.wire(one.config.bus) for one in machine.axes}
            await script(Plant(loop, by_channel))

    run(main())


@pytest.fixture
def two_on_one_bus(tmp_path: Path) -> Path:
    return machine_file(tmp_path, {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1)})


@pytest.fixture
def two_buses(tmp_path: Path) -> Path:
    return machine_file(tmp_path, {"x": axis_page("x", "can0"), "y": axis_page("y", "can1", page=EXAMPLE_2)})


def test_each_axis_moves_by_itself_on_a_bus_that_they_share(two_on_one_bus: Path) -> None:
    async def script(plant: Plant) -> None:
        await plant.armed()
        assert len(plant.service.buses) == 1
        plant.ask(op="move", axis="y", position=-30.0)
        await plant.until(lambda: plant.axis("y").state is State.HOLDING)
        assert plant.drives["y"].position == pytest.approx(-30.0, abs=0.05)
        assert plant.drives["x"].position == pytest.approx(0.0, abs=0.01)

    operate(two_on_one_bus, script)


@pytest.mark.parametrize("positions", [{"x": 400.0, "y": -100.0}, {"x": 20.0, "y": 300.0}, {"x": -60.0, "y": 61.0}])
def test_axes_that_move_together_set_out_and_arrive_together(two_buses: Path, positions: dict[str, float]) -> None:
    """On two buses, by two laws of different speed; the later one is as quick as alone."""

    async def script(plant: Plant) -> None:
        await plant.armed()
        service, arrived, truly, begun = plant.service, dict[str, int](), dict[str, int](), dict[str, int]()
        alone = max(plant.axis(name).duration.duration_s(abs(way), 100.0) for name, way in positions.items())
        start = service.statistics.count
        plant.ask(op="move", positions=positions, velocity=100.0)
        window = {name: plant.axis(name).settings.window.position for name in positions}
        while set(plant.states()) != {State.HOLDING}:
            await asyncio.sleep(0.01)
            for name, target in positions.items():
                if abs(plant.drives[name].position) > 0.0:
                    begun.setdefault(name, service.statistics.count)
                designed = plant.axis(name).nominal.position
                if abs(designed - target) > window[name]:
                    arrived[name] = service.statistics.count
                if abs(plant.drives[name].position - target) > window[name]:
                    truly[name] = service.statistics.count
        assert abs(begun["x"] - begun["y"]) <= 1  # the smaller first effort needs a tick more to overcome friction
        assert abs(arrived["x"] - arrived["y"]) <= 6  # the noise of the encoder at the change-over
        assert max(arrived.values()) - start == pytest.approx(100.0 * alone, abs=6.0)
        assert abs(truly["x"] - truly["y"]) <= 25  # friction and other gains than the model's

    operate(two_buses, script)


@pytest.mark.parametrize(("asked", "fastest"), [({"velocity": 20.0}, 20.0), ({}, 100.0)])
def test_no_axis_of_a_move_is_faster_than_was_asked_or_than_its_own_cruise_velocity(
    two_on_one_bus: Path, asked: dict[str, float], fastest: float
) -> None:
    async def script(plant: Plant) -> None:
        await plant.armed()
        plant.ask(op="move", positions={"x": 100.0, "y": 400.0}, **asked)
        moves = [plant.axis(name).move for name in "xy"]
        assert [move.target for move in moves if move is not None] == [100.0, 400.0]
        slow, quick = (move.velocity for move in moves if move is not None)
        assert quick == pytest.approx(fastest)
        assert 0.15 * fastest < slow < 0.35 * fastest  # a quarter of the way

    operate(two_on_one_bus, script)


def test_a_move_of_several_axes_is_carried_out_whole_or_not_at_all(two_on_one_bus: Path) -> None:
    async def script(plant: Plant) -> None:
        await plant.armed()
        for wrong, code in (({"x": 10.0, "y": 1e6}, "position_limit"), ({"x": 10.0, "z": 1.0}, "which_axis")):
            with pytest.raises(Refused) as refused:
                plant.ask(op="move", positions=wrong)
            assert refused.value.code == code
            assert set(plant.states()) == {State.HOLDING}

    operate(two_on_one_bus, script)


@pytest.mark.parametrize(
    ("request_", "code", "says"),
    [
        ({"op": "arm"}, "already_armed", "axis y: the axis is armed already"),
        ({"op": "move", "positions": {"x": 1.0, "y": 1.0}}, "disarmed", "axis x: the axis is disarmed"),
        ({"op": "move", "axis": "x", "position": 1.0}, "disarmed", "axis x: the axis is disarmed"),
        ({"op": "move", "positions": {"y": 1e6}}, "position_limit", "axis y: set-point"),
        ({"op": "jog", "axis": "x", "velocity": 1.0}, "disarmed", "axis x: the axis is disarmed"),
        ({"op": "home", "axis": "y", "position": 1e6}, "position_limit", "axis y: the axis cannot stand"),
        ({"op": "stop", "axis": "x"}, "disarmed", "axis x: the axis is disarmed"),
        ({"op": "reset", "axis": "y"}, "not_tripped", "axis y: the axis is holding"),
    ],
)
def test_a_refusal_names_the_axis(two_on_one_bus: Path, request_: dict[str, Any], code: str, says: str) -> None:
    async def script(plant: Plant) -> None:
        await plant.armed()
        plant.axis("x").disarm()
        await asyncio.sleep(0.1)
        with pytest.raises(Refused, match=says) as refused:
            plant.ask(**request_)
        assert refused.value.code == code

    operate(two_on_one_bus, script)


def test_arming_all_is_arming_all_or_none(two_on_one_bus: Path) -> None:
    async def script(plant: Plant) -> None:
        await plant.until(lambda: plant.axis("x").ready_to_arm)
        await plant.until(lambda: plant.axis("y").ready_to_arm)
        plant.drives["y"].change(asyncio.get_running_loop().time(), safe_torque_off=True)
        await asyncio.sleep(0.1)
        with pytest.raises(Refused, match="safe torque off"):
            plant.ask(op="arm")
        assert set(plant.states()) == {State.DISARMED}
        plant.ask(op="arm", axis="x")
        await plant.until(lambda: plant.axis("x").state is State.HOLDING)

    operate(two_on_one_bus, script)


@pytest.mark.parametrize(
    ("reaction", "after"),
    [
        ("continue", State.SPEED_STAGE),
        ("stop", State.HOLDING),
        ("quick_stop", State.HOLDING),
        ("disarm", State.DISARMED),
    ],
)
def test_when_one_trips_the_others_do_as_the_machine_says(tmp_path: Path, reaction: str, after: State) -> None:
    pages = {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1)}
    path = machine_file(tmp_path, pages, f'fault_reaction = "{reaction}"\n')

    async def script(plant: Plant) -> None:
        await plant.armed()
        plant.ask(op="move", positions={"x": 400.0, "y": 400.0})
        await asyncio.sleep(1.5)
        plant.axis("x").raise_trip(TripCode.FOLLOWING_ERROR, "test")
        await asyncio.sleep(0.5)
        assert plant.states() == [State.TRIPPED, after]
        move = plant.axis("y").move
        assert move is not None
        assert move.outcome == ("moving" if reaction == "continue" else "stopped")
        if reaction != "continue":
            assert move.reason == f"x has tripped (machine.fault_reaction is {reaction})"
        plant.ask(op="reset")
        assert plant.axis("x").state is State.DISARMED

    operate(path, script)


@pytest.mark.parametrize("state", [State.ARMING, State.HOLDING])
def test_an_axis_that_is_disarmed_for_another_gets_no_effort_from_that_tick_on(tmp_path: Path, state: State) -> None:
    pages = {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1)}
    path = machine_file(tmp_path, pages, 'fault_reaction = "disarm"\n')

    async def script(plant: Plant) -> None:
        axis_loop = plant.loop.axis_loop("y")
        await plant.armed()
        plant.drives["y"].change(asyncio.get_running_loop().time(), load=-2.0)
        await plant.until(lambda: abs(axis_loop.command.effort) > 1.0)
        await asyncio.sleep(1.0)
        if state is State.ARMING:
            plant.ask(op="disarm", axis="y")
            plant.drives["y"].change(asyncio.get_running_loop().time(), load=0.0)
            await plant.until(lambda: plant.axis("y").ready_to_arm)
            plant.ask(op="arm", axis="y")
        assert plant.axis("y").state is state
        plant.axis("x").raise_trip(TripCode.FOLLOWING_ERROR, "test")
        await asyncio.sleep(0.2)
        assert plant.states() == [State.TRIPPED, State.DISARMED]
        disarmed = [record for record in list(axis_loop.recorder.records())[-30:] if record.state is State.DISARMED]
        assert len(disarmed) > 10
        assert all(record.effort == 0.0 for record in disarmed)

    operate(path, script)


@pytest.mark.parametrize(
    ("reaction", "after"), [("continue", State.HOLDING), ("stop", State.DISARMED), ("quick_stop", State.DISARMED)]
)
def test_an_axis_that_is_being_armed_is_not_armed_when_another_one_trips(
    tmp_path: Path, reaction: str, after: State
) -> None:
    pages = {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1), "z": axis_page("z", "can0", offset=2)}
    path = machine_file(tmp_path, pages, f'fault_reaction = "{reaction}"\n')

    async def script(plant: Plant) -> None:
        await plant.until(lambda: all(plant.axis(name).ready_to_arm for name in "xyz"))
        plant.ask(op="arm", axis="x")
        plant.ask(op="arm", axis="z")
        await plant.until(lambda: plant.axis("x").state is plant.axis("z").state is State.HOLDING)
        plant.ask(op="arm", axis="y")
        assert plant.axis("y").state is State.ARMING
        with structlog.testing.capture_logs() as told:
            plant.axis("x").raise_trip(TripCode.FOLLOWING_ERROR, "test")
            await asyncio.sleep(0.2)
        assert plant.states() == [State.TRIPPED, after, State.HOLDING]
        reacted = [one for one in told if one["event"] == "another axis has tripped"]
        assert [(one["axis"], one["now"]) for one in reacted] == ([] if reaction == "continue" else [("y", after)])

    operate(path, script)


@pytest.mark.parametrize("reaction", ["continue", "stop", "quick_stop"])
def test_a_jog_that_is_asked_for_blindly_does_not_go_on_beside_an_axis_that_has_tripped(
    tmp_path: Path, reaction: str
) -> None:
    pages = {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1)}
    path = machine_file(tmp_path, pages, f'fault_reaction = "{reaction}"\n')

    async def script(plant: Plant) -> None:
        await plant.armed()
        places = []
        for step in range(40):
            with contextlib.suppress(Refused):
                plant.ask(op="jog", axis="y", velocity=20.0)
            await asyncio.sleep(0.1)
            if step == 9:
                plant.axis("x").raise_trip(TripCode.FOLLOWING_ERROR, "test")
            places.append(plant.axis("y").drive.position or 0.0)
        assert places[9] > 10.0
        assert (places[-1] - places[15] > 40.0) == (reaction == "continue")
        assert (abs(places[-1] - places[15]) < 0.5) == (reaction != "continue")

    operate(path, script)


def test_a_quick_stop_for_another_axis_hardens_a_stop_that_is_under_way(tmp_path: Path) -> None:
    pages = {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1)}
    path = machine_file(tmp_path, pages, 'fault_reaction = "quick_stop"\n')

    async def script(plant: Plant) -> None:
        await plant.armed()
        plant.ask(op="move", positions={"x": 400.0, "y": 400.0})
        await asyncio.sleep(1.5)
        plant.ask(op="stop", axis="y")
        plant.axis("x").raise_trip(TripCode.FOLLOWING_ERROR, "test")
        await asyncio.sleep(0.02)
        assert plant.axis("y").state is State.QUICK_STOPPING

    operate(path, script)


def test_a_drive_is_disabled_at_the_end_though_another_ones_command_cannot_be_made(
    two_on_one_bus: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def script(plant: Plant) -> None:
        def broken(command: Command) -> can.Message:
            raise RuntimeError(f"no frame for {command}")

        await plant.armed()
        monkeypatch.setattr(plant.loop.axis_loop("x"), "_prepared", broken)
        await asyncio.sleep(0.05)  # half of what a drive waits for commands
        assert isinstance(plant.service.shutdown.failure, RuntimeError)
        assert plant.drives["x"].enabled
        assert not plant.drives["y"].enabled

    operate(two_on_one_bus, script)


def test_a_bus_that_fails_trips_the_axes_on_it_and_no_others(tmp_path: Path) -> None:
    pages = {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1), "z": axis_page("z", "can1")}
    path = machine_file(tmp_path, pages, 'fault_reaction = "continue"\n')

    async def script(plant: Plant) -> None:
        await plant.armed()
        plant.ask(op="move", positions={"x": 400.0, "y": 400.0, "z": 400.0})
        await asyncio.sleep(1.5)
        plant.wires["can0"].node("service").take_down()
        await asyncio.sleep(0.1)
        assert plant.states() == [State.TRIPPED, State.TRIPPED, State.SPEED_STAGE]
        await plant.until(lambda: plant.axis("z").state is State.HOLDING)
        assert plant.drives["z"].position == pytest.approx(400.0, abs=0.05)
        plant.wires["can0"].node("service").bring_up()
        await plant.until(lambda: plant.service.buses[0].error is None)
        assert plant.states() == [State.TRIPPED, State.TRIPPED, State.HOLDING]

    operate(path, script)


def test_stop_and_disarm_concern_all_axes_unless_one_is_named(two_on_one_bus: Path) -> None:
    async def script(plant: Plant) -> None:
        await plant.armed()
        plant.ask(op="move", positions={"x": 400.0, "y": 400.0})
        await asyncio.sleep(1.0)
        plant.ask(op="stop", axis="y")
        await plant.until(lambda: plant.axis("y").state is State.HOLDING)
        assert plant.axis("x").state is State.SPEED_STAGE
        plant.ask(op="stop")
        await plant.until(lambda: set(plant.states()) == {State.HOLDING})
        with pytest.raises(Refused, match="name one of x, y") as refused:
            plant.ask(op="jog", velocity=10.0)
        assert refused.value.code == "which_axis"
        plant.ask(op="disarm")
        await plant.until(lambda: set(plant.states()) == {State.DISARMED})

    operate(two_on_one_bus, script)


def test_the_snapshot_shows_all_axes_or_the_one_named(two_on_one_bus: Path) -> None:
    async def script(plant: Plant) -> None:
        await plant.armed()
        assert {name: report["axis"]["state"] for name, report in plant.ask(op="status")["axes"].items()} == {
            "x": "holding",
            "y": "holding",
        }
        assert plant.ask(op="status", axis="y")["axis"]["name"] == "y"
        with pytest.raises(Refused, match="there is no axis z"):
            plant.ask(op="status", axis="z")
        with pytest.raises(Refused, match="there are several"):
            plant.ask(op="recording")

    operate(two_on_one_bus, script)


def test_a_reload_takes_all_files_or_none(two_on_one_bus: Path) -> None:
    machine = load_machine(two_on_one_bus)
    other = two_on_one_bus.parent / "y.toml"

    async def script(plant: Plant) -> None:
        await plant.until(lambda: all(axis_loop.axis.ready_to_arm for axis_loop in plant.service.axis_loops))
        for name in ("x", "y"):
            page = two_on_one_bus.parent / f"{name}.toml"
            page.write_text(page.read_text().replace("cruise_velocity = 100.0", "cruise_velocity = 40.0"))
        text = other.read_text()
        other.write_text(text.replace("identifier_offset = 1", "identifier_offset = 2"))
        with pytest.raises(ConfigError, match=r"y\.toml.*\[protocol\] has changed"):
            plant.reload(machine, load_machine(two_on_one_bus))
        assert plant.axis("x").settings.cruise_velocity == 100.0
        other.write_text(text)
        plant.reload(machine, load_machine(two_on_one_bus))
        assert [axis_loop.axis.settings.cruise_velocity for axis_loop in plant.service.axis_loops] == [40.0, 40.0]

    operate(two_on_one_bus, script)


# The files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pages", "machine", "complaint"),
    [
        ({"x": axis_page("x", "can0"), "y": axis_page("x", "can1")}, "", r"y\.toml:\d+: axis\.name.* of this name"),
        ({"x": axis_page("all", "can0")}, "", "'all' means every axis"),
        ({"x": axis_page("x", "can0")}, 'fault_reaction = "explode"', r"machine\.toml:\d+: machine\.fault_reaction"),
        (
            {"x": axis_page("x", "can0"), "y": axis_page("y", "can0").replace("50.0\n", "60.0\n", 1)},
            "",
            "it is the same bus",
        ),
        (
            {"x": axis_page("x", "can0"), "y": axis_page("y", "can1").replace("tick_ms = 10.0", "tick_ms = 20.0")},
            "",
            r"y\.toml:\d+: service: differs from that of .*machine\.toml",
        ),
        (
            {"x": axis_page("x", "can0").replace("velocity = 250.0", "velocity = -1.0")},
            "",
            r"x\.toml:\d+: axis\.limits",
        ),
    ],
    ids=["names", "all", "reaction", "bus", "tick", "axis"],
)
def test_what_does_not_fit_together_is_told_with_file_and_line(
    tmp_path: Path, pages: dict[str, str], machine: str, complaint: str
) -> None:
    with pytest.raises(ConfigError, match=complaint):
        load_machine(machine_file(tmp_path, pages, machine + "\n"))


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    path = machine_file(tmp_path, {"x": axis_page("x", "can0")})
    (tmp_path / "x.toml").unlink()
    with pytest.raises(ConfigError, match=r"x\.toml: there is no such file"):
        load_machine(path)


def test_drives_with_the_same_identifiers_on_one_bus_are_refused(tmp_path: Path) -> None:
    path = machine_file(tmp_path, {"x": axis_page("x", "can0"), "y": axis_page("y", "can0")})
    with pytest.raises(ConfigError, match=r"y\.toml.*axis x .* also uses identifier 0x\w+ on this bus"):
        build_parts(load_machine(path))


def test_an_offset_beyond_the_largest_identifier_is_refused(tmp_path: Path) -> None:
    path = machine_file(tmp_path, {"x": axis_page("x", "can0", offset=0x700)})
    with pytest.raises(ConfigError, match=r"protocol\.identifier_offset.*exceeds 0x7FF"):
        build_parts(load_machine(path))


def test_a_bus_that_cannot_carry_the_frames_is_refused(tmp_path: Path) -> None:
    """Two axes take (95 + 135) bits each 10 ms and 75 each 100 ms, so 47.5 kbit/s at the worst."""
    pages = {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1)}
    machine = load_machine(machine_file(tmp_path, pages), ["x:bus.bitrate=47000", "y:bus.bitrate=47000"])
    with pytest.raises(ConfigError, match=r"bus\.bitrate.*the frames of x, y .* 101 % of 47 kbit/s"):
        build_parts(machine)
    build_parts(load_machine(tmp_path / "machine.toml", ["x:bus.bitrate=48000", "y:bus.bitrate=48000"]))


def test_an_override_reaches_the_axis_that_it_names(two_on_one_bus: Path) -> None:
    machine = load_machine(two_on_one_bus, ["y:axis.cruise_velocity=7", "service.tick_ms=5"])
    assert [loaded.config.axis.cruise_velocity for loaded in machine.axes] == [100.0, 7.0]
    assert machine.service.tick_ms == 5.0
    with pytest.raises(ConfigError, match="there is no axis z; the axes are x, y"):
        load_machine(two_on_one_bus, ["z:axis.cruise_velocity=7"])


def test_an_override_of_an_axis_key_that_names_no_axis_is_told_how_to_name_one(two_on_one_bus: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        load_machine(two_on_one_bus, ["simulation.load=20", "service.tick_ms=5", "bus=3", "y:axis.cruise_velocity=7"])
    assert [str(problem) for problem in refused.value.problems] == [
        f"--set {one}: that is a key of an axis: name the axis, --set x:{one} or --set y:{one}"
        for one in ("simulation.load=20", "bus=3")
    ]
    with pytest.raises(ConfigError, match="axs: unknown key"):
        load_machine(two_on_one_bus, ["axs.name=z"])
