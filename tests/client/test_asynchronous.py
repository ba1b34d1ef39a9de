"""The asynchronous client at the real service with its simulated drive, in simulated time."""

import asyncio
import itertools
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

import twostage_servo
from tests.service.operators import connect, serve
from tests.service.rig import World
from twostage_servo.api.status import Status
from twostage_servo.app.closed_loop import Wires, closed_loop
from twostage_servo.axis.moves import MoveKind, MoveOutcome
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.state import MOVING, State
from twostage_servo.axis.trips import TripCode
from twostage_servo.client.asynchronous import AsyncServoClient
from twostage_servo.client.errors import Reason
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.machine import load_machine
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.timing.virtual_clock import run

Operated = Callable[[World, AsyncServoClient, Path], Awaitable[None]]


def operated(folder: Path, script: Operated, *overrides: str) -> None:
    """Let a script use a client of the service; the client leaves before the service ends."""
    path = folder / "control.sock"

    async def main(world: World, _: ControlSocket) -> None:
        async with twostage_servo.connect_async(path) as axis:
            await script(world, axis, path)

    serve(path, main, *overrides)


def test_a_working_day(tmp_path: Path) -> None:
    async def script(world: World, axis: AsyncServoClient, _: Path) -> None:
        assert (await axis.status()).axis.state is State.DISARMED
        assert (await axis.arm()).axis.state is State.HOLDING
        begun = await axis.move(100.0)
        assert begun.axis.state in MOVING
        reached = await axis.wait_until_reached()
        assert reached.move is not None
        assert reached.move.outcome is MoveOutcome.REACHED
        assert world.drive.position == pytest.approx(100.0, abs=0.5)
        reached = await axis.move_by(-50.0, velocity=20.0, wait=True)
        assert reached.move is not None
        assert (reached.move.target, reached.move.velocity) == (50.0, 20.0)
        assert (await axis.override(50.0)).axis.override_percent == 50.0
        await axis.home(0.0)
        assert (await axis.status()).axis.position == pytest.approx(0.0, abs=0.5)
        await axis.move(300.0)
        assert (await axis.stop(quick=True)).axis.state is State.HOLDING
        recording = await axis.recording()
        assert len(recording.records) > 10
        assert all(len(record) == len(recording.fields) for record in recording.records)
        assert (await axis.disarm()).axis.state is State.DISARMED
        assert world.drive.enabled is False

    operated(tmp_path, script)


def test_leaving_gives_authority_back_and_what_was_asked_for_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "s"

    async def script(world: World, _: ControlSocket) -> None:
        async with twostage_servo.connect_async(path) as axis:
            await axis.arm()
            await axis.move(200.0)
            assert world.loop.snapshot()["authority"]["holder"] is not None
        assert world.loop.snapshot()["authority"]["holder"] is None
        assert world.state() in MOVING

    serve(path, script)


@pytest.mark.parametrize("error", [RuntimeError("a slip"), KeyboardInterrupt(), asyncio.CancelledError()])
def test_an_error_in_the_block_stops_the_axis_before_authority_is_given_back(
    tmp_path: Path, error: BaseException
) -> None:
    path = tmp_path / "s"

    async def script(world: World, _: ControlSocket) -> None:
        async def slip() -> None:
            async with twostage_servo.connect_async(path) as axis:
                await axis.arm()
                await axis.move(200.0)
                raise error

        with pytest.raises(type(error)):
            await slip()
        assert world.state() is State.STOPPING
        assert world.loop.snapshot()["authority"]["holder"] is None
        move = world.axis.move
        assert move is not None
        assert move.outcome is MoveOutcome.STOPPED

    serve(path, script)


