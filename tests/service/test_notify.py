"""The service manager's notifications over a real datagram socket."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.rig import World, simulate
from twostage_servo.app.serve import announces_end
from twostage_servo.axis.state import State
from twostage_servo.service.notify import Notifier
from twostage_servo.service.settings import longest_end_s


class Manager:
    """What the service manager is to its service: a socket that collects datagrams."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.socket.bind(address)

    def heard(self) -> list[str]:
        messages = []
        while True:
            try:
                messages.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return messages


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    manager = Manager(str(tmp_path / "notify"))
    yield manager
    manager.socket.close()


def notifier(tmp_path: Path, **environment: str) -> Notifier:
    return Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify"), **environment})


def feed(world: World, notifier: Notifier) -> None:
    """Let the service give its signs of life from now on, and tell of its end."""
    world.sign_of_life = notifier.tick_completed
    world.loop.listen(announces_end(world.parts, notifier))


def test_what_a_service_says_from_start_to_end(manager: Manager, tmp_path: Path) -> None:
    told = notifier(tmp_path)
    told.ready()
    told.status("holding")
    told.stopping(12.8)
    told.stopping(12.8)
    told.close()
    told.ready()  # closed: nothing
    told.close()
    assert manager.heard() == ["READY=1", "STATUS=holding", "STOPPING=1", "EXTEND_TIMEOUT_USEC=12800000"]


def test_an_abstract_address() -> None:
    name = f"twostage-servo-test-{os.getpid()}"
    manager = Manager(f"\0{name}")
    told = Notifier({"NOTIFY_SOCKET": f"@{name}"})
    told.ready()
    told.close()
    assert manager.heard() == ["READY=1"]
    manager.socket.close()


@pytest.mark.parametrize(
    "environment", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "relative"}, {"WATCHDOG_USEC": "9"}]
)
def test_without_a_manager_nothing_is_said(environment: dict[str, str]) -> None:
    told = Notifier(environment)
    assert told._socket is None
    told.ready()
    told.tick_completed(1.0)
    told.stopping(1.0)
    told.close()


def test_a_manager_that_has_gone_or_does_not_read_is_no_error(tmp_path: Path) -> None:
    told = notifier(tmp_path, WATCHDOG_USEC="1000")
    told.ready()  # nobody has ever bound it
    manager = Manager(str(tmp_path / "notify"))
    for tick in range(100_000):
        told.tick_completed(float(tick))  # its queue is full after some hundred
    heard = manager.heard()
    assert 0 < len(heard) < 100_000
    assert set(heard) == {"WATCHDOG=1"}
    manager.socket.close()
    told.stopping(1.0)
    told.close()


@pytest.mark.parametrize(
    ("environment", "watchdog_s"),
    [
        ({"WATCHDOG_USEC": "3000000"}, 3.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}, 3.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"}, None),  # meant for another process
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({"WATCHDOG_USEC": "-5"}, None),
        ({}, None),
    ],
)
def test_how_long_the_manager_waits(environment: dict[str, str], watchdog_s: float | None) -> None:
    assert Notifier(environment).watchdog_s == watchdog_s


def test_without_a_watchdog_ticks_say_nothing(manager: Manager, tmp_path: Path) -> None:
    told = notifier(tmp_path)
    told.tick_completed(1.0)
    assert manager.heard() == []
    told.close()


def test_completed_ticks_feed_the_watchdog_four_times_in_its_time(manager: Manager, tmp_path: Path) -> None:
    async def script(world: World) -> None:
        told = notifier(tmp_path, WATCHDOG_USEC="1000000")
        feed(world, told)
        heard = []
        for _ in range(10):  # the socket's queue holds no more than some ten
            await world.seconds(1.0)
            heard += manager.heard()
        assert abs(len(heard) - 40) <= 1
        told.close()

    simulate(script)


def test_a_loop_that_is_held_up_does_not_feed_it(manager: Manager, tmp_path: Path) -> None:
    async def script(world: World) -> None:
        told = notifier(tmp_path, WATCHDOG_USEC="1000000")
        feed(world, told)
        await world.seconds(1.0)
        manager.heard()
        world.ticks.hold_s = 5.0
        await world.seconds(0.02)
        manager.heard()
        await world.seconds(4.9)
        assert manager.heard() == []
        await world.seconds(1.0)
        assert len(manager.heard()) >= 3
        told.close()

    simulate(script)


@pytest.mark.parametrize("place", ["read", "update", "write"])
def test_a_tick_that_fails_does_not_count_as_completed(
    monkeypatch: pytest.MonkeyPatch, manager: Manager, tmp_path: Path, place: str
) -> None:
    async def script(world: World) -> None:
        told = notifier(tmp_path, WATCHDOG_USEC="1")  # so that each completed tick says so
        await world.cruising()
        feed(world, told)
        await world.seconds(0.05)
        assert len(manager.heard()) == 5

        def broken(*_: object) -> None:
            raise RuntimeError("broken for good")

        monkeypatch.setattr(world.service, place, broken)
        with pytest.raises(RuntimeError, match="broken for good"):
            await world.serving
        assert "WATCHDOG=1" not in manager.heard()
        told.close()

    simulate(script)


def test_a_publisher_that_fails_does_not_let_the_watchdog_be_fed(manager: Manager, tmp_path: Path) -> None:
    async def script(world: World) -> None:
        told = notifier(tmp_path, WATCHDOG_USEC="1")

        def broken(_: object) -> None:
            raise RuntimeError("broken for good")

        await world.cruising()
        world.loop.listen(broken)
        feed(world, told)
        with pytest.raises(RuntimeError):
            await world.serving
        assert "WATCHDOG=1" not in manager.heard()
        told.close()

    simulate(script)


@pytest.mark.parametrize("shutdown_timeout_ms", [800.0, 60_000.0])
def test_the_manager_is_asked_to_wait_for_the_braking_before_that_begins(
    manager: Manager, tmp_path: Path, shutdown_timeout_ms: float
) -> None:
    async def script(world: World) -> None:
        told = notifier(tmp_path)
        await world.cruising()
        feed(world, told)
        await world.seconds(0.05)
        assert manager.heard() == []
        world.service.shut_down()
        await world.seconds(0.02)
        assert world.state() is State.DISARMING
        stopping, extended = manager.heard()
        assert stopping == "STOPPING=1"
        asked_s = int(extended.removeprefix("EXTEND_TIMEOUT_USEC=")) / 1e6
        assert asked_s == longest_end_s(world.service.shutdown.settings, [500.0]) > shutdown_timeout_ms / 1e3
        await world.until(world.serving.done)
        assert manager.heard() == []
        told.close()

    simulate(script, f"service.shutdown_timeout_ms={shutdown_timeout_ms}")


def test_a_defect_that_ends_the_service_is_told_to_the_manager_as_well(
    monkeypatch: pytest.MonkeyPatch, manager: Manager, tmp_path: Path
) -> None:
    async def script(world: World) -> None:
        told = notifier(tmp_path)
        await world.cruising()
        feed(world, told)
        world.service.shutdown.fail(RuntimeError("a defect"))
        await world.seconds(0.02)
        assert manager.heard()[0] == "STOPPING=1"
        with pytest.raises(RuntimeError, match="a defect"):
            await world.serving
        told.close()

    simulate(script)
