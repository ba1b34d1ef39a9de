"""Somebody else commands the drive: who is told, how, and when, whatever the axis does."""

import asyncio
from typing import Any

import can
import pytest
import structlog

from tests.service.rig import World, simulate
from twostage_servo.api.request_reading import read_request
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode

NO_ENABLED_BIT = "protocol.feedback.enabled=false"
NO_HEARTBEAT = (
    "protocol.heartbeat.message=false", "protocol.heartbeat.state=false", "protocol.heartbeat.boot_counter=false",
)  # fmt: skip


def drive_told(world: World) -> dict[str, Any]:
    told: dict[str, Any] = world.loop.snapshot()["drive"]
    return told


def lasting(world: World) -> list[str]:
    return [one["code"] for one in drive_told(world)["lasting"]]


def ask(world: World, **request: Any) -> dict[str, Any]:
    return world.requests.handle(read_request(request), "operator")


class Other:
    """Another controller on the same bus, with our identifier and a counter of its own."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._bus = world.wire.attach("another controller")
        world.loop.listen(lambda _: self._bus.shutdown() if world.service.shutdown.is_ending else None)
        self._counter = 0

    def send(self, effort: float, *, enable: bool) -> None:
        self._counter += 1
        profile = self._world.profile
        number, extended = profile.command_id
        data = profile.encode_command(effort, enable, self._counter)
        self._bus.send(can.Message(arbitration_id=number, is_extended_id=extended, data=data))

    def send_broken(self) -> None:
        number, extended = self._world.profile.command_id
        self._bus.send(can.Message(arbitration_id=number, is_extended_id=extended, data=bytes(3)))

    async def command(self, effort: float, *, enable: bool, for_s: float) -> None:
        for _ in range(round(for_s / 0.004)):
            self.send(effort, enable=enable)
            await asyncio.sleep(0.004)


def test_a_disarmed_axis_that_another_node_drives_trips_within_three_ticks_and_says_by_what() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        other, begun_s = Other(world), world.service.statistics.uptime_s
        driving = asyncio.create_task(other.command(15.0, enable=True, for_s=2.0))
        await world.until(lambda: world.axis.trip is not None, 1.0)
        assert world.service.statistics.uptime_s - begun_s < 0.05
        trip = world.axis.trip
        assert trip is not None
        assert (world.state(), trip.code) == (State.TRIPPED, TripCode.FOREIGN_COMMAND)
        assert "another node on the bus commands this drive: 0x201 [" in trip.cause
        assert "commands an effort of 15 V" in trip.cause
        assert lasting(world) == ["foreign_command"]
        assert "x tripped (foreign_command)" in world.line()
        with pytest.raises(Refused, match="0x201") as refused:
            ask(world, op="reset")
        assert refused.value.code == "foreign_command"
        # It goes on, and the drive stays enabled by it: that trip names who enables it.
        await world.until(lambda: TripCode.DRIVE_NOT_DISABLED in world.axis.trips, 1.5)
        cause = world.axis.trips[TripCode.DRIVE_NOT_DISABLED].cause
        assert "another node on the bus has commanded it: 0x201 [" in cause
        assert lasting(world) == ["drive_not_disabled", "foreign_command"]
        await driving
        await world.seconds(1.0)
        assert lasting(world) == []
        ask(world, op="reset")
        await world.armed()

    simulate(script)


def test_a_disarmed_axis_whose_drive_another_node_keeps_disabled_is_told_at_once_and_does_not_trip() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        other = Other(world)
        with structlog.testing.capture_logs() as logs:
            await other.command(0.0, enable=False, for_s=12.0)
        assert world.axis.trip is None
        (one,) = drive_told(world)["lasting"]
        assert one["code"] == "foreign_command"
        assert "disables the drive" in one["cause"]
        assert "End the other service" in one["next_action"]
        line = world.line()
        assert "x disarmed (foreign_command): another node on the bus commands this drive: 0x201" in line
        told = [log for log in logs if log.get("code") == "foreign_command"]
        assert [log["log_level"] for log in told] == ["error", "error"]  # at once, and again after 10 s
        assert 999 < told[1]["tick"] - told[0]["tick"] < 1002
        with pytest.raises(Refused, match="End the other service") as refused:
            ask(world, op="arm")
        assert refused.value.code == "foreign_command"
        await world.seconds(0.6)
        assert lasting(world) == []
        await world.armed()

    simulate(script)


def test_a_single_foreign_frame_to_a_disarmed_axis_is_told_in_the_tick_in_which_it_comes() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        with structlog.testing.capture_logs() as logs:
            Other(world).send(0.0, enable=False)
            await world.seconds(0.02)
            assert lasting(world) == ["foreign_command"]
        assert [log["code"] for log in logs if "code" in log] == ["foreign_command"]
        await world.seconds(0.6)
        assert lasting(world) == []

    simulate(script)


@pytest.mark.parametrize("state", ["tripped", "disarmed"])
def test_a_drive_that_does_not_tell_whether_it_is_enabled_is_taken_at_what_it_was_told(state: str) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        if state == "tripped":
            await world.armed()
            world.axis.raise_trip(TripCode.STALL, "it does not move")
            await world.seconds(0.5)
        other = Other(world)
        await other.command(0.0, enable=False, for_s=0.05)
        assert TripCode.FOREIGN_COMMAND not in world.axis.trips
        assert lasting(world) == ["foreign_command"]
        other.send(5.0, enable=True)
        await world.seconds(0.02)
        assert TripCode.FOREIGN_COMMAND in world.axis.trips
        assert world.state() is State.TRIPPED

    simulate(script, NO_ENABLED_BIT, *NO_HEARTBEAT)


def test_what_cannot_be_read_as_a_command_is_told_too() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        Other(world).send_broken()
        await world.seconds(0.02)
        (one,) = drive_told(world)["lasting"]
        assert "0x201 [00 00 00], which is not a valid command" in one["cause"]
        assert world.axis.trip is None

    simulate(script)


@pytest.mark.parametrize("state", ["arming", "holding", "moving"])
def test_an_enabled_axis_trips_by_one_frame(state: str) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        if state == "arming":
            world.axis.arm()
        elif state == "holding":
            await world.armed()
        else:
            await world.cruising()
        Other(world).send(0.0, enable=False)
        await world.seconds(0.02)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.FOREIGN_COMMAND

    simulate(script)