def test_who_has_no_authority_stops_nobody_by_an_error(tmp_path: Path) -> None:
    path = tmp_path / "s"

    async def script(world: World, _: ControlSocket) -> None:
        async with twostage_servo.connect_async(path) as first:
            await first.arm()
            await first.move(200.0)
            with pytest.raises(twostage_servo.Refused, match="`release --force`") as refused:
                async with twostage_servo.connect_async(path) as second:
                    await second.move(0.0)
            assert refused.value.code is RefusalCode.AUTHORITY_HELD
            assert world.state() in MOVING
            with pytest.raises(twostage_servo.Refused) as refused:
                async with twostage_servo.connect_async(path) as second:
                    await second.acquire()
            assert refused.value.code is RefusalCode.AUTHORITY_HELD
            await first.wait_until_reached()
            async with twostage_servo.connect_async(path) as second:
                await second.acquire(preempt=True)
                await second.move(150.0)
                with pytest.raises(twostage_servo.Refused):
                    await first.move(0.0)
                with pytest.raises(twostage_servo.Interrupted, match="another set-point") as replaced:
                    await asyncio.gather(second.wait_until_reached(), _again(world, second))
                assert replaced.value.outcome is MoveOutcome.REPLACED
                assert world.state() in MOVING
        assert world.state() in MOVING

    async def _again(world: World, client: AsyncServoClient) -> None:
        await world.seconds(0.3)
        await client.move(120.0)

    serve(path, script)


def test_a_trip_is_raised_with_its_code_and_the_status(tmp_path: Path) -> None:
    async def script(world: World, axis: AsyncServoClient, _: Path) -> None:
        await axis.arm()
        await axis.move(400.0)
        later = asyncio.create_task(axis.wait_until_reached())
        await world.seconds(0.5)
        world.axis.raise_trip(TripCode.FOLLOWING_ERROR, "for a test.")
        with pytest.raises(twostage_servo.Tripped, match="for a test") as tripped:
            await later
        assert tripped.value.code == tripped.value.trip.code == TripCode.FOLLOWING_ERROR
        assert tripped.value.status.trip == tripped.value.trip
        await world.until(lambda: world.state() is State.TRIPPED)
        with pytest.raises(twostage_servo.Refused) as refused:
            await axis.move(0.0)
        assert refused.value.code is RefusalCode.TRIPPED
        assert (await axis.reset()).axis.state is State.DISARMED

    operated(tmp_path, script)


def test_of_two_axes_that_move_together_the_one_that_has_tripped_is_named(tmp_path: Path) -> None:
    """The other one was stopped by it, and comes before it."""

    async def script() -> None:
        async with closed_loop(load_machine(shipped_configuration("two_axes.toml")), wires=Wires()) as loop:
            control = loop.control_socket(tmp_path / "control.sock")
            await control.start()
            async with twostage_servo.connect_async(tmp_path / "control.sock") as machine:
                await asyncio.sleep(0.5)
                await machine.arm()
                await machine.move({"x": 300.0, "y": 300.0})
                later = asyncio.create_task(machine.wait_until_reached())
                await asyncio.sleep(0.5)
                loop.axes["y"].axis_loop.axis.raise_trip(TripCode.STALL, "for a test.")
                with pytest.raises(twostage_servo.Tripped, match=r"^axis y: trip stall: for a test\. Find") as tripped:
                    await later
            assert tripped.value.axis == "y"
            await control.stop()

    run(script())


def test_a_motion_that_takes_too_long_is_told_and_goes_on(tmp_path: Path) -> None:
    async def script(world: World, axis: AsyncServoClient, _: Path) -> None:
        await axis.arm()
        with pytest.raises(twostage_servo.TimedOut, match=r"within 0\.5 s") as late:
            await axis.move(400.0, wait=True, timeout=0.5)
        assert late.value.status.axis.state in MOVING
        assert world.state() in MOVING
        await axis.stop()
        with pytest.raises(twostage_servo.Interrupted) as ended:
            await axis.wait_until_reached()
        assert ended.value.outcome is MoveOutcome.STOPPED

    operated(tmp_path, script)


