"""The lines of the log, whole: what an operator or a collector of logs finds in them."""

import asyncio
import errno
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pytest
import structlog

from tests.service.operators import connect, serve
from tests.service.rig import BUS, World, simulate
from twostage_servo.axis.trips import Trip, TripCode
from twostage_servo.canbus.link import Link, LinkError
from twostage_servo.service.bus_connection import BusConnection
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.service.listening_socket import ListeningSocket
from twostage_servo.telemetry.trip_files import TripFiles
from twostage_servo.timing.ticks import Tick

Lines = Iterable[Mapping[str, Any]]


def of(logs: Lines, *events: str) -> list[dict[str, Any]]:
    """Return the lines of some events, in their order."""
    return [dict(line) for line in logs if line["event"] in events]


# An axis --------------------------------------------------------------------------------------------------------------


def test_each_trip_of_an_axis_is_told_with_all_that_is_known_of_it() -> None:
    codes = [TripCode.SPEED_UNREACHABLE, TripCode.FOLLOWING_ERROR, TripCode.MISSED_TICKS, TripCode.DRIVE_FAULT]

    async def script(world: World) -> list[Trip]:
        await world.cruising()
        for code in codes:
            world.axis.raise_trip(code, f"cause of {code}")
            await world.seconds(0.011)
        return list(world.axis.trips.values())

    with structlog.testing.capture_logs() as logs:
        first, *later = simulate(script)
    told, *others = of(logs, "trip", "further trip", "more severe trip")
    assert 0 <= told.pop("tick") - first.tick <= 2
    assert told == {
        "event": "trip", "log_level": "error", "axis": "x", "code": "speed_unreachable",
        "cause": "cause of speed_unreachable", "next_action": first.next_action,
    }  # fmt: skip
    assert [line.pop("event") for line in others] == ["more severe trip", "further trip", "more severe trip"]
    assert others == [
        {"log_level": "error", "axis": "x", "tick": one.tick, "code": code, "cause": f"cause of {code}"}
        for one, code in zip(later, codes[1:], strict=True)
    ]


def test_what_changes_on_an_axis_is_told_with_its_tick() -> None:
    async def script(world: World) -> int:
        await world.until(lambda: world.axis.ready_to_arm)
        world.axis.set_position(10.0)
        await world.seconds(0.05)
        await world.armed()
        await world.seconds(0.5)
        world.axis.raise_trip(TripCode.DRIVE_REBOOTED, "test")
        await world.seconds(0.1)
        world.drive.change(asyncio.get_running_loop().time(), frozen_counter=True)
        await world.seconds(1.0)
        world.drive.change(asyncio.get_running_loop().time(), frozen_counter=False)
        await world.seconds(1.0)
        return world.service.statistics.count

    with structlog.testing.capture_logs() as logs:
        ticks = simulate(script, "axis.homing.required=true")
    told = of(
        logs, "state", "feedback fresh", "feedback stale", "the position is known",
        "the position is no longer known: home the axis",
    )  # fmt: skip
    at = [line.pop("tick") for line in told]
    assert at == sorted(at)
    assert 0 <= at[0] < 5
    assert ticks - 210 < at[-2] < at[-1] <= ticks
    assert {line.pop("axis") for line in told} == {"x"}
    assert told == [
        {"event": "feedback fresh", "log_level": "info"},
        {"event": "the position is known", "log_level": "info"},
        {"event": "state", "log_level": "info", "before": "disarmed", "now": "arming"},
        {"event": "state", "log_level": "info", "before": "arming", "now": "holding"},
        {"event": "state", "log_level": "info", "before": "holding", "now": "tripped"},
        {
            "event": "the position is no longer known: home the axis", "log_level": "warning",
            "reason": "drive_rebooted: the encoder restarts its count",
        },
        {"event": "feedback stale", "log_level": "warning"},
        {"event": "feedback fresh", "log_level": "warning"},  # again: the end of what was warned of
    ]  # fmt: skip


@pytest.mark.parametrize("to_a_file", [False, True])
def test_a_recording_for_which_there_is_no_memory_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *, to_a_file: bool
) -> None:
    def none_left(_: object) -> None:
        raise MemoryError

    async def script(world: World) -> None:
        await world.armed()
        if to_a_file:
            world.loop.trip_files.use(TripFiles(tmp_path))
        monkeypatch.setattr(type(world.axis_loop.recorder), "keep", none_left)
        world.axis.raise_trip(TripCode.STALL, "test")
        await world.seconds(0.1)
        error = world.loop.snapshot()["trip"]["file_error"]
        assert error == (why if to_a_file else None)

    why = f"no trip file can be written in {tmp_path}: out of memory"
    with structlog.testing.capture_logs() as logs:
        simulate(script)
    told = of(logs, "no recording of the trip: out of memory", "no trip file")
    of_the_trip = {"log_level": "error", "axis": "x", "code": "stall"}
    assert told == (
        [{"event": "no trip file", "room": "trip_files", "error": why, **of_the_trip}]
        if to_a_file
        else [{"event": "no recording of the trip: out of memory", **of_the_trip}]
    )


# A bus ----------------------------------------------------------------------------------------------------------------


def tick(index: int) -> Tick:
    return Tick(index, 0.01 * index, 0.0, 0)


