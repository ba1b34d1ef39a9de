"""What a configuration becomes: each part gets the numbers that are its own."""

import asyncio
import pickle
from collections.abc import Callable
from pathlib import Path

import can
import pytest

from tests.service.rig import BUS, World, simulate
from tests.service.test_several_axes import Plant, axis_page, machine_file, operate
from tests.telemetry.test_recorder import record
from twostage_servo.app.assembly import build_drive, cyclic_frames, design, socket_path
from twostage_servo.app.axes_preparation import Job, prepare
from twostage_servo.app.build import build_parts, traits_of
from twostage_servo.axis.messages import Feedback, Reception
from twostage_servo.canbus.link import BusSettings
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.loader import load
from twostage_servo.config.machine import Machine, load_machine
from twostage_servo.control.laws.adaptive.design import AdaptiveDesign
from twostage_servo.faults.frames import compile_profile
from twostage_servo.service.settings import ServiceSettings, longest_end_s

PAGES = {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1), "z": axis_page("z", "can1")}


def keys(refused: "pytest.ExceptionInfo[ConfigError]") -> list[str]:
    return [problem.key for problem in refused.value.problems]


# A machine ------------------------------------------------------------------------------------------------------------


def test_axes_of_one_channel_share_its_bus_and_all_of_them_the_machines_tick(tmp_path: Path) -> None:
    path = machine_file(tmp_path, PAGES)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("tick_ms = 10.0", "tick_ms = 5.0\nrecording_s = 1.5"), encoding="utf-8")
    machine = load_machine(path)
    service = build_parts(machine)
    assert service.period_s == pytest.approx(0.005)
    assert [axis_loop.name for axis_loop in service.axis_loops] == ["x", "y", "z"]
    assert [service.buses.index(axis_loop.bus) for axis_loop in service.axis_loops] == [0, 0, 1]
    assert [bus.link.settings.channel for bus in service.buses] == ["can0", "can1"]
    for axis_loop in service.axis_loops:
        assert axis_loop.axis.design.period_s == pytest.approx(0.005)
        assert axis_loop.bus in service.buses
        for index in range(400):
            axis_loop.recorder.add(record(index))
        assert len(axis_loop.recorder.records()) == 300


def test_a_bus_that_is_given_takes_the_place_of_the_configured_ones(tmp_path: Path) -> None:
    machine = load_machine(machine_file(tmp_path, PAGES | {"z": axis_page("z", "can1", offset=2)}))
    opened: list[BusSettings] = []

    def opener(settings: BusSettings) -> can.BusABC:
        opened.append(settings)
        raise can.CanError("no bus")

    service = build_parts(machine, BUS, opener)
    (bus,) = service.buses
    assert bus.link.settings is BUS
    assert service.names == ["x", "y", "z"]
    with pytest.raises(Exception, match="no bus"):
        bus.link.open()
    assert opened == [BUS]


# An axis --------------------------------------------------------------------------------------------------------------


def test_the_design_is_for_the_tick_that_is_asked_for() -> None:
    loaded = load(None)
    assert design(loaded).period_s == pytest.approx(0.01)
    assert design(loaded, 0.005).period_s == pytest.approx(0.005)


def test_the_effort_limit_may_be_all_that_the_command_signal_carries() -> None:
    profile = compile_profile(load(None))
    loaded = load(None, [f"axis.limits.effort={profile.traits.effort_limit}"])
    build_parts(loaded)
    with pytest.raises(ConfigError, match="carries at most"):
        build_parts(load(None, [f"axis.limits.effort={1.001 * profile.traits.effort_limit}"]))


@pytest.mark.parametrize(("overrun", "taken"), [(15.0, True), (17.0, False)])
def test_the_travel_that_an_encoder_must_tell_apart_has_the_overrun_at_both_ends(
    overrun: float, *, taken: bool
) -> None:
    """Half a revolution is 32.77 mm, and the axis has 2 mm of travel between its limits."""
    overrides = [
        "protocol.feedback.position_scale=1.52587890625e-5", "axis.limits.position_minimum=-1",
        "axis.limits.position_maximum=1", f"axis.limits.position_overrun={overrun}",
        "axis.limits.stale_feedback_ms=500", "axis.limits.undetected_travel=30",
    ]  # fmt: skip
    if taken:
        build_parts(load(None, overrides))
    else:
        with pytest.raises(ConfigError) as refused:
            build_parts(load(None, overrides))
        assert keys(refused) == ["axis.limits.stale_feedback_ms"]


