"""A drive that stays enabled, or an axis that moves, though the drive is told to disable: who is told, and how."""

import asyncio
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import structlog

from tests.service.rig import World, simulate
from tests.service.test_several_axes import Plant, axis_page, machine_file, operate
from twostage_servo.api.request_reading import read_request
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode

TIME_OUT_S = 0.5
"""axis.arming_timeout_ms of the demo."""
COASTING = 100.0 / 14.0
NO_ENABLED_BIT = "protocol.feedback.enabled=false"
SLOW_TICK = (
    "service.tick_ms=20",
    "axis.law.performance_index_ratio=2e-4",
    "axis.limits.stale_feedback_ms=60",
)
NO_HEARTBEAT = (
    "protocol.heartbeat.message=false", "protocol.heartbeat.state=false", "protocol.heartbeat.boot_counter=false",
)  # fmt: skip

Logs = list[dict[str, Any]]


def now_s() -> float:
    return asyncio.get_running_loop().time()


def change(world: World, **faults: Any) -> None:
    world.drive.change(now_s(), **faults)


def ask(world: World, **request: Any) -> dict[str, Any]:
    return world.requests.handle(read_request(request), "operator")


def lasting(world: World) -> list[str]:
    return [one["code"] for one in world.loop.snapshot()["drive"]["lasting"]]


def codes(world: World) -> list[str]:
    trip = world.loop.snapshot()["trip"]
    return [] if trip is None else trip["codes"]


async def stuck_after_disarm(world: World) -> float:
    """Disarm an axis whose drive stays enabled with its last effort; return where it was told to disable."""
    await world.cruising(velocity=20.0)
    change(world, stays_enabled=True)
    ask(world, op="disarm")
    await world.until(lambda: world.state() is State.DISARMED)
    return world.drive.position


def test_a_drive_that_stays_enabled_after_disarm_trips_and_is_told_everywhere_for_as_long_as_it_lasts() -> None:
    async def script(world: World) -> None:
        with structlog.testing.capture_logs() as logs:
            place = await stuck_after_disarm(world)
            change(world, load=-1.0)  # which the drive's last effort does not hold
            told_s = now_s()
            assert ask(world, op="status")["drive"]["disabling"] is True
            await world.until(lambda: world.axis.trip is not None)
            assert now_s() - told_s == pytest.approx(TIME_OUT_S, abs=0.06)
            assert (world.state(), codes(world)) == (State.TRIPPED, ["drive_not_disabled"])
            await world.seconds(25.0)
        told = ask(world, op="status")["drive"]
        assert (told["enabled"], told["disabling"]) == (True, False)
        (one,) = told["lasting"]
        assert one["code"] == "drive_not_disabled"
        moved = world.drive.position - place
        assert abs(moved) > 100.0
        assert told["moved"] == pytest.approx(moved, abs=5.0)
        assert f"moved by {told['moved']:+.4g} mm" in one["cause"]
        assert "arming_timeout_ms is 500" in one["cause"]
        line = world.line()
        assert "x tripped (drive_not_disabled)" not in line  # the distance stands between
        assert "(drive_not_disabled): the drive was told to disable" in line
        assert "while disabled" in line
        repeated = [log for log in logs if log["event"] == "the cause of the trip lasts"]
        assert [log["code"] for log in repeated] == ["drive_not_disabled"] * 2
        motion = [log for log in logs if "moves although its drive was told" in log["event"]]
        assert 2 <= len(motion) <= 4
        assert all(command.enable is False for tick, command in world.sent()[-100:])
        with pytest.raises(Refused, match="that it is enabled") as refused:
            ask(world, op="reset")
        assert refused.value.code == "drive_not_disabled"
        for request in ({"op": "arm"}, {"op": "stop"}, {"op": "move", "position": 0.0}):
            with pytest.raises(Refused, match="drive_not_disabled") as refused:
                ask(world, **request)
            assert refused.value.code == "tripped"
        # It comes off: what lasted is over, the trip is not.
        change(world, stays_enabled=False, load=0.0)
        await world.until(lambda: not lasting(world), 0.1)
        assert world.axis.trip is not None
        ask(world, op="reset")
        assert world.state() is State.DISARMED
        await world.armed()
        assert world.loop.snapshot()["drive"]["moved"] is None

    simulate(script)


