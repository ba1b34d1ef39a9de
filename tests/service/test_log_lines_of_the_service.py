"""The lines of the log, whole: of a service that ends, of control authority, and of axes that react to each other."""

import asyncio
from pathlib import Path

import pytest
import structlog

from tests.service.operators import connect, serve
from tests.service.rig import World, simulate
from tests.service.test_log_lines import of
from tests.service.test_several_axes import Plant, axis_page, machine_file, operate
from twostage_servo.api.requests import MoveRequest, RecordingRequest
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.telemetry.trip_files import TripFiles
from twostage_servo.timing.virtual_clock import run


def test_a_service_that_ends_says_once_in_which_states() -> None:
    async def script(world: World) -> None:
        await world.cruising()
        assert not world.service.shutdown.is_ending
        world.service.shut_down()
        world.service.shut_down()
        await world.serving

    with structlog.testing.capture_logs() as logs:
        simulate(script)
    assert of(logs, "ending") == [{"event": "ending", "log_level": "info", "states": {"x": State.SPEED_STAGE}}]


def test_a_drive_that_could_not_be_told_to_disable_is_told_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        monkeypatch.setattr(world.axis_loop.bus.link, "send", lambda _: False)
        world.service.shut_down()
        await world.serving

    with structlog.testing.capture_logs() as logs:
        simulate(script)
    text = "the drive could not be told to disable; only its own command time-out stops it"
    assert of(logs, text) == [{"event": text, "log_level": "error", "axis": "x", "error": "the bus accepts no frame"}]


def test_a_defect_in_a_request_ends_the_service_and_is_told_to_log_and_client() -> None:
    defect = RuntimeError("a defect")

    async def script(world: World) -> None:
        await world.cruising()

        def broken() -> None:
            raise defect

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(type(world.axis_loop.recorder), "records", lambda _: broken())
            with pytest.raises(Refused, match="RuntimeError: a defect; the service is stopping") as refused:
                world.requests.handle(RecordingRequest())
        assert refused.value.code == "internal_error"
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.INTERNAL_ERROR
        assert world.axis.trip.cause == "RuntimeError in the loop: a defect"
        with pytest.raises(RuntimeError, match="a defect"):
            await world.serving

    with structlog.testing.capture_logs() as logs:
        simulate(script)
    text = "the loop failed, the axes are being stopped"
    assert of(logs, text) == [{"event": text, "log_level": "critical", "exc_info": defect}]


@pytest.mark.parametrize("policy", ["continue", "stop", "disarm"])
def test_that_the_holder_has_gone_is_told_where_it_changes_something(tmp_path: Path, policy: str) -> None:
    path = tmp_path / "control.sock"
    peers: list[str | None] = []

    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="move", position=400.0)
        peers.append(world.requests.authority.holder)
        operator.die()
        await world.seconds(0.1)

    with structlog.testing.capture_logs() as logs:
        serve(path, script, f"service.holder_lost='{policy}'")
    text = "the holder of control authority has disconnected"
    told = {"event": text, "log_level": "warning", "axis": "x", "client": peers[0], "policy": policy}
    assert of(logs, text) == ([] if policy == "continue" else [told])


def test_an_axis_that_reacts_to_another_is_told_with_both(tmp_path: Path) -> None:
    pages = {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1)}
    path = machine_file(tmp_path, pages, 'fault_reaction = "disarm"\n')

    async def script(plant: Plant) -> None:
        await plant.until(lambda: all(plant.axis(name).ready_to_arm for name in "xy"))
        plant.ask(op="arm")
        await plant.until(lambda: plant.states() == [State.HOLDING] * 2)
        with structlog.testing.capture_logs() as logs:
            plant.axis("x").raise_trip(TripCode.FOLLOWING_ERROR, "test")
            await plant.until(lambda: plant.axis("y").state is State.DISARMED)
        (told,) = of(logs, "another axis has tripped")
        assert (told["log_level"], told["axis"], told["tripped"]) == ("warning", "y", "x")
        assert told["now"] in {State.DISARMED, State.DISARMING}

    operate(path, script)


def test_a_move_by_a_way_begins_where_the_last_one_ended() -> None:
    async def script(world: World) -> None:
        await world.armed()
        world.requests.handle(MoveRequest(by=2.5))
        await world.until(lambda: world.axis.move is not None and world.axis.move.outcome == "reached")
        assert world.axis.move is not None
        assert (world.axis.move.target, world.axis.move.velocity) == (2.5, world.axis.settings.cruise_velocity)
        world.requests.handle(MoveRequest(by=2.5, velocity=20.0))
        assert (world.axis.move.target, world.axis.move.velocity) == (5.0, 20.0)

    simulate(script)


# Trip files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "why"),
    [(OSError("disk full"), "disk full"), (MemoryError(), "out of memory"), (RuntimeError(), "RuntimeError")],
)
def test_a_trip_file_that_could_not_be_written_is_told_with_folder_and_reason(
    tmp_path: Path, error: BaseException, why: str
) -> None:
    def fail(*_: object) -> Path:
        raise error

    async def write() -> None:
        TripFiles(tmp_path, fail).write("x", "stall", {}, ())

    with structlog.testing.capture_logs() as logs:
        run(write())
    assert logs == [
        {
            "event": "no trip file", "log_level": "error", "room": "trip_files", "axis": "x", "code": "stall",
            "error": f"no trip file can be written in {tmp_path}: {why}",
        }
    ]  # fmt: skip


def test_a_trip_file_is_told_with_its_path(tmp_path: Path) -> None:
    async def write() -> None:
        files = TripFiles(tmp_path)
        files.write("x", "stall", {}, ())
        await asyncio.sleep(0.1)
        assert not files._writing  # nothing is kept of what is done

    with structlog.testing.capture_logs() as logs:
        run(write())
    (file,) = tmp_path.iterdir()
    of_the_trip = {"axis": "x", "code": "stall", "path": str(file)}
    assert logs == [{"event": "trip file", "log_level": "info", "room": "trip_files", **of_the_trip}]
