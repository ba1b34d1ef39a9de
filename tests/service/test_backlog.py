"""A bus that brings more frames than a tick reads: what is read late does not count as fresh."""

import asyncio

import can
import pytest

from tests.service.rig import BUS, World, simulate
from tests.service.text_connection import socketcand_at
from twostage_servo.axis.messages import Heartbeat
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.canbus.link import BusSettings, Link
from twostage_servo.simulation.bus import Wire, WireBus
from twostage_servo.timing.ticks import Tick

UNDATED = BusSettings(interface="virtual", channel="x")
TCP = BusSettings(interface="socketcand", channel="can0")
FOREIGN = can.Message(arbitration_id=0x7F, is_extended_id=False, data=bytes(8))


class Undated(WireBus):
    """A bus that says nothing of its stamps, like most."""

    def __init__(self, wire: Wire) -> None:
        super().__init__(wire, "service")
        del self.clock


OPENERS = {
    "dated": (BUS, lambda wire: wire.attach("service")),
    "undated": (UNDATED, Undated),
    "socketcand": (TCP, lambda wire: socketcand_at(wire, "service")),
}
EVERY_BUS = pytest.mark.parametrize(("bus", "opener"), OPENERS.values(), ids=OPENERS)


def flood(world: World, frames_a_tick: int) -> None:
    """Let foreign frames arrive each tick from now on, none of which the transport loses."""
    node = world.wire.node("service")
    node.set_queue_length(1_000_000)

    def after_each_tick(_: Tick) -> None:
        for _frame in range(frames_a_tick):
            node.inject(FOREIGN)

    world.loop.listen(after_each_tick)


def most(world: World) -> int:
    return world.axis_loop.bus.link.settings.frames_read(world.service.ticks.period_s)


@pytest.mark.long
@EVERY_BUS
def test_a_held_axis_does_not_swing_on_feedback_that_waits_behind_foreign_frames(bus, opener) -> None:  # type: ignore[no-untyped-def]
    async def script(world: World) -> None:
        await world.armed()
        flood(world, most(world) + 150)
        begun = world.service.statistics.count
        world.drive.change(asyncio.get_running_loop().time(), load=6.0)  # a push
        await world.seconds(0.05)
        world.drive.change(asyncio.get_running_loop().time(), load=0.0)
        farthest = 0.0
        for _ in range(300):
            await world.seconds(0.01)
            farthest = max(farthest, abs(world.drive.position))
        assert farthest < 5.0
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.STALE_FEEDBACK
        assert world.axis.trip.tick - begun <= 5
        cause = world.axis.trip.cause
        assert f"stopped at {most(world)} frames (bus.max_frames_per_tick)" in cause
        assert "the last 2 reads each began with a backlog" in cause
        assert world.state() is State.TRIPPED
        assert farthest < 40.0  # 3 V for 2 s, which nothing holds once the drive is off
        shown = world.loop.snapshot()
        assert shown["axis"]["position"] is None
        assert shown["frames"]["overruns"] > 100
        assert shown["frames"]["late"] > 0

    simulate(script, bus=bus, opener=opener)


@EVERY_BUS
def test_frames_that_each_tick_empties_change_nothing(bus, opener) -> None:  # type: ignore[no-untyped-def]
    async def script(world: World) -> None:
        await world.armed()
        flood(world, most(world) - 10)
        world.axis.move_to(30.0, 100.0)
        await world.until(lambda: world.axis.move is not None and world.axis.move.outcome != "moving")
        assert world.axis.move is not None
        assert world.axis.move.outcome == "reached"
        frames = world.loop.snapshot()["frames"]
        assert (frames["overruns"], frames["late"], frames["predicted"]) == (0, 0, 0)

    simulate(script, bus=bus, opener=opener)