def foreign(world: World) -> None:
    world.axis.record_foreign_command("0x201")


def sto_is_told(world: World) -> None:
    world.axis.raise_trip(TripCode.SAFE_TORQUE_OFF, "the drive reports that safe torque off is active")


def quick(world: World) -> None:
    world.axis.raise_trip(TripCode.STALL, "it does not move")


@pytest.mark.parametrize("trip", [foreign, sto_is_told, quick])
def test_a_trip_that_was_there_already_does_not_hide_it(trip: Callable[[World], None]) -> None:
    async def script(world: World) -> None:
        await world.cruising(velocity=20.0)
        change(world, stays_enabled=True)
        trip(world)
        assert world.axis.trip is not None
        first = world.axis.trip
        await world.until(lambda: TripCode.DRIVE_NOT_DISABLED in world.axis.trips, 2.0)
        assert world.axis.trip is first
        assert world.axis.escalation is world.axis.trips[TripCode.DRIVE_NOT_DISABLED]
        assert lasting(world) == ["drive_not_disabled"]
        line = world.line()
        assert f"({first.code})" in line
        assert "Besides (drive_not_disabled): the drive was told" in line
        with pytest.raises(Refused, match="told to disable"):
            ask(world, op="reset")
        with pytest.raises(Refused, match=r"tripped \(drive_not_disabled\)"):
            ask(world, op="arm")

    simulate(script)


def test_a_reset_within_the_drives_time_does_not_begin_it_anew() -> None:
    async def script(world: World) -> None:
        await world.cruising(velocity=20.0)
        change(world, stays_enabled=True)
        sto_is_told(world)
        told_s = now_s()
        await world.seconds(0.4)
        ask(world, op="reset")
        assert world.state() is State.DISARMED
        await world.until(lambda: world.axis.trip is not None)
        assert now_s() - told_s == pytest.approx(TIME_OUT_S, abs=0.06)
        assert codes(world) == ["drive_not_disabled"]

    simulate(script)


@pytest.mark.parametrize("overrides", [(), (NO_ENABLED_BIT,)], ids=["with the bit", "by its heartbeat"])
def test_a_drive_that_is_enabled_when_the_service_starts_is_told(overrides: tuple[str, ...]) -> None:
    async def script(world: World) -> None:
        change(world, stays_enabled=True)
        await world.until(lambda: world.axis.trip is not None, 2.0)
        assert (world.state(), codes(world)) == (State.TRIPPED, ["drive_not_disabled"])
        assert now_s() > TIME_OUT_S
        assert not any(command.enable for _, command in world.sent())

    simulate(script, *overrides)


def test_a_drive_that_enables_itself_while_the_axis_is_disarmed_or_tripped_is_told() -> None:
    async def script(world: World) -> None:
        await world.armed()
        ask(world, op="disarm")
        await world.seconds(10.0)
        assert world.axis.trip is None
        change(world, stays_enabled=True)
        await world.until(lambda: world.axis.trip is not None, 1.0)
        change(world, stays_enabled=False)
        await world.seconds(1.0)
        ask(world, op="reset")
        await world.armed()
        quick(world)
        await world.seconds(10.0)
        assert codes(world) == ["stall"]
        change(world, stays_enabled=True)
        await world.seconds(1.0)
        assert codes(world) == ["stall", "drive_not_disabled"]

    simulate(script)


def test_a_drive_that_comes_on_again_and_again_is_told() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        for _ in range(4):
            change(world, stays_enabled=True)
            await world.seconds(0.2)
            change(world, stays_enabled=False)
            await world.seconds(0.2)
        assert codes(world) == ["drive_not_disabled"]

    simulate(script)


def test_a_drive_that_is_on_for_a_moment_every_ten_seconds_is_not() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        for _ in range(4):
            change(world, stays_enabled=True)
            await world.seconds(0.2)
            change(world, stays_enabled=False)
            await world.seconds(10.0)
        assert codes(world) == []

    simulate(script)


