"""A bus as the service runs it, where the ticks are late."""

import asyncio
import errno

import pytest
import structlog

from tests.service.rig import BUS, World, simulate
from twostage_servo.axis.trips import TripCode
from twostage_servo.canbus.link import Link, LinkError
from twostage_servo.service.bus_connection import BusConnection
from twostage_servo.timing.ticks import Tick
from twostage_servo.timing.virtual_clock import run


@pytest.mark.parametrize("first", [0, 1])
def test_the_bus_is_looked_after_once_a_second_though_every_other_tick_is_missed(
    monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    looked = []
    link = Link(BUS, [])
    monkeypatch.setattr(link, "check", lambda: looked.append(True))
    bus = BusConnection(link, 0.01)
    bus.error = None
    for index in range(first, 1000, 2):
        bus.look_after(Tick(index, 0.01 * index, 0.0, 1))
    assert len(looked) == 10


@pytest.mark.parametrize("then", [None, errno.ENETDOWN, errno.ENOLINK])
def test_an_interface_without_carrier_is_looked_at_again_before_it_counts_as_bus_off(
    monkeypatch: pytest.MonkeyPatch, then: int | None
) -> None:
    """One that is taken down loses its carrier first."""
    found: list[int | None] = [errno.ENOLINK, then, None]
    lost: list[LinkError] = []

    def check() -> None:
        if (code := found.pop(0)) is not None:
            raise LinkError("no frame can be sent") from OSError(code, "")

    link = Link(BUS, [])
    bus = BusConnection(link, 0.01)
    monkeypatch.setattr(link, "check", check)
    monkeypatch.setattr(bus, "_lose", lost.append)
    bus.error = None
    bus.look_after(Tick(100, 1.0, 0.0, 0))
    assert lost == []
    bus.look_after(Tick(101, 1.01, 0.0, 0))
    assert [getattr(error.__cause__, "errno", None) for error in lost] == ([] if then is None else [then])


@pytest.mark.parametrize("hangs", [False, True])
def test_a_bus_that_does_not_close_is_waited_for_a_second_and_told(
    monkeypatch: pytest.MonkeyPatch, *, hangs: bool
) -> None:
    async def close() -> float:
        loop = asyncio.get_running_loop()
        closing = loop.create_future()
        if not hangs:
            loop.call_later(0.5, closing.set_result, None)
        link = Link(BUS, [])
        monkeypatch.setattr(link, "close_in_thread", lambda: closing)
        await BusConnection(link, 0.01).close()
        return loop.time()

    with structlog.testing.capture_logs() as logs:
        assert run(close()) == pytest.approx(1.0 if hangs else 0.5)
    told = {"event": "the bus does not close", "log_level": "warning", "bus": "can0", "waited_s": 1.0}
    assert logs == ([told] if hangs else [])


def test_attempts_to_open_the_bus_are_the_reopen_interval_apart_also_those_that_succeed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    attempts_s: list[float] = []

    async def script() -> None:
        loop = asyncio.get_running_loop()
        link = Link(BUS, [])
        bus = BusConnection(link, 0.01)

        async def open_in_thread() -> None:
            attempts_s.append(loop.time())
            if len(attempts_s) < 3:
                raise LinkError("no such device")

        monkeypatch.setattr(link, "open_in_thread", open_in_thread)
        monkeypatch.setattr(link, "close_in_thread", lambda: None)
        bus.start()
        await asyncio.sleep(10.0)
        assert bus.error is None
        bus._lose(LinkError("network is down"))
        await asyncio.sleep(10.0)
        await bus.close()

    run(script())
    interval_s = BUS.reopen_interval_ms / 1e3
    assert attempts_s[0] == 0.0
    assert attempts_s[1:3] == pytest.approx([interval_s, 2.0 * interval_s])
    assert attempts_s[3] == pytest.approx(10.0)


def test_after_missed_ticks_as_much_more_is_read_up_to_ten(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    link = Link(BUS, [])
    bus = BusConnection(link, 0.01)

    def drain(most: int) -> list[object]:
        asked.append(most)
        return []

    monkeypatch.setattr(link, "drain", drain)
    bus.read(Tick(0, 0.0, 0.0, 0))
    assert asked == []  # it is not open
    bus.error = None
    for missed in (0, 1, 10, 11, 1000):
        bus.read(Tick(0, 0.0, 0.0, missed))
    usual = BUS.frames_read(0.01)
    assert asked == [usual, 2 * usual, 11 * usual, 11 * usual, 11 * usual]


@pytest.mark.parametrize("where", ["drain", "send"])
def test_an_axis_whose_bus_fails_is_told_why(where: str) -> None:
    def broken(*_: object) -> None:
        raise LinkError("the cable is out")

    async def script(world: World) -> None:
        await world.armed()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(world.axis_loop.bus.link, where, broken)
            await world.seconds(0.02)
        trip = world.axis.trip
        assert trip is not None
        assert (trip.code, trip.cause) == (TripCode.BUS_FAILED, "the cable is out")
        assert world.axis_loop.receiver.drive_state is None

    with structlog.testing.capture_logs() as logs:
        simulate(script)
    told = [line for line in logs if line["event"] == "the bus failed"]
    assert told == [{"event": "the bus failed", "log_level": "error", "bus": "can0", "error": "the cable is out"}]
