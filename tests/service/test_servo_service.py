"""The service over real CAN frames on a simulated bus, in simulated time."""

import asyncio
import itertools
from typing import Any

import can
import pytest
import structlog

from tests.service.rig import World, simulate
from twostage_servo.api.requests import ArmRequest, MoveRequest, StatusRequest
from twostage_servo.app.assembly import build_axis
from twostage_servo.app.build import replace_axes
from twostage_servo.axis.messages import Command
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.canbus.link import LinkError
from twostage_servo.config.loader import load
from twostage_servo.service.settings import stop_ms


def test_a_move_over_can_frames() -> None:
    async def script(world: World) -> None:
        await world.armed()
        move = world.axis.move_to(400.0, 100.0)
        await world.until(lambda: move.outcome != "moving")
        assert move.outcome == "reached"
        assert world.drive.position == pytest.approx(400.0, abs=0.06)
        assert world.axis_loop.bus.link.counters.rejected == 0
        assert world.service.statistics.missed == 0
        assert world.axis.drive.monitor.lost == 0

    simulate(script)


def test_every_tick_sends_one_command_with_the_next_counter() -> None:
    async def script(world: World) -> list[tuple[int, Command]]:
        await world.cruising()
        return world.sent()

    commands = simulate(script)
    ticks = [tick for tick, _ in commands]
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
    counters = [command.counter or 0 for _, command in commands]
    assert all((after - before) % 16 == 1 for before, after in itertools.pairwise(counters))


def test_the_same_run_twice_is_the_same_to_the_bit() -> None:
    async def script(world: World) -> list[tuple[int, str, int, bytes]]:
        await world.armed()
        move = world.axis.move_to(100.0, 100.0)
        await world.until(lambda: move.outcome == "reached")
        return world.trace

    noisy = ("simulation.noise_std=0.03", "simulation.frame_loss=0.02")
    first = simulate(script, *noisy)
    assert first == simulate(script, *noisy)
    assert first != simulate(script, *noisy, "simulation.seed=2")


@pytest.mark.parametrize("retarget", [(600.0, 100.0), (100.0, 100.0), (150.0, 50.0), (-50.0, 200.0), (152.0, 250.0)])
def test_a_retarget_in_mid_move_settles(retarget: tuple[float, float]) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        move = world.axis.move_to(*retarget)
        await world.until(lambda: move.outcome != "moving")
        assert (move.outcome, world.axis.trip) == ("reached", None)
        await world.seconds(2.0)
        assert world.drive.position == pytest.approx(retarget[0], abs=0.06)

    simulate(script)


def test_shut_down_in_mid_move_ramps_and_disables() -> None:
    async def script(world: World) -> list[tuple[int, Command]]:
        await world.cruising()
        begun = world.service.statistics.count
        world.service.shut_down()
        await asyncio.wait_for(world.serving, 1.0)
        assert 100.0 / 2000.0 / 0.01 < world.service.statistics.count - begun < 80  # the ramp of the acceleration limit
        assert world.state() is State.DISARMED
        assert abs(world.drive.velocity) < 3.0
        return world.sent()

    commands = simulate(script)
    assert [(command.effort, command.enable) for _, command in commands[-3:]] == [(0.0, False)] * 3
    efforts = [command.effort for _, command in commands if command.enable]
    steps = [abs(after - before) for before, after in itertools.pairwise(efforts)]
    assert max(steps) <= 1000.0 * 0.01 + 0.001  # axis.limits.effort_rate, and a quantum


@pytest.mark.parametrize("acceleration", [2000.0, 150.0], ids=["nearly at rest by then", "braking for longer"])
def test_shut_down_ends_in_time_even_if_the_axis_does_not_come_to_rest(acceleration: float) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        world.service.shut_down()
        await asyncio.wait_for(world.serving, 0.2)
        assert world.state() is State.DISARMED

    with structlog.testing.capture_logs() as logs:
        simulate(script, "service.shutdown_timeout_ms=100", f"axis.limits.acceleration={acceleration}")
    told = [(one["axis"], one["velocity"] > 50.0) for one in logs if "disabled while the axis moves" in one["event"]]
    assert told == [("x", acceleration != 2000.0)]