def test_it_is_told_after_the_bus_has_come_back() -> None:
    async def script(world: World) -> None:
        await world.cruising(velocity=20.0)
        change(world, stays_enabled=True)
        world.wire.node("service").fail_to_receive(OSError(100, "Network is down"))
        await world.until(lambda: world.axis.trip is not None)
        await world.seconds(3.0)
        assert codes(world) == ["bus_failed"]  # nobody hears it, so nothing is known of it
        world.wire.node("service").fail_to_receive(None)
        await world.until(lambda: world.axis_loop.bus.error is None)
        await world.seconds(1.0)
        assert codes(world) == ["bus_failed", "drive_not_disabled"]

    simulate(script)


@pytest.mark.parametrize("bus_ends", [False, True])
@pytest.mark.parametrize("overrides", [(), SLOW_TICK], ids=["10 ms", "20 ms"])
def test_a_drive_that_falls_silent_while_it_is_enabled_is_told_until_it_reports_that_it_is_off(
    bus_ends: bool, overrides: tuple[str, ...]
) -> None:
    """`reset` clears the trip, and must not hide that nobody knows whether the drive is off."""

    async def script(world: World) -> None:
        with structlog.testing.capture_logs() as logs:
            await world.cruising(velocity=20.0)
            world.wire.disturb(lambda sender, message, _: [] if sender == "drive" else [(0.0, message)])
            if bus_ends:
                world.wire.node("service").fail_to_receive(OSError(100, "Network is down"))
            await world.until(lambda: world.state() is State.TRIPPED)
            await world.seconds(1.0)
            ask(world, op="reset")
            await world.seconds(21.0)
            told = ask(world, op="status")
            assert (told["axis"]["state"], told["trip"]) == ("disarmed", None)
            (one,) = told["drive"]["lasting"]
            assert one["code"] == "stale_feedback"
            assert (
                "the last that it has reported is that it is enabled, and nobody knows whether it is off"
                in one["cause"]
            )
            assert "look at it" in one["cause"]
            assert "nobody knows whether it is off" in world.line()
            repeated = [log for log in logs if log["event"] == "a condition lasts that has not tripped the axis"]
            assert [log["code"] for log in repeated] == ["stale_feedback"] * len(repeated)
            assert len(repeated) >= 2
            world.wire.restore()
            world.wire.node("service").fail_to_receive(None)
            await world.until(lambda: not ask(world, op="status")["drive"]["lasting"])
            assert ask(world, op="status")["drive"]["enabled"] is False

    simulate(script, *overrides)


@pytest.mark.parametrize("overrides", [(), (NO_ENABLED_BIT, *NO_HEARTBEAT)], ids=str)
def test_a_drive_that_falls_silent_while_it_is_disabled_is_not(overrides: tuple[str, ...]) -> None:
    """Nor is one that never tells: of that nobody ever knows more."""

    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        world.wire.disturb(lambda sender, message, _: [] if sender == "drive" else [(0.0, message)])
        await world.seconds(3.0)
        assert ask(world, op="status")["drive"]["lasting"] == []

    simulate(script, *overrides)


def test_what_is_known_outlives_the_bus() -> None:
    async def script(world: World) -> None:
        await stuck_after_disarm(world)
        await world.until(lambda: world.axis.trip is not None)
        world.wire.node("service").fail_to_receive(OSError(100, "Network is down"))
        await world.seconds(3.0)
        assert world.axis_loop.bus.error is not None
        with pytest.raises(Refused, match="told to disable"):
            ask(world, op="reset")

    simulate(script)


def test_a_drive_that_has_lost_its_encoder_is_told_as_well() -> None:
    async def script(world: World) -> None:
        await world.cruising(velocity=20.0)
        change(world, stays_enabled=True, measure=lambda _: math.nan)
        await world.until(lambda: world.state() is State.TRIPPED)
        await world.seconds(1.0)
        assert "drive_not_disabled" in codes(world)

    simulate(script)