@pytest.mark.parametrize(("sampling", "age_s"), [("cyclic", 0.004), ("on_command", None)])
def test_a_drive_with_a_rhythm_of_its_own_is_dated_by_its_frames(
    monkeypatch: pytest.MonkeyPatch, sampling: str, age_s: float | None
) -> None:
    ages: list[float | None] = []

    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        take = world.axis.accept_feedback

        def noted(feedback: Feedback, reception: Reception) -> None:
            ages.append(reception.age_s)
            take(feedback, reception)

        monkeypatch.setattr(world.axis_loop.bus.link, "age_s", lambda _: 0.004)
        monkeypatch.setattr(world.axis, "accept_feedback", noted)
        await world.seconds(0.1)

    simulate(script, f"protocol.feedback.sampling='{sampling}'")
    assert len(ages) > 5
    assert (set(ages) == {age_s}) is (sampling == "cyclic")


def test_each_axis_of_a_machine_has_a_recording_of_its_own(tmp_path: Path) -> None:
    async def script(plant: Plant) -> None:
        await plant.until(lambda: all(plant.axis(name).ready_to_arm for name in "xyz"))
        plant.ask(op="arm", axis="y")
        await plant.until(lambda: plant.axis("y").state == "holding")
        for name in "xyz":
            answer = plant.ask(op="recording", axis=name)
            state = answer["records"][-1][answer["fields"].index("state")]
            assert (state == "holding") is (name == "y")

    operate(machine_file(tmp_path, PAGES), script)


# The rest -------------------------------------------------------------------------------------------------------------


def test_the_frames_that_go_for_ever_and_how_often() -> None:
    loaded = load(None, ["axis.limits.heartbeat_ms=300"])
    frames = cyclic_frames(loaded, build_drive(loaded), 0.02)
    assert [(frame.name, frame.period_s) for frame in frames] == [
        ("command", 0.02), ("feedback", 0.02), ("heartbeat", pytest.approx(0.1)),
    ]  # fmt: skip
    profile = compile_profile(loaded)
    assert frames[0].data_bytes == len(profile.encode_command(0.0, enable=False, counter=0))
    assert not any(frame.extended for frame in frames)


def test_a_fault_is_told_by_its_name_too_where_the_dbc_has_one() -> None:
    async def script(world: World) -> list[str]:
        causes = []
        for code in (2, 77):
            await world.armed()
            world.drive.change(asyncio.get_running_loop().time(), fault_code=code)
            await world.until(lambda: world.axis.trip is not None)
            assert world.axis.trip is not None
            causes.append(world.axis.trip.cause)
            world.drive.change(asyncio.get_running_loop().time(), fault_code=0)
            await world.seconds(0.2)
            world.axis.reset()
        return causes

    assert simulate(script) == ["the drive reports fault code 2 (Overcurrent)", "the drive reports fault code 77"]


def test_where_the_socket_lies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TWOSTAGE_SERVO_SOCKET", str(tmp_path / "named"))
    assert socket_path(ServiceSettings()) == tmp_path / "named"
    assert socket_path(ServiceSettings(socket=str(tmp_path / "own"))) == tmp_path / "own"


def test_how_long_the_end_may_take_is_the_braking_the_slowest_drive_and_what_comes_after() -> None:
    settings = ServiceSettings(shutdown_timeout_ms=800.0)
    assert longest_end_s(settings, ()) == pytest.approx(12.8)
    assert longest_end_s(settings, (100.0, 700.0, 300.0)) == pytest.approx(13.5)


@pytest.mark.parametrize(
    ("table", "override"),
    [
        ("[service]", "service.tick_ms=20"),
        ("[realtime]", "realtime.priority=7"),
        ("[machine]", "axis.name='other'"),
        ("[bus]", "bus.reopen_interval_ms=77"),
        ("[protocol]", "protocol.identifier_offset=3"),
    ],
)
def test_what_only_a_restart_can_follow_is_refused_by_its_table(table: str, override: str) -> None:
    async def script(world: World) -> Callable[[], str | None]:
        running = Machine.of(load(None))
        traits = traits_of(world.service.axis_loops)
        path = shipped_configuration("demo.toml")
        return lambda: prepare(Job(path, (override,), pickle.dumps(running), traits, 0.01)).problem

    problem = simulate(script)() or ""
    assert table in problem
    assert "restart the service to apply that" in problem


@pytest.mark.parametrize(("file", "step"), [("demo.toml", 0.001), ("rotary_table.toml", 360.0 / 65536.0)])
def test_a_law_is_designed_for_the_step_of_the_encoder(file: str, step: float) -> None:
    loaded = load(shipped_configuration(file), ["axis.law.type=adaptive"])
    for made in (design(loaded), design(loaded, traits=build_drive(loaded).traits)):
        assert isinstance(made.law, AdaptiveDesign)
        assert made.law.task.encoder_step == pytest.approx(step)
        assert made.law.noise == pytest.approx(step / 12.0**0.5)
