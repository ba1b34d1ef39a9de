"""What becomes of the axis when this program itself is at fault, or the bus does not take its commands."""

import itertools
from collections.abc import Callable
from typing import Any

import can
import pytest

from tests.service.rig import World, simulate
from twostage_servo.axis.messages import Command
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode

QUANTUM = 0.001  # of the effort in the shipped DBC
RATE_A_TICK = 1000.0 * 0.01  # axis.limits.effort_rate, in V
QUICK_STOP_DISTANCE = 100.0**2 / (2.0 * 4000.0)
QUICK_STOP_TICKS = 100.0 / 4000.0 / 0.01

# Where in the tick the defect shows: the part of the service, and what it calls there.
PLACES: dict[str, Callable[[World], tuple[Any, str]]] = {
    "read": lambda world: (world.axis_loop.receiver, "deliver"),
    "update": lambda world: (world.axis, "step"),
    "write": lambda world: (world.axis_loop.drive, "encode"),
    "publish": lambda world: (world.axis_loop.recorder, "add"),
}


class DefectError(Exception):
    pass


def breaking(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, times: float) -> DefectError:
    """Let something fail so many times; return the first failure."""
    works = getattr(owner, name)
    first = DefectError(f"{name} is broken")
    count = itertools.count(1)

    def broken(*arguments: Any, **options: Any) -> Any:
        number = next(count)
        if number <= times:
            raise first if number == 1 else DefectError(f"{name} is broken for the {number}. time")
        return works(*arguments, **options)

    # The profile is immutable, and the recorder has slots.
    monkeypatch.setattr(owner if hasattr(owner, "__dict__") else type(owner), name, broken)
    return first


def from_tick(commands: list[tuple[int, Command]], tick: int) -> list[Command]:
    return [command for at, command in commands if at > tick]