def test_a_service_that_ends_waits_for_the_drive_and_says_so_if_it_was_not_seen_off() -> None:
    async def script(world: World) -> None:
        await world.cruising(velocity=20.0)
        change(world, stays_enabled=True)
        with structlog.testing.capture_logs() as logs:
            begun_s = now_s()
            world.service.shut_down()
            await world.serving
        assert TIME_OUT_S < now_s() - begun_s < 2.0
        assert world.service.shutdown.not_disabled == ["x"]
        assert codes(world) == ["drive_not_disabled"]
        (told,) = [log for log in logs if "did not report that it is disabled" in log["event"]]
        assert (told["log_level"], told["axis"], told["code"]) == ("error", "x", "drive_not_disabled")
        assert told["told_ms"] > 500.0
        assert "moved" in told

    simulate(script)


@pytest.mark.parametrize("armed", [False, True])
def test_a_service_that_ends_does_not_wait_for_a_drive_that_obeys(*, armed: bool) -> None:
    async def script(world: World) -> None:
        if armed:
            await world.armed()
        else:
            await world.until(lambda: world.axis.ready_to_arm)
        begun_s = now_s()
        world.service.shut_down()
        await world.serving
        assert now_s() - begun_s < 0.06
        assert world.service.shutdown.not_disabled == []

    simulate(script)


def test_a_service_that_ends_does_not_wait_for_a_drive_that_is_silent() -> None:
    async def script(world: World) -> None:
        await world.cruising(velocity=20.0)
        world.wire.disturb(lambda sender, message, _: [] if sender == "drive" else [(0.0, message)])
        await world.until(lambda: world.state() is State.TRIPPED)
        begun_s = now_s()
        world.service.shut_down()
        await world.serving
        assert now_s() - begun_s < 0.1
        assert world.service.shutdown.not_disabled == ["x"]  # the last that it said was that it is enabled

    simulate(script)


@pytest.mark.parametrize(("armed", "named"), [(True, ["x"]), (False, [])])
def test_a_service_whose_bus_takes_no_command_at_its_end_names_the_drive_that_it_had_enabled(
    *, armed: bool, named: list[str]
) -> None:
    """A drive that does not report its state is known from nothing but what it was told."""

    async def script(world: World) -> None:
        if armed:
            await world.armed()
        else:
            await world.until(lambda: world.axis.ready_to_arm)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(world.axis_loop.bus.link, "send", lambda _: False)
            world.service.shut_down()
            await world.serving
        assert world.service.shutdown.not_disabled == named

    simulate(script, NO_ENABLED_BIT, *NO_HEARTBEAT)


@pytest.mark.parametrize("policy", ["stop", "quick_stop", "disarm", "continue"])
def test_the_other_axes_react(tmp_path: Path, policy: str) -> None:
    path = machine_file(
        tmp_path,
        {"x": axis_page("x", "can0"), "y": axis_page("y", "can0", offset=1)},
        f'fault_reaction = "{policy}"\n',
    )

    async def script(plant: Plant) -> None:
        await plant.armed()
        plant.ask(op="disarm", axis="x")
        await plant.until(lambda: plant.axis("x").ready_to_arm)
        plant.ask(op="move", axis="y", position=2000.0, velocity=50.0)
        plant.drives["x"].change(now_s(), stays_enabled=True)
        await plant.until(lambda: plant.axis("x").trip is not None, 2.0)
        await plant.until(lambda: plant.axis("y").state not in {State.STOPPING, State.QUICK_STOPPING, State.DISARMING})
        expected = {"disarm": State.DISARMED, "continue": State.SPEED_STAGE}.get(policy, State.HOLDING)
        assert plant.axis("y").state is expected
        # A trip that was there already does not spare the others.
        if policy == "stop":
            plant.ask(op="move", axis="y", position=-2000.0, velocity=50.0)
            plant.drives["x"].change(now_s(), stays_enabled=False)
            await plant.until(lambda: not plant.axis("x").lasting)
            plant.ask(op="reset", axis="x")
            plant.ask(op="arm", axis="x")
            await plant.until(lambda: plant.axis("x").state is State.HOLDING)
            plant.axis("x").raise_trip(TripCode.STALL, "it does not move")
            await plant.until(lambda: plant.axis("y").state is State.HOLDING)
            plant.ask(op="move", axis="y", position=2000.0, velocity=50.0)
            plant.drives["x"].change(now_s(), stays_enabled=True)
            await plant.until(lambda: plant.axis("y").state is State.HOLDING, 2.0)

    operate(path, script)


