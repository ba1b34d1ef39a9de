"""A bus that takes its time to open or to close holds up nobody."""

import asyncio
import socket
import threading
from collections.abc import Callable
from typing import Any

import can
import pytest

from tests.canbus.test_link import FEEDBACK, FakeBus
from twostage_servo.canbus import socketcand
from twostage_servo.canbus.bus_opening import OpeningAttempt
from twostage_servo.canbus.link import BusSettings, Link, LinkError
from twostage_servo.service.bus_connection import BusConnection
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.simulation.node import DriveNode

_PATIENCE_S = 30.0
"""Only what hangs is ended by it."""


class Drip:
    """A connection on which a byte comes each 0.8 s, by a clock of its own."""

    def __init__(self, text: bytes) -> None:
        self.now_s = 0.0
        self.timeouts_s: list[float] = []
        self._text = iter(text)
        self._timeout_s = 0.0
        self.is_closed = False

    def settimeout(self, timeout_s: float) -> None:
        self.timeouts_s.append(timeout_s)
        self._timeout_s = timeout_s

    def recv(self, size: int) -> bytes:
        if self._timeout_s < 0.8:
            self.now_s += self._timeout_s
            raise TimeoutError
        self.now_s += 0.8
        return bytes([next(self._text)])

    def sendall(self, data: bytes) -> None:
        self.now_s += 0.1

    def close(self) -> None:
        self.is_closed = True


def test_a_server_that_greets_byte_by_byte_has_one_second_for_all_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    drip = Drip(b"< hi >< ok >< ok >")
    monkeypatch.setattr(socket, "create_connection", lambda *_, **__: drip)
    monkeypatch.setattr("time.monotonic", lambda: drip.now_s)
    with pytest.raises(can.CanInitializationError, match="no answer came within 1 s"):
        socketcand.SocketcandBus("can0")
    assert drip.timeouts_s == pytest.approx([1.0, 0.2])
    assert drip.now_s == pytest.approx(1.0)
    assert drip.is_closed


class Blocked:
    """An interface that waits for a test in its constructor or in its shutdown."""

    def __init__(self) -> None:
        self.entered, self.may_go_on, self.is_shut_down = (threading.Event() for _ in range(3))
        self.opened_again = threading.Event()
        self.threads: list[str] = []

    def wait(self) -> None:
        self.threads.append(threading.current_thread().name)
        self.entered.set()
        assert self.may_go_on.wait(_PATIENCE_S)

    def bus(self, before_it_is_shut_down: Callable[[], None] = lambda: None) -> can.BusABC:
        blocked = self

        class Bus(FakeBus):
            def shutdown(self) -> None:
                before_it_is_shut_down()
                super().shutdown()
                blocked.is_shut_down.set()

        return Bus(lambda: None, lambda: None)

    def slow_to_open(self) -> can.BusABC:
        self.wait()
        return self.bus()

    def slow_to_close(self) -> can.BusABC:
        if self.is_shut_down.is_set():
            self.opened_again.set()
        return self.bus(self.wait)


def link_to(opener: Callable[[], can.BusABC]) -> Link:
    return Link(BusSettings(interface="pcan", channel="x", reopen_interval_ms=10.0), [FEEDBACK], opener)


async def came(event: threading.Event) -> None:
    while not event.is_set():  # noqa: ASYNC110 - it is set by a thread
        await asyncio.sleep(0.001)


def run(scenario: Any) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(_PATIENCE_S):
            await scenario

    asyncio.run(bounded())


def test_a_port_closes_while_its_bus_is_still_opening_and_what_comes_of_that_is_shut_down() -> None:
    blocked = Blocked()
    link = link_to(blocked.slow_to_open)

    async def scenario() -> None:
        port = BusConnection(link, 0.01)
        port.start()
        await came(blocked.entered)
        await port.close()
        assert not blocked.may_go_on.is_set()
        blocked.may_go_on.set()
        await came(blocked.is_shut_down)
        assert not link.is_open

    run(scenario())


def test_a_drive_ends_while_its_bus_is_still_opening() -> None:
    blocked = Blocked()
    link = link_to(blocked.slow_to_open)

    async def scenario() -> None:
        node = DriveNode(SimulatedDriveInName(), link, 0.001)
        running = asyncio.create_task(node.run())
        await came(blocked.entered)
        node.stop()
        await running
        assert not blocked.may_go_on.is_set()
        blocked.may_go_on.set()
        await came(blocked.is_shut_down)

    run(scenario())


class SimulatedDriveInName(SimulatedDrive):
    """One that is never asked for anything."""

    def __init__(self) -> None:
        pass


def test_a_bus_that_is_lost_is_shut_down_by_the_thread_and_not_in_the_tick() -> None:
    blocked = Blocked()
    link = link_to(blocked.slow_to_close)

    async def scenario() -> None:
        port = BusConnection(link, 0.01)
        await link.open_in_thread()
        port.error = None
        port._lose(LinkError("gone"))
        await came(blocked.entered)
        assert threading.current_thread().name not in blocked.threads
        blocked.may_go_on.set()
        await came(blocked.opened_again)  # behind that
        assert blocked.is_shut_down.is_set()
        await port.close()

    run(scenario())


def test_an_opening_that_came_just_before_it_was_given_up_is_shut_down() -> None:
    blocked = Blocked()
    link = link_to(blocked.bus)
    attempt = OpeningAttempt(link.open, link.close)
    attempt.run()
    attempt.abandon()
    assert blocked.is_shut_down.is_set()
    assert not link.is_open