def test_what_a_bus_loses_is_told_once_a_second_with_what_is_new_and_the_total(monkeypatch: pytest.MonkeyPatch) -> None:
    link = Link(BUS, [])
    monkeypatch.setattr(link, "check", lambda: None)
    with structlog.testing.capture_logs() as logs:
        bus = BusConnection(link, 0.01)
        bus.error = None
        bus.look_after(tick(0))
        for second, total in ((1, 3), (2, 3), (3, 10)):
            link.counters.rejected = link.counters.overflowed = link.counters.overruns = total
            bus.look_after(tick(100 * second - 1))
            bus.look_after(tick(100 * second))
    common = {"log_level": "warning", "bus": "can0"}
    counted = [{"tick": 100, "new": 3, "total": 3}, {"tick": 300, "new": 7, "total": 10}]
    full = "more frames arrive than a tick reads: those that have to wait do not count as fresh"
    most = {"frames_a_tick": BUS.frames_read(0.01)}
    assert of(logs, "frames rejected") == [{"event": "frames rejected", **common, **one} for one in counted]
    assert of(logs, "frames were lost in the kernel before they were read") == [
        {"event": "frames were lost in the kernel before they were read", **common, **one} for one in counted
    ]
    assert of(logs, full) == [{"event": full, **common, **one, **most} for one in counted]
    assert len(logs) == 6


def test_a_controller_that_changes_its_state_is_told_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    link = Link(BUS, [])
    monkeypatch.setattr(link, "check", lambda: None)
    with structlog.testing.capture_logs() as logs:
        bus = BusConnection(link, 0.01)
        bus.error = None
        bus.look_after(tick(0))
        link.controller_state, link.error_counters = "passive", (128, 7)
        bus.look_after(tick(1))
        bus.look_after(tick(2))
        link.controller_state, link.error_counters = "active", None
        bus.look_after(tick(3))
    common = {"event": "bus controller", "log_level": "warning", "bus": "can0"}
    assert logs == [
        {**common, "tick": 1, "state": "passive", "error_counters": (128, 7)},
        {**common, "tick": 3, "state": "active", "error_counters": None},
    ]


def test_a_bus_that_fails_and_comes_back_is_told_without_repetition(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        bus = world.axis_loop.bus
        answers = [LinkError("no such device")] * 3 + [LinkError("permission denied")]
        opened = bus.link.open_in_thread

        async def open_in_thread() -> None:
            if answers:
                raise answers.pop(0)
            await opened()

        monkeypatch.setattr(bus.link, "open_in_thread", open_in_thread)
        bus._lose(LinkError("network is down"))
        await world.seconds(10.0)
        assert answers == []
        assert bus.error is None

    with structlog.testing.capture_logs() as logs:
        simulate(script)
    told = [line for line in logs if "bus" in line]
    assert {line.pop("bus") for line in told} == {"can0"}
    trying = {"event": "the bus does not open, trying again", "log_level": "warning"}
    is_open = {"event": "the bus is open", "log_level": "info", "interface": "socketcan"}
    assert told[0] == is_open
    assert told[1:5] == [
        {"event": "the bus failed", "log_level": "error", "error": "network is down"},
        {**trying, "error": "no such device"},
        {**trying, "error": "permission denied"},
        is_open,
    ]


# The control socket ---------------------------------------------------------------------------------------------------


def test_who_had_to_make_room_and_who_was_lost_is_told_by_process_and_user(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"

    async def script(world: World, control: ControlSocket) -> None:
        first = await connect(path)
        await first.done(op="status")
        await (await connect(path)).done(op="status")
        assert control._sessions.make_room()
        await world.seconds(0.1)

    with structlog.testing.capture_logs() as logs:
        serve(path, script)
    (told,) = of(logs, "a client was disconnected to make room")
    assert told.pop("peer") == f"pid {os.getpid()} uid {os.getuid()} #1"
    assert told == {
        "event": "a client was disconnected to make room", "log_level": "warning", "room": "control_socket",
        "clients": 2,
    }  # fmt: skip


def test_who_could_not_be_served_is_told_with_the_defect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "control.sock"
    defect = RuntimeError("a defect")

    async def script(world: World, control: ControlSocket) -> None:
        def broken(*_: object) -> None:
            raise defect

        operator = await connect(path)
        with monkeypatch.context() as patch:
            patch.setattr(control._sessions._requests, "answer", broken)
            operator.writer.write(b'{"op": "status"}\n')
            assert await operator.reader.read() == b""
        await (await connect(path)).done(op="status")

    with structlog.testing.capture_logs() as logs:
        serve(path, script)
    (told,) = of(logs, "a client could not be served")
    assert told.pop("peer") == f"pid {os.getpid()} uid {os.getuid()} #1"
    assert told == {
        "event": "a client could not be served", "log_level": "error", "room": "control_socket", "exc_info": defect,
    }  # fmt: skip


def test_that_nobody_can_be_let_in_is_told_with_the_time_until_the_next_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "control.sock"

    async def script(_: World, __: ControlSocket) -> None:
        accept, full = ListeningSocket.accept, [OSError(errno.EPERM, "Operation not permitted")]

        def sometimes(door: ListeningSocket) -> object:
            if full:
                raise full.pop()
            return accept(door)

        monkeypatch.setattr(ListeningSocket, "accept", sometimes)
        await (await connect(path)).done(op="status")

    with structlog.testing.capture_logs() as logs:
        serve(path, script)
    assert of(logs, "connections cannot be accepted") == [
        {
            "event": "connections cannot be accepted", "log_level": "warning", "room": "control_socket",
            "error": "PermissionError(1, 'Operation not permitted')", "retry_s": 1.0,
        }
    ]  # fmt: skip