@EVERY_BUS
def test_one_burst_is_bridged(bus, opener) -> None:  # type: ignore[no-untyped-def]
    async def script(world: World) -> None:
        await world.cruising()
        for _ in range(most(world) + 50):
            world.wire.node("service").inject(FOREIGN)
        await world.seconds(0.5)
        assert world.axis.trip is None
        frames = world.loop.snapshot()["frames"]
        assert frames["overruns"] == 1
        assert frames["late"] <= 1
        assert frames["lost"] == 0

    simulate(script, bus=bus, opener=opener)


@EVERY_BUS
def test_an_axis_is_not_armed_on_feedback_of_no_known_age(bus, opener) -> None:  # type: ignore[no-untyped-def]
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        flood(world, most(world) + 150)
        await world.seconds(0.1)
        with pytest.raises(Refused, match="frames arrive faster than they are read") as refused:
            world.axis.arm()
        assert refused.value.code == "no_feedback"

    simulate(script, bus=bus, opener=opener)


@EVERY_BUS
def test_what_waits_after_a_suspension_is_read_in_the_next_tick(bus, opener) -> None:  # type: ignore[no-untyped-def]
    """A bus that is full all of the time brings three ticks' frames to the tick after two that were missed."""

    async def script(world: World) -> None:
        node = world.wire.node("service")
        node.set_queue_length(1_000_000)
        await world.cruising()
        world.ticks.hold_s = 0.031
        await world.seconds(0.015)
        for _ in range(3 * most(world) - 20):
            node.inject(FOREIGN)
        await world.seconds(0.5)
        assert world.service.statistics.missed == 2
        assert world.axis.trip is None
        assert world.loop.snapshot()["frames"]["overruns"] == 0

    simulate(script, bus=bus, opener=opener)


def test_what_is_read_after_a_long_suspension_is_bounded() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        asked = []
        link = world.axis_loop.bus.link
        drain = link.drain

        def counted(most: int | None = None) -> list[can.Message]:
            asked.append(most)
            return drain(most)

        link.drain = counted  # type: ignore[method-assign]
        world.ticks.hold_s = 20.0  # 2,000 ticks; the drive reports all the while
        await world.seconds(21.0)
        assert max(filter(None, asked)) == 11 * most(world)

    simulate(script, bus=UNDATED, opener=Undated)


def test_a_dated_frame_that_has_lain_there_unread_is_not_fresh() -> None:
    """An adapter that hands frames over behind time: the queue is empty each tick, and only the date tells."""

    async def script(world: World) -> None:
        await world.armed()
        node, late = world.wire.node("service"), []
        original = node.next_arrived

        def held_back() -> can.Message | None:
            while (frame := original()) is not None:
                late.append(frame)
            if late and late[0].timestamp <= world.wire.clock() - 0.018:
                return late.pop(0)
            return None

        node.next_arrived = held_back  # type: ignore[method-assign]
        await world.until(lambda: world.axis.trip is not None, 1.0)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.STALE_FEEDBACK
        assert "arrived too late to count" in world.axis.trip.cause

    simulate(script)


def test_a_heartbeat_from_a_backlog_is_no_sign_of_life() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        link: Link = world.axis_loop.bus.link
        profile, drive = world.profile, world.axis.drive
        assert profile.heartbeat_id is not None
        drive.heartbeat.state.ticks_since, boots = 5, drive.heartbeat.state.boots
        data = profile.encode_heartbeat(Heartbeat(0, (drive.heartbeat.state.boot_counter or 0) + 1))
        message = can.Message(arbitration_id=profile.heartbeat_id.identifier, is_extended_id=False, data=data)
        link.is_behind = True
        world.hear(message)
        assert drive.heartbeat.state.ticks_since == 5
        assert drive.heartbeat.state.boots == boots + 1  # which it does tell
        link.is_behind, message.timestamp = False, asyncio.get_running_loop().time()
        world.hear(message)
        assert drive.heartbeat.state.ticks_since == 0

    simulate(script)
