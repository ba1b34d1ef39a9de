import asyncio
import errno
import gc
import logging
import os
import threading
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest

from twostage_servo.canbus.identifier import Identifier
from twostage_servo.canbus.link import BusSettings, Link, LinkCounters, LinkError

FEEDBACK = Identifier(0x181, extended=False)
COMMAND = Identifier(0x201, extended=False)


def frame(number: int = 0x181, data: bytes = b"\x01", **kwargs: Any) -> can.Message:
    return can.Message(arbitration_id=number, data=data, **({"is_extended_id": False} | kwargs))


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    return f"test {request.node.nodeid}"


@pytest.fixture
def peer(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as bus:
        yield bus


@pytest.fixture
def link(channel: str) -> Iterator[Link]:
    link = Link(BusSettings(interface="virtual", channel=channel, max_frames_per_tick=10), [FEEDBACK])
    link.open()
    yield link
    link.close()


class FakeBus(can.BusABC):
    """An interface that does what a test says; filters like the kernel."""

    def __init__(self, receive: Callable[[], can.Message | None], send: Callable[[], None]) -> None:
        self.receive, self.hand_over = receive, send
        self.timeouts: list[float | None] = []
        self.applied_filters: Any = None
        super().__init__("fake")

    def _apply_filters(self, filters: Any) -> None:
        self.applied_filters = filters

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.receive(), True

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.timeouts.append(timeout)
        self.hand_over()


@pytest.fixture
def opened_with(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Replace can.Bus; returns the arguments that it was called with, and under "bus" what it made."""
    arguments: dict[str, Any] = {}

    def bus(**kwargs: Any) -> can.BusABC:
        arguments.update(kwargs)
        made: FakeBus = arguments.setdefault("bus", FakeBus(lambda: None, lambda: None))
        made.set_filters(kwargs["can_filters"])
        return made

    monkeypatch.setattr(can, "Bus", bus)
    return arguments


def raising(error: Exception) -> Callable[[], Any]:
    def raise_it() -> Any:
        raise error

    return raise_it


# Receiving ------------------------------------------------------------------------------------------------------------


def test_drain_returns_what_arrived_in_order(link: Link, peer: can.BusABC) -> None:
    assert link.drain() == []
    for number in range(5):
        peer.send(frame(data=bytes((number,))))
    assert [bytes(message.data) for message in link.drain()] == [b"\0", b"\1", b"\2", b"\3", b"\4"]
    assert link.drain() == []
    assert link.counters == LinkCounters(received=5)


def test_foreign_frames_do_not_hide_the_frames_behind_them(link: Link, peer: can.BusABC) -> None:
    for data in (b"\1", b"\2"):
        for foreign in (0x182, 0x80, 0x201):
            peer.send(frame(foreign))
        peer.send(frame(data=data))
    assert [bytes(message.data) for message in link.drain()] == [b"\1", b"\2"]
    assert link.counters == LinkCounters(received=2)


def test_frames_of_the_other_kind_come_through_to_be_rejected(link: Link, peer: can.BusABC) -> None:
    peer.send(frame(is_extended_id=True))
    peer.send(frame(data=b"", is_remote_frame=True))
    assert [(message.is_extended_id, message.is_remote_frame) for message in link.drain()] == [
        (True, False),
        (False, True),
    ]


def test_a_babbling_node_takes_no_more_than_the_bound(link: Link, peer: can.BusABC) -> None:
    for number in range(25):
        peer.send(frame(0x7F if number % 2 else 0x181, bytes((number,))))
    read = [(len(link.drain()), link.is_behind) for _ in range(4)]
    assert read == [(5, False), (5, True), (3, True), (0, False)]
    assert link.counters == LinkCounters(received=13, overruns=2)


def test_a_drain_may_be_given_a_bound_of_its_own(link: Link, peer: can.BusABC) -> None:
    for _ in range(25):
        peer.send(frame())
    assert [len(link.drain(most)) for most in (3, 20, None)] == [3, 20, 2]


def test_a_link_that_is_opened_anew_is_behind_nothing(link: Link, peer: can.BusABC) -> None:
    for _ in range(11):
        peer.send(frame())
    link.drain()
    link.close()
    link.open()
    link.drain()
    assert not link.is_behind


@pytest.mark.parametrize(
    ("settings", "tick_s", "carried", "read"),
    [
        ({}, 0.01, 213, 426),  # 47 bits are the shortest frame: 212.8 at 1 Mbit/s
        ({"bitrate": 500_000}, 0.01, 107, 214),
        ({"bitrate": 125_000}, 0.001, 3, 64),
        ({}, 0.1, 2128, 4256),
        ({"fd": True}, 0.01, 334, 668),
        ({"max_frames_per_tick": 5}, 0.01, 213, 5),
    ],
)
def test_what_is_read_in_a_tick_follows_the_tick_and_the_bit_rate(
    settings: dict[str, Any], tick_s: float, carried: int, read: int
) -> None:
    bus = BusSettings.model_validate({"interface": "socketcan", "channel": "can0"} | settings)
    assert (bus.frames_carried(tick_s), bus.frames_read(tick_s)) == (carried, read)


def test_own_frames_do_not_come_back(channel: str) -> None:
    link = Link(BusSettings(interface="virtual", channel=channel), [COMMAND])
    link.open()
    assert link.send(link.prepare(COMMAND, b"\1"))
    assert link.drain() == []
    link.close()


def test_error_frames_are_counted_and_skipped(link: Link, peer: can.BusABC) -> None:
    peer.send(frame(0x04, is_error_frame=True))
    peer.send(frame())
    peer.send(frame(is_error_frame=True))
    assert len(link.drain()) == 1
    assert link.counters == LinkCounters(received=1, errors=2, errors_by_kind={"other": 2})


def test_bus_off_fails_the_link(opened_with: dict[str, Any]) -> None:
    frames = [frame(0x04, is_error_frame=True), frame(0x40, is_error_frame=True)]
    opened_with["bus"] = FakeBus(lambda: frames.pop(0), lambda: None)
    link = Link(BusSettings(interface="socketcan", channel="can0"), [FEEDBACK])
    link.open()
    with pytest.raises(LinkError, match="bus socketcan can0 went bus-off"):
        link.drain()
    assert link.counters.errors_by_kind == {"other": 1, "bus_off": 1}
    link.close()


# Sending --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("identifier", [COMMAND, Identifier(0x201, extended=True)])
def test_send_hands_the_frame_over(link: Link, peer: can.BusABC, identifier: Identifier) -> None:
    assert link.send(link.prepare(identifier, b"\1\2\3\4"))
    message = peer.recv(0)
    assert message is not None
    assert (message.arbitration_id, message.is_extended_id, bytes(message.data)) == (*identifier, b"\1\2\3\4")
    assert link.counters == LinkCounters(sent=1)


def test_a_full_queue_drops_the_frame_and_keeps_nothing(link: Link, channel: str) -> None:
    with can.Bus(interface="virtual", channel=channel, rx_queue_size=1, ignore_config=True) as peer:
        assert link.send(link.prepare(COMMAND, b"\1"))
        assert not link.send(link.prepare(COMMAND, b"\2"))
        first = peer.recv(0)
        assert first is not None
        assert first.data == b"\1"
        assert link.send(link.prepare(COMMAND, b"\3"))
        newest = peer.recv(0)
        assert newest is not None
        assert newest.data == b"\3"
    assert link.counters == LinkCounters(sent=2, dropped=1)


def with_cause(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS),
        can.CanOperationError("Transmit buffer full"),
        can.CanTimeoutError("timed out"),
        with_cause(can.CanOperationError("failed to send via socket"), BlockingIOError(errno.EAGAIN, "again")),
    ],
    ids=["socketcan ENOBUFS", "socketcan full", "time-out", "udp_multicast"],
)
def test_a_queue_that_is_full_just_now_is_no_failure(error: Exception, opened_with: dict[str, Any]) -> None:
    opened_with["bus"] = FakeBus(lambda: None, raising(error))
    link = Link(BusSettings(interface="socketcan", channel="can0"), [FEEDBACK])
    link.open()
    assert link.send(link.prepare(COMMAND, b"\1")) is False
    assert link.counters == LinkCounters(dropped=1)
    assert opened_with["bus"].timeouts == [0]  # never None, which waits for ever
    link.close()


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN),
        with_cause(can.CanOperationError("failed to send via socket"), OSError(errno.ENETUNREACH, "unreachable")),
        OSError(errno.ENODEV, os.strerror(errno.ENODEV)),
        TimeoutError(errno.ETIMEDOUT, "Connection timed out"),
        RuntimeError(),
    ],
    ids=repr,
)
def test_whatever_an_interface_raises_comes_out_as_link_error(error: Exception, opened_with: dict[str, Any]) -> None:
    opened_with["bus"] = FakeBus(raising(error), raising(error))
    link = Link(BusSettings(interface="socketcan", channel="can0"), [FEEDBACK])
    link.open()
    with pytest.raises(
        LinkError, match=r"bus socketcan can0 failed while sending: .+'ip (?:-details link show|link set|-brief link)"
    ) as sending:
        link.send(link.prepare(COMMAND, b"\1"))
    assert sending.value.__cause__ is error
    with pytest.raises(LinkError, match=r"bus socketcan can0 failed while receiving: .+") as receiving:
        link.drain()
    assert receiving.value.__cause__ is error
    assert link.counters == LinkCounters()
    link.close()


@pytest.mark.parametrize("switch", [False, True])
def test_frames_are_can_fd_where_the_settings_say_so(channel: str, peer: can.BusABC, switch: bool) -> None:
    link = Link(BusSettings(interface="virtual", channel=channel, fd=True, bit_rate_switch=switch), [FEEDBACK])
    link.open()
    assert link.send(link.prepare(COMMAND, bytes(12)))
    message = peer.recv(0)
    assert message is not None
    assert (message.is_fd, message.bitrate_switch, len(message.data)) == (True, switch, 12)
    link.close()


def test_can_fd_is_asked_of_socketcan(opened_with: dict[str, Any]) -> None:
    Link(BusSettings(interface="socketcan", channel="can0", fd=True), [FEEDBACK]).open()
    assert opened_with.pop("bus").applied_filters == [{"can_id": 0x181, "can_mask": 0x1FFFFFFF}]
    assert opened_with["fd"] is True


# Opening and closing --------------------------------------------------------------------------------------------------


def test_open_passes_the_settings_and_ignores_configuration_files(opened_with: dict[str, Any]) -> None:
    settings = BusSettings(interface="pcan", channel="PCAN_USBBUS1", bitrate=500_000, options={"auto_reset": True})
    link = Link(settings, [FEEDBACK, Identifier(0x18FF0001, extended=True)])
    link.open()
    bus = opened_with.pop("bus")
    filters = [{"can_id": 0x181, "can_mask": 0x1FFFFFFF}, {"can_id": 0x18FF0001, "can_mask": 0x1FFFFFFF}]
    assert opened_with == {
        "interface": "pcan",
        "channel": "PCAN_USBBUS1",
        "bitrate": 500_000,
        "auto_reset": True,
        "ignore_config": True,
        "can_filters": filters,
    }
    assert bus.applied_filters == filters  # a filter in hardware or kernel stays
    link.close()


@pytest.mark.parametrize(("options", "hop_limit"), [({}, 0), ({"hop_limit": 2}, 2)])
def test_multicast_stays_on_the_host_unless_told_otherwise(
    options: dict[str, Any], hop_limit: int, opened_with: dict[str, Any]
) -> None:
    link = Link(BusSettings(interface="udp_multicast", channel="239.1.2.3", options=options), [FEEDBACK])
    link.open()
    assert opened_with["hop_limit"] == hop_limit
    link.close()


def test_open_and_close_can_be_repeated(link: Link, peer: can.BusABC) -> None:
    link.open()
    peer.send(frame())
    assert len(link.drain()) == 1  # the second open made no second bus
    link.close()
    link.close()
    assert not link.is_open
    link.open()
    peer.send(frame())
    assert len(link.drain()) == 1
    assert link.counters.received == 2


def test_a_closed_link_neither_reads_nor_sends(link: Link) -> None:
    link.close()
    with pytest.raises(LinkError, match="is not open"):
        link.drain()
    with pytest.raises(LinkError, match="is not open"):
        link.send(link.prepare(COMMAND, b"\1"))


def test_close_never_raises(opened_with: dict[str, Any], caplog: pytest.LogCaptureFixture) -> None:
    link = Link(BusSettings(interface="socketcan", channel="can0"), [FEEDBACK])
    link.open()
    bus = opened_with["bus"]
    bus.shutdown = raising(OSError("device gone"))
    with caplog.at_level(logging.WARNING):
        link.close()
    assert "device gone" in caplog.text
    assert not link.is_open
    del bus.shutdown
    bus.shutdown()


@pytest.mark.parametrize(
    ("interface", "error", "text"),
    [
        ("slcan", OSError(errno.ENOENT, "No such file"), "Check cable, driver, and the table [bus]"),
        ("socketcan", OSError(errno.ENODEV, "No such device"), "'ip link set no_such_can9 up type can bitrate ...'"),
        ("socketcan", OSError(errno.ENETDOWN, "Network is down"), "Bring it up with 'ip link set no_such_can9 up"),
        ("socketcan", OSError(errno.ENOLINK, "no carrier"), "'ip link set no_such_can9 type can restart'"),
        ("socketcan", OSError(errno.EPROTONOSUPPORT, "classic only"), "dbitrate ... fd on"),
        ("socketcan", OSError(errno.EPERM, "not permitted"), "ip -details link show no_such_can9"),
        ("socketcan", OSError(errno.EAFNOSUPPORT, "Address family not supported"), "modprobe can"),
    ],
)
def test_a_bus_that_does_not_open_says_why_and_what_to_do(
    monkeypatch: pytest.MonkeyPatch, interface: str, error: OSError, text: str
) -> None:
    def fail(**_: Any) -> None:
        raise error

    monkeypatch.setattr(can, "Bus", fail)
    link = Link(BusSettings(interface=interface, channel="no_such_can9"), [FEEDBACK])
    with pytest.raises(LinkError, match="cannot be opened") as caught:
        link.open()
    assert text in str(caught.value)
    assert caught.value.__cause__ is error
    assert not link.is_open


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"options": {"receive_own_messages": True}}, "receive_own_messages cannot be set here"),
        ({"options": {"can_filters": "x", "channel": "y"}}, "can_filters, channel cannot be set here"),
        ({"interface": "virtual", "bitrate": 500_000}, "bitrate has no effect on interface 'virtual'"),
        ({"interface": "pcan", "bitrate": 0}, "greater than 0"),
        ({"max_frames_per_tick": 0}, "greater than or equal to 1"),
        ({"chanel": "can0"}, "Extra inputs"),
        ({"interface": "socketcn"}, r"no such interface; did you mean socketcan\? Its interfaces: "),
        ({"interface": "qqq"}, r"no such interface\. Its interfaces: "),
        ({"options": {"fd": True}}, "fd cannot be set here"),
        ({"bit_rate_switch": True}, "CAN FD frames only; set fd = true"),
        ({"fd": True, "interface": "pcan"}, "fd is not possible on interface 'pcan', only on socketcan, virtual"),
        ({"fd": True, "bitrate": 500_000}, "with fd = true, remove it"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        BusSettings.model_validate({"interface": "socketcan", "channel": "can0"} | changes)


def test_attempts_that_fail_leave_nothing_to_the_garbage_collection() -> None:
    half_made: list[weakref.ref[object]] = []

    class HalfMadeBus:
        def __init__(self) -> None:
            half_made.append(weakref.ref(self))
            raise OSError(errno.ENODEV, "No such device")

    def opener() -> can.BusABC:
        return HalfMadeBus()  # type: ignore[return-value]

    link = Link(BusSettings(interface="socketcan", channel="can0"), [FEEDBACK], opener)

    async def attempts() -> None:
        for _ in range(5):
            with pytest.raises(LinkError, match="No such device"):
                await link.open_in_thread()

    gc.disable()
    try:
        asyncio.run(attempts())
        assert [bus() for bus in half_made] == [None] * 5
    finally:
        gc.enable()


def test_a_bus_that_cannot_be_set_up_is_shut_down() -> None:
    class Unfiltered(can.BusABC):
        shut_down = 0

        def __init__(self) -> None:
            super().__init__(channel="x")

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            raise NotImplementedError

        def shutdown(self) -> None:
            super().shutdown()
            Unfiltered.shut_down += 1

    def no_filters(filters: Any = None) -> None:
        raise can.CanOperationError("no filters")

    def opener() -> can.BusABC:
        bus = Unfiltered()
        bus.set_filters = no_filters  # type: ignore[method-assign]
        return bus

    link = Link(BusSettings(interface="virtual", channel="x"), [FEEDBACK], opener)
    with pytest.raises(LinkError, match="no filters"):
        link.open()
    assert Unfiltered.shut_down == 1


def test_a_bus_is_opened_again_by_the_thread_that_has_opened_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_thread_left(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    async def main() -> None:
        link = Link(BusSettings(interface="virtual", channel="reopened"), ())
        with monkeypatch.context() as patch:
            patch.setattr(threading.Thread, "start", no_thread_left)
            with pytest.raises(LinkError, match="can't start new thread"):
                await link.open_in_thread()
        await link.open_in_thread()
        link.close()
        with monkeypatch.context() as patch:
            patch.setattr(threading.Thread, "start", no_thread_left)
            await link.open_in_thread()
        assert link.is_open
        link.close()

    asyncio.run(main())