@pytest.mark.parametrize("acceleration", [2000.0, 60.0, 20.0])
def test_an_axis_that_brakes_for_seconds_comes_to_rest_before_its_drive_is_disabled(acceleration: float) -> None:
    """It was disabled after 800 ms, wherever the file did not say otherwise, and coasted: 0.8 m of the gantry."""

    async def script(world: World) -> list[tuple[float, bool]]:
        await world.cruising(velocity=90.0)
        await world.seconds(1.0)
        seen = []
        world.service.shut_down()
        while not world.serving.done():
            seen.append((world.drive.velocity, world.drive.enabled))
            await world.seconds(0.01)
        return seen

    seen = simulate(script, f"axis.limits.acceleration={acceleration}", "axis.cruise_velocity=90")
    assert max(abs(velocity) for velocity, enabled in seen if not enabled) < 1.0


@pytest.mark.parametrize("stated", [True, False])
def test_after_a_reload_the_end_waits_for_what_the_axes_take_by_then(stated: bool) -> None:
    async def script(world: World) -> None:
        shutdown = world.service.shutdown
        before = shutdown.settings.shutdown_timeout_ms
        slow = load(None, ["axis.limits.acceleration=20"])
        replace_axes(world.parts, [build_axis(slow, world.axis_loop.drive.traits, world.parts.period_s)])
        assert (shutdown.settings.shutdown_timeout_ms > 10.0 * before) is not stated
        assert shutdown.settings.shutdown_timeout_ms == (before if stated else 2.0 * stop_ms(world.axis.design))

    simulate(script, *["service.shutdown_timeout_ms=900"] * stated)


def test_a_service_that_stops_sending_is_stopped_by_the_drive() -> None:
    """What a killed service leaves behind: the drive's own time-out, and a restart that does nothing by itself."""

    async def script(world: World) -> None:
        await world.cruising()
        world.service.ticks.stop()
        await world.seconds(0.05)
        world.axis_loop.bus.link.close()
        await world.seconds(1.0)
        assert not world.drive.enabled
        assert abs(world.drive.velocity) < 0.1

    simulate(script)