# Motion ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("overrides", [(), (NO_ENABLED_BIT,), (NO_ENABLED_BIT, *NO_HEARTBEAT)], ids=str)
def test_an_axis_that_moves_while_its_drive_is_off_is_told_and_does_not_trip(overrides: tuple[str, ...]) -> None:
    async def script(world: World) -> None:
        await world.armed()
        ask(world, op="disarm")
        await world.seconds(1.0)
        assert world.loop.snapshot()["drive"]["moved"] is None
        place = world.drive.position
        with structlog.testing.capture_logs() as logs:
            change(world, effort_while_disabled=0.1)  # 1.3 mm/s: a hand, a weight, or a power stage that leaks
            await world.seconds(10.0)
        moved = world.drive.position - place
        told = world.loop.snapshot()["drive"]
        assert told["moved"] == pytest.approx(moved, abs=0.6)
        assert told["lasting"] == []
        assert f"moved by {told['moved']:+.3g} mm while disabled" in world.line()
        (log,) = [log for log in logs if "moves although its drive was told" in log["event"]]
        assert (log["log_level"], log["unit"]) == ("warning", "mm")
        assert 0.5 < log["moved"] < 0.6
        assert world.axis.trip is None
        change(world, effort_while_disabled=0.0)
        await world.armed()
        assert "disabled" not in world.line()

    simulate(script, *overrides)


MANNERS = {
    "demo": (),
    "a wide gate": ("axis.limits.innovation_gate=5",),
    "noise": ("simulation.noise_std=0.0316",),
    "free-running": ('protocol.feedback.sampling="cyclic"', 'simulation.feedback="cyclic"'),
    "off its model": ("simulation.pole=10.5", "simulation.gain=230"),
    "no bit": (NO_ENABLED_BIT,),
}


@pytest.mark.parametrize("manner", MANNERS)
@pytest.mark.parametrize("velocity", [5.0, 100.0, 250.0])
def test_coasting_from_a_drive_that_is_disabled_at_speed_is_no_motion_to_be_told(manner: str, velocity: float) -> None:
    async def script(world: World) -> None:
        await world.armed()
        world.axis.move_to(2400.0, velocity)
        await world.seconds(1.2)
        assert world.drive.velocity > 0.9 * velocity
        place = world.drive.position
        sto_is_told(world)
        await world.seconds(5.0)
        assert world.drive.position - place > 0.9 * velocity / 14.0
        assert world.loop.snapshot()["drive"]["moved"] is None
        assert codes(world) == ["safe_torque_off"]

    simulate(script, *MANNERS[manner])


TICKS = {
    1.0: (
        "axis.law.performance_index_ratio=5e-7",
        "axis.limits.stale_feedback_ms=15",
        "axis.limits.missed_ticks=5",
        "axis.observer.measurement_variance=3e-4",
    ),
    5.0: ("axis.law.performance_index_ratio=1e-5",),
    10.0: (),
    20.0: ("axis.law.performance_index_ratio=2e-4", "axis.limits.stale_feedback_ms=60"),
    50.0: (
        "axis.law.performance_index_ratio=2e-3",
        "axis.limits.stale_feedback_ms=200",
        "axis.limits.innovation_gate=2",
        "axis.limits.undetected_travel=50",
    ),
    100.0: (
        "axis.law.performance_index_ratio=2e-3",
        "axis.limits.stale_feedback_ms=400",
        "axis.limits.innovation_gate=4",
        "axis.limits.undetected_travel=100",
    ),
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("tick_ms", "heartbeat_ms", "bit"),
    [*((tick_ms, heartbeat_ms, True) for tick_ms in TICKS for heartbeat_ms in (5.0, 290.0)), (10.0, 100.0, False)],
)
def test_arming_and_disarming_at_any_moment_is_no_false_alarm(
    tick_ms: float, heartbeat_ms: float, *, bit: bool
) -> None:
    overrides = [f"service.tick_ms={tick_ms}", f"simulation.heartbeat_ms={heartbeat_ms}", *TICKS[tick_ms]]
    overrides += [f"simulation.command_timeout_ms={max(100.0, 5 * tick_ms)}", *([] if bit else [NO_ENABLED_BIT])]
    overrides += [f"simulation.feedback_period_ms={tick_ms}"]

    async def script(world: World) -> None:
        for n in range(12):
            await world.until(lambda: world.axis.ready_to_arm)
            world.axis.arm()
            await world.seconds(0.037 * (n % 7) + 0.25)
            assert world.axis.trip is None, world.axis.trip
            world.axis.disarm()
            await world.seconds(0.041 * (n % 11))
            assert world.axis.trip is None, world.axis.trip
            assert not world.axis.lasting

    simulate(script, *overrides)