def test_a_jog_lasts_as_long_as_it_was_asked_for_and_ends_at_rest(tmp_path: Path) -> None:
    async def script(world: World, axis: AsyncServoClient, _: Path) -> None:
        await axis.arm()
        loop, seen = asyncio.get_running_loop(), list[Status]()
        begun_s = loop.time()
        rest = await axis.jog(50.0, 2.0, progress=seen.append)
        assert rest.axis.state is State.HOLDING
        assert 2.0 <= loop.time() - begun_s < 3.5
        assert 90.0 < world.drive.position < 130.0
        assert len(seen) >= 20
        assert {status.axis.state for status in seen} == {State.JOGGING}

    operated(tmp_path, script)


def test_a_block_jogs_for_as_long_as_it_lasts(tmp_path: Path) -> None:
    async def script(world: World, axis: AsyncServoClient, _: Path) -> None:
        await axis.arm()
        async with axis.jogging(-20.0):
            await world.seconds(1.5)
            assert world.state() is State.JOGGING
        assert world.state() is State.HOLDING

        async def slip() -> None:
            async with axis.jogging(20.0):
                await world.seconds(0.5)
                raise RuntimeError

        with pytest.raises(RuntimeError):
            await slip()
        assert world.state() is State.STOPPING

    operated(tmp_path, script)


def test_a_jog_that_somebody_else_has_stopped_is_not_begun_anew(tmp_path: Path) -> None:
    async def script(world: World, axis: AsyncServoClient, path: Path) -> None:
        await axis.arm()
        other = await connect(path)

        async def jog() -> None:
            async with axis.jogging(20.0):
                await world.seconds(0.5)
                await other.done(op="stop")
                await world.seconds(2.0)
                assert world.state() is State.HOLDING

        with pytest.raises(twostage_servo.Interrupted) as ended:
            await jog()
        assert ended.value.outcome is MoveOutcome.STOPPED
        assert ended.value.status.move is not None
        assert ended.value.status.move.kind is MoveKind.JOG

    operated(tmp_path, script)


def test_one_task_watches_while_another_moves(tmp_path: Path) -> None:
    async def script(_: World, axis: AsyncServoClient, __: Path) -> None:
        seen: list[Status] = []

        async def watch() -> None:
            async for status in axis.watch(every=2):
                seen.append(status)  # noqa: PERF401 - what was seen before the end counts

        await axis.arm()
        watching = asyncio.create_task(watch())
        await axis.move(100.0, wait=True)
        watching.cancel()
        counts = [status.service.ticks.count for status in seen]
        assert len(counts) > 50
        assert {later - earlier for earlier, later in itertools.pairwise(counts)} == {2}
        assert max(status.axis.velocity or 0.0 for status in seen) > 90.0

    operated(tmp_path, script)


def test_a_number_that_is_none_is_not_sent(tmp_path: Path) -> None:
    async def script(_: World, axis: AsyncServoClient, __: Path) -> None:
        for asked in (axis.move(float("nan")), axis.move(1.0, velocity=0.0), axis.jog(float("inf"), 1.0)):
            with pytest.raises(twostage_servo.Refused) as refused:
                await asked
            assert refused.value.code is RefusalCode.BAD_REQUEST

    operated(tmp_path, script)


def test_no_service_is_told_with_what_is_there(tmp_path: Path) -> None:
    async def nobody(path: Path) -> twostage_servo.ServoError:
        with pytest.raises(twostage_servo.ServoError) as error:
            async with twostage_servo.connect_async(path):
                pass
        return error.value

    missing = asyncio.run(nobody(tmp_path / "s"))
    assert isinstance(missing, twostage_servo.Unreachable)
    assert missing.code is Reason.NO_SERVICE
    (tmp_path / "file").touch()
    assert isinstance(asyncio.run(nobody(tmp_path / "file")), twostage_servo.ConfigError)