@pytest.mark.parametrize("place", PLACES)
def test_a_defect_in_mid_move_is_a_quick_stop_and_comes_out(monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        before, position = world.ticks._index, world.drive.position
        defect = breaking(monkeypatch, *PLACES[place](world), times=1)
        with pytest.raises(DefectError) as caught:
            await world.serving
        assert caught.value is defect
        await world.seconds(0.005)
        assert not world.drive.enabled
        assert world.drive.fault_code == 0  # it was told, it did not have to notice
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.INTERNAL_ERROR
        assert "DefectError" in world.axis.trip.cause
        assert "is broken" in world.axis.trip.cause
        assert world.state() is State.TRIPPED
        assert world.axis.escalation is None
        assert world.axis.move is not None
        assert world.axis.move.outcome == "tripped"
        # Braked at the quick stop's ramp, neither coasted (7 mm) nor went on; a tick and a half at 100 mm/s until then.
        assert QUICK_STOP_DISTANCE < world.drive.position - position < QUICK_STOP_DISTANCE + 4.0
        assert abs(world.drive.velocity) < 3.0
        commands = from_tick(world.sent(), before)
        assert sum(bool(command.enable) for command in commands) >= QUICK_STOP_TICKS
        assert [(command.effort, command.enable) for command in commands[-3:]] == [(0.0, False)] * 3
        efforts = [command.effort for command in commands if command.enable]
        steps = [abs(after - before) for before, after in itertools.pairwise(efforts)]
        assert max(steps) <= 2.0 * RATE_A_TICK + QUANTUM  # a tick may be missing between two
        assert not world.axis_loop.bus.link.is_open

    simulate(script)


@pytest.mark.parametrize("place", ["read", "update"])
def test_a_second_defect_disables_at_once(monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        tick = world.ticks._index
        defect = breaking(monkeypatch, *PLACES[place](world), times=2)
        with pytest.raises(DefectError) as caught:
            await world.serving
        assert caught.value is defect
        assert world.ticks._index == tick + 2
        await world.seconds(0.005)
        assert not world.drive.enabled
        assert world.drive.fault_code == 0
        assert not world.axis_loop.bus.link.is_open

    simulate(script)


def test_commands_that_cannot_be_made_any_more_leave_the_stop_to_the_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        breaking(monkeypatch, *PLACES["write"](world), times=float("inf"))
        with pytest.raises(DefectError):
            await world.serving
        assert not world.axis_loop.bus.link.is_open
        await world.seconds(0.2)
        assert not world.drive.enabled
        assert world.drive.counters.command_timeouts == 1

    simulate(script)


@pytest.mark.parametrize("where", ["publisher", "after the tick"])
def test_a_publisher_that_fails_for_good_does_not_spoil_the_stop(where: str) -> None:
    """Nor does what is done in the idle time."""

    async def script(world: World) -> None:
        await world.cruising()
        position = world.drive.position

        def broken(*_: object) -> None:
            raise DefectError("for good")

        if where == "publisher":
            world.loop.listen(broken)
        else:
            world.parts.background.open = broken  # type: ignore[method-assign,assignment]
        with pytest.raises(DefectError):
            await world.serving
        assert QUICK_STOP_DISTANCE < world.drive.position - position < QUICK_STOP_DISTANCE + 4.0
        assert world.state() is State.TRIPPED

    simulate(script)


def test_a_defect_while_disarmed_ends_the_service_as_well() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)

        def broken(_: object) -> None:
            raise DefectError

        world.loop.listen(broken)
        tick = world.ticks._index
        with pytest.raises(DefectError):
            await world.serving
        assert world.ticks._index <= tick + 4
        assert not any(command.enable for _, command in world.sent())

    simulate(script)


def test_a_braking_service_takes_no_more_orders_after_a_defect(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        breaking(monkeypatch, *PLACES["update"](world), times=1)
        await world.seconds(0.02)
        assert world.service.shutdown.is_ending
        assert world.state() is State.TRIPPED_QUICK_STOP
        snapshot = world.loop.snapshot()
        assert snapshot["trip"]["code"] == "internal_error"
        assert snapshot["trip"]["reaction"] == "quick_stop"
        assert snapshot["axis"]["cia402"] == "fault reaction active"

    simulate(script)


# Commands that the bus does not take ----------------------------------------------------------------------------------


def full(world: World, pattern: Callable[[int], bool]) -> None:
    """Let the transmit buffer be full in the ticks from now on for which the pattern says so."""
    node, first = world.wire.node("service"), world.ticks._index + 1

    def set_for_the_next(_: object) -> None:
        number = world.ticks._index + 1 - first
        node.fail_to_send(can.CanOperationError("Transmit buffer full") if pattern(number) else None)

    world.loop.listen(set_for_the_next)


def test_one_command_that_is_dropped_is_bridged_and_counted() -> None:
    async def script(world: World) -> None:
        await world.cruising()
        full(world, lambda number: number in {1, 3, 5, 50, 52})
        await world.until(lambda: world.state() is State.HOLDING)
        assert world.axis.trip is None
        assert world.loop.snapshot()["frames"]["dropped"] == 5
        ticks = [tick for tick, _ in world.sent()]
        assert len(ticks) == len(set(ticks))  # the newest only: what was dropped is not sent later
        assert world.drive.position == pytest.approx(400.0, abs=0.06)

    simulate(script)


def test_the_axis_knows_how_late_its_last_command_left_and_that_a_dropped_one_never_did() -> None:
    told: list[float] = []

    async def script(world: World) -> None:
        await world.cruising()
        begin = world.axis.begin_tick

        def listen(tick: int, missed: int, late_s: float = 0.0) -> None:
            told.append(late_s)
            begin(tick, missed, late_s)

        world.axis.begin_tick = listen
        full(world, lambda number: number == 3)
        await world.until(lambda: len(told) == 8)

    simulate(script)
    period_s = 0.01
    assert [round(late_s / period_s, 6) for late_s in told].count(1.0) == 1
    assert sorted(told)[:-1] == pytest.approx([0.0] * (len(told) - 1), abs=1e-9)


def test_two_commands_in_a_row_that_are_dropped_trip() -> None:
    async def script(world: World) -> None:
        await world.cruising()
        position = world.drive.position
        full(world, lambda number: number in {1, 2})
        await world.until(lambda: world.axis.trip is not None)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.COMMANDS_DROPPED
        assert "2 commands in a row" in world.axis.trip.cause
        assert world.state() is State.TRIPPED_QUICK_STOP
        await world.until(lambda: world.state() is State.TRIPPED)
        assert world.axis.escalation is None
        # Three ticks go by before the ramp begins.
        assert world.drive.position - position < 3.0 + 2.0 + QUICK_STOP_DISTANCE + 2.0
        world.axis.reset()
        await world.armed()

    simulate(script)


def test_a_bus_that_stays_full_ends_in_the_drives_own_time_out() -> None:
    async def script(world: World) -> None:
        await world.cruising()
        full(world, lambda number: number < 100)
        await world.until(lambda: not world.drive.enabled)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.COMMANDS_DROPPED
        assert world.drive.counters.command_timeouts == 1
        await world.until(lambda: world.state() is State.TRIPPED)
        world.axis.reset()
        await world.seconds(2.0)
        assert not world.drive.enabled  # nothing moves without `arm`
        await world.armed()

    simulate(script)