# Heartbeat and feedback -----------------------------------------------------------------------------------------------

CIA402 = {"not ready": 0, "ready": 1, "switched on": 2, "enabled": 3, "fault": 4, "reaction": 5, "quick": 6, "off": 7}


@pytest.mark.parametrize("said", ["not ready", "ready", "off", "fault", "reaction"])
def test_a_heartbeat_that_contradicts_an_enabled_drive_trips(said: str) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        change(world, heartbeat_state=CIA402[said])
        begun_s = now_s()
        await world.until(lambda: world.axis.trip is not None, 2.0)
        assert 0.3 <= now_s() - begun_s <= 0.45  # heartbeat_ms is 300, and one comes every 100
        assert (world.state(), codes(world)) == (State.TRIPPED, ["drive_state_mismatch"])
        assert "heartbeat has said" in world.axis.trip.cause  # type: ignore[union-attr]
        assert "its feedback has said enabled without a fault" in world.axis.trip.cause  # type: ignore[union-attr]

    simulate(script)


@pytest.mark.parametrize("said", ["enabled", "fault", "reaction"])
def test_a_heartbeat_that_contradicts_a_disabled_drive_trips_and_lasts(said: str) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        change(world, heartbeat_state=CIA402[said])
        await world.until(lambda: world.axis.trip is not None, 2.0)
        assert (world.state(), codes(world)) == (State.TRIPPED, ["drive_state_mismatch"])
        assert lasting(world) == ["drive_state_mismatch"]
        with pytest.raises(Refused, match="its feedback has said disabled without a fault") as refused:
            ask(world, op="reset")
        assert refused.value.code == "drive_state_mismatch"
        change(world, heartbeat_state=None)
        await world.seconds(0.2)
        ask(world, op="reset")
        await world.armed()

    simulate(script)


@pytest.mark.parametrize("said", ["switched on", "quick"])
def test_a_state_that_differs_from_drive_to_drive_contradicts_nothing(said: str) -> None:
    async def script(world: World) -> None:
        await world.armed()
        change(world, heartbeat_state=CIA402[said])
        await world.seconds(5.0)
        ask(world, op="disarm")
        await world.seconds(5.0)
        assert world.axis.trip is None

    simulate(script)


def test_a_drive_without_the_signal_is_not_compared() -> None:
    async def script(world: World) -> None:
        await world.armed()
        change(world, heartbeat_state=CIA402["fault"])
        await world.seconds(5.0)
        assert world.axis.trip is None

    simulate(script, "protocol.heartbeat.state=false")


def test_a_drive_without_the_enabled_bit_that_has_dropped_out_is_told_by_its_heartbeat() -> None:
    async def script(world: World) -> None:
        await world.armed()
        await world.seconds(1.0)
        change(world, heartbeat_state=CIA402["ready"])
        await world.until(lambda: world.axis.trip is not None, 2.0)
        assert codes(world) == ["drive_state_mismatch"]

    simulate(script, NO_ENABLED_BIT)


def test_one_heartbeat_or_two_that_are_behind_contradict_nothing() -> None:
    async def script(world: World) -> None:
        await world.cruising()
        for _ in range(10):
            change(world, heartbeat_state=CIA402["fault"])
            await world.seconds(0.2)
            change(world, heartbeat_state=None)
            await world.seconds(0.1)
        assert world.axis.trip is None

    simulate(script)