def test_a_lost_bus_trips_and_comes_back_disarmed(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        await world.cruising()

        def gone(_: int | None = None) -> list[can.Message]:
            raise LinkError("bus virtual test failed while receiving: unplugged")

        with monkeypatch.context() as patch:
            patch.setattr(world.axis_loop.bus.link, "drain", gone)
            await world.seconds(0.015)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.BUS_FAILED
        assert "unplugged" in world.axis.trip.cause
        await world.seconds(0.5)
        assert not world.drive.enabled
        await world.until(lambda: world.axis.drive.position is not None)
        assert world.state() is State.TRIPPED
        world.axis.reset()
        assert world.state() is State.DISARMED
        await world.seconds(0.5)
        assert not world.drive.enabled
        await world.armed()
        move = world.axis.move_to(0.0, 100.0)
        await world.until(lambda: move.outcome == "reached")

    simulate(script)


def test_a_bus_that_is_not_there_yet_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        attempts = []
        open_link = world.axis_loop.bus.link.open

        def not_yet() -> None:
            attempts.append(1)
            if len(attempts) < 4:
                raise LinkError("no such device")
            open_link()

        monkeypatch.setattr(world.axis_loop.bus.link, "open", not_yet)
        await world.seconds(0.5)
        assert world.loop.snapshot()["bus"] == {
            "channel": "can0", "open": False, "error": "no such device", "drive_state": None, "controller": "active",
            "error_counters": None,
        }  # fmt: skip
        with pytest.raises(Refused, match="no fresh feedback"):
            world.axis.arm()
        await world.seconds(4.0)
        assert len(attempts) == 4
        await world.armed()

    simulate(script)


def test_a_bus_that_opens_and_fails_at_once_is_not_opened_in_every_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a socket on an interface that is down: it opens, and its first read fails."""

    async def script(world: World) -> None:
        await world.armed()
        link = world.axis_loop.bus.link
        opened_at: list[float] = []
        open_link, now_s = link.open, asyncio.get_running_loop().time

        def opened() -> None:
            opened_at.append(now_s())
            open_link()

        monkeypatch.setattr(link, "open", opened)
        world.wire.node("service").fail_to_receive(OSError(100, "Network is down"))
        await world.seconds(5.0)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.BUS_FAILED
        assert len(opened_at) == 5
        assert min(later - one for one, later in itertools.pairwise(opened_at)) > 0.98
        world.wire.node("service").fail_to_receive(None)
        await world.seconds(1.1)
        assert world.axis_loop.bus.error is None
        assert world.state() is State.TRIPPED

    simulate(script)


def test_the_bus_is_looked_after_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """An interface without a carrier takes every command and sends none; only asking shows it."""

    async def script(world: World) -> None:
        await world.armed()
        link = world.axis_loop.bus.link
        looked: list[int] = []
        monkeypatch.setattr(link, "check", lambda: looked.append(1))
        await world.seconds(3.0)
        assert len(looked) == 3
        assert world.state() is State.HOLDING

        def fail() -> None:
            raise LinkError("bus socketcan can0 failed: there is no carrier")

        monkeypatch.setattr(link, "check", fail)
        await world.seconds(1.0)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.BUS_FAILED
        assert "no carrier" in world.axis.trip.cause

    simulate(script)


@pytest.mark.parametrize(
    ("suspended_s", "missed", "trips"),
    [(0.015, 0, False), (0.025, 1, False), (0.035, 2, False), (0.045, 3, True), (0.5, 49, True)],
)
def test_ticks_missed_by_a_suspended_host_are_skipped_and_counted_and_never_made_up_in_a_burst(
    suspended_s: float, missed: int, trips: bool
) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        world.ticks.hold_s = suspended_s
        before = world.service.statistics.count
        await world.seconds(1.0)
        assert world.service.statistics.missed == missed
        assert abs(world.service.statistics.count - before - round((1.0 - suspended_s) / 0.01)) <= 2
        assert (world.axis.trip is not None) == trips
        ticks = [tick for tick, direction, *_ in world.trace if direction == "sent"]
        assert len(ticks) == len(set(ticks))

    simulate(script)


def test_frames_that_cannot_be_used_are_counted_and_bridged() -> None:
    async def script(world: World) -> None:
        await world.cruising()
        identifier = world.profile.feedback_id.identifier
        rejected = {
            "length": [can.Message(arbitration_id=identifier, is_extended_id=False, data=bytes(n)) for n in (0, 7)],
            "checksum": [
                can.Message(arbitration_id=identifier, is_extended_id=False, data=data)
                for data in (bytes(8), bytes(range(8)))
            ],
            "extended": [can.Message(arbitration_id=identifier, is_extended_id=True, data=bytes(8))],
            "remote": [can.Message(arbitration_id=identifier, is_extended_id=False, is_remote_frame=True, dlc=8)],
        }
        with world.wire.attach("intruder") as intruder:
            for message in itertools.chain(*rejected.values()):
                intruder.send(message)
            intruder.send(can.Message(arbitration_id=0x7FF, is_extended_id=False, data=bytes(8)))
            await world.seconds(0.03)
        frames = world.loop.snapshot()["frames"]
        assert frames["rejected"] == 6
        assert frames["rejected_by_reason"] == {reason: len(messages) for reason, messages in rejected.items()}
        await world.until(lambda: world.state() is State.HOLDING)
        assert world.axis.trip is None

    simulate(script)


def test_the_recording_holds_the_ticks_before_the_trip() -> None:
    async def script(world: World) -> None:
        await world.cruising(2000.0)
        await world.seconds(1.0)
        world.axis.raise_trip(TripCode.OVERSPEED, "test")
        await world.seconds(5.0)
        records = world.axis_loop.recorder.records()
        assert len(records) == 200
        assert records[-1].state == State.TRIPPED
        assert [record.state for record in records[:-1]] == [State.SPEED_STAGE] * 199
        assert [b.tick - a.tick for a, b in itertools.pairwise(records)] == [1] * 199

    simulate(script)


def test_a_second_controller_on_the_bus_trips_and_keeps_the_axis_from_arming() -> None:
    """Two masters on one drive would each see a healthy axis and pull at it in turn."""

    async def script(world: World) -> None:
        await world.cruising()
        profile = world.profile
        frame = profile.encode_command(3.0, enable=True, counter=7)
        with world.wire.attach("another controller") as other:
            other.send(can.Message(arbitration_id=profile.command_id.identifier, is_extended_id=False, data=frame))
            await world.seconds(0.02)
            assert world.axis.trip is not None
            assert world.axis.trip.code is TripCode.FOREIGN_COMMAND
            assert frame.hex(" ") in world.axis.trip.cause
            await world.seconds(0.1)
            assert not world.drive.enabled
            world.axis.reset()
            with pytest.raises(Refused, match="another node on the bus commands this drive"):
                world.axis.arm()
            await world.seconds(1.0)
            await world.armed()

    simulate(script)


def test_arming_over_a_closed_bus_says_that_the_bus_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        def fail() -> None:
            raise LinkError("unplugged")

        monkeypatch.setattr(world.axis_loop.bus.link, "open", fail)
        await world.seconds(0.1)
        with pytest.raises(Refused, match="the bus is not open: unplugged"):
            world.requests.handle(ArmRequest())

    simulate(script)


@pytest.mark.parametrize("moving", [False, True])
def test_an_ending_service_takes_no_more_orders(moving: bool) -> None:
    async def script(world: World) -> None:
        await world.armed()
        if moving:
            world.axis.move_to(400.0, 100.0)
            await world.seconds(1.0)
        world.service.shut_down()
        for _ in range(100):
            for request in (ArmRequest(), MoveRequest(position=0.0)):
                with pytest.raises(Refused, match="the service is ending"):
                    world.requests.handle(request)
            assert world.requests.handle(StatusRequest())
            await world.seconds(0.01)
            if world.serving.done():
                break
        assert world.serving.done()
        assert world.state() is State.DISARMED

    simulate(script)


def test_a_send_that_fails_is_a_lost_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        await world.cruising()

        def gone(*_: object) -> bool:
            raise LinkError("bus failed while sending: network is down")

        with monkeypatch.context() as patch:
            patch.setattr(world.axis_loop.bus.link, "send", gone)
            await world.seconds(0.015)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.BUS_FAILED
        assert world.loop.snapshot()["axis"]["position"] is None

    simulate(script)


def test_a_drive_with_an_error_word_alone_trips_the_axis() -> None:
    """Neither a fault bit nor an enabled bit: the code has to do."""

    async def script(world: World) -> None:
        await world.cruising()
        world.drive.change(asyncio.get_running_loop().time(), fault_code=3)
        await world.seconds(0.03)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.DRIVE_FAULT
        assert "3" in world.axis.trip.cause

    simulate(script, "protocol.feedback.fault=false", "protocol.feedback.enabled=false")


def test_feedback_that_has_stopped_is_not_shown_as_the_present(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        assert world.loop.snapshot()["axis"]["position"] == 0.0
        monkeypatch.setattr(world.drive, "cycle", lambda _: [])
        await world.seconds(1.0)
        status = world.loop.snapshot()["axis"]
        assert status["position"] is None
        assert status["feedback_age_ms"] > 900.0

    simulate(script)


def test_a_bus_that_is_being_opened_is_closed_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that opens the bus must not do so after the service has closed it."""

    async def script(world: World) -> None:
        link = world.axis_loop.bus.link
        await world.seconds(0.1)
        opening = asyncio.Event()

        async def slowly() -> None:
            opening.set()
            try:
                await asyncio.sleep(10.0)
            finally:
                link.open()

        link.close()
        monkeypatch.setattr(link, "open_in_thread", slowly)
        await opening.wait()
        world.service.shut_down()
        await world.until(world.serving.done)
        assert not link.is_open

    simulate(script)


def test_how_old_feedback_is_and_how_long_its_answer_takes_is_told_where_it_was_measured() -> None:
    async def script(world: World) -> Any:
        before = world.loop.snapshot()["frames"]
        world.wire.disturb(lambda sender, frame, _: [(0.003 if sender == "drive" else 0.0, frame)])
        await world.seconds(1.0)
        return before, world.loop.snapshot()["frames"]

    before, after = simulate(script)
    assert before["age_us"] is None
    assert before["feedback_to_command_us"] is None
    for name in ("age_us", "feedback_to_command_us"):  # a tick of simulated time takes none
        assert after[name]["p50"] == pytest.approx(7000.0, rel=0.06)
        assert after[name]["max"] == pytest.approx(7000.0, abs=1.0)
