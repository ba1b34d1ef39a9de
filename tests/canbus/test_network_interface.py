"""What the kernel tells about sockets and interfaces. It need not have CAN for that: the loopback interface does."""

import errno
import socket
import struct
from collections.abc import Iterator
from typing import Any

import pytest

from tests.canbus.test_link import COMMAND, FEEDBACK, FakeBus
from twostage_servo.canbus import bus_opening
from twostage_servo.canbus.link import BusSettings, Link, LinkCounters, LinkError
from twostage_servo.canbus.network_interface import NetworkInterface


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two joined sockets, on which the sender pays for a frame until it has been taken, as for one in a queue."""
    sender, receiver = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with sender, receiver:
        yield sender, receiver


def test_a_frame_that_has_not_left_is_seen(pair: tuple[socket.socket, socket.socket]) -> None:
    sender, receiver = pair
    interface = NetworkInterface(sender, "lo")
    seen = [interface.is_sending()]
    sender.send(b"command")
    seen.append(interface.is_sending())
    receiver.recv(100)
    assert [*seen, interface.is_sending()] == [False, True, False]


def test_frames_that_nobody_read_in_time_are_counted() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # the kernel makes it its least, some 2 kB
        receiver.bind(("127.0.0.1", 0))
        interface = NetworkInterface(receiver, "lo")
        assert interface.overflowed() == 0
        for _ in range(50):
            sender.sendto(bytes(100), receiver.getsockname())
        receiver.setblocking(False)
        kept = 0
        while True:
            try:
                receiver.recv(100)
            except BlockingIOError:
                break
            kept += 1
        assert 0 < kept < 50
        assert interface.overflowed() == 50 - kept


@pytest.mark.parametrize("name", ["no_such_can9", "", "a name that is too long"])
def test_an_interface_that_is_not_there(pair: tuple[socket.socket, socket.socket], name: str) -> None:
    with pytest.raises(OSError, match=r"No such device") as caught:
        NetworkInterface(pair[0], name).check()
    assert caught.value.errno == errno.ENODEV


@pytest.mark.parametrize(
    ("flags", "mtu", "fd", "code"),
    [
        (0x41, 16, False, None),
        (0x41, 72, True, None),
        (0x40, 16, False, errno.ENETDOWN),
        (0x00, 72, True, errno.ENETDOWN),
        (0x01, 16, False, errno.ENOLINK),
        (0x41, 16, True, errno.EPROTONOSUPPORT),
    ],
)
def test_an_interface_that_can_carry_no_frame_says_why(
    monkeypatch: pytest.MonkeyPatch,
    pair: tuple[socket.socket, socket.socket],
    flags: int,
    mtu: int,
    fd: bool,
    code: int | None,
) -> None:
    def answer(_: socket.socket, request: int, asked: bytes) -> bytes:
        assert asked == b"can0".ljust(40, b"\0")
        return asked[:16] + struct.pack("=H22x" if request == 0x8913 else "=i20x", flags if request == 0x8913 else mtu)

    monkeypatch.setattr("fcntl.ioctl", answer)
    interface = NetworkInterface(pair[0], "can0", fd=fd)
    if code is None:
        interface.check()
        return
    with pytest.raises(OSError, match=r".") as caught:
        interface.check()
    assert caught.value.errno == code


# The link -------------------------------------------------------------------------------------------------------------


class FakeSocketcan(FakeBus):
    """Replaces python-can's SocketCAN bus, over a socket of another kind."""

    def __init__(self, opened: socket.socket) -> None:
        self.socket = opened
        self.is_shut_down = False
        super().__init__(lambda: None, lambda: None)

    def shutdown(self) -> None:
        self.is_shut_down = True
        super().shutdown()


class FakeInterface:
    """Says what a test says."""

    def __init__(self) -> None:
        self.error: OSError | None = None
        self.sending = False
        self.lost = 0

    def __call__(self, opened: socket.socket, name: str, *, fd: bool) -> "FakeInterface":
        self.asked_for = (name, fd)
        return self

    def check(self) -> None:
        if self.error is not None:
            raise self.error

    def is_sending(self) -> bool:
        return self.sending

    def overflowed(self) -> int:
        return self.lost


@pytest.fixture
def interface(monkeypatch: pytest.MonkeyPatch) -> FakeInterface:
    fake = FakeInterface()
    monkeypatch.setattr(bus_opening, "SocketcanBus", FakeSocketcan)
    monkeypatch.setattr(bus_opening, "NetworkInterface", fake)
    return fake


def link_over(bus: Any) -> Link:
    return Link(BusSettings(interface="socketcan", channel="can0", fd=True), [FEEDBACK], lambda: bus)


def test_a_bus_whose_interface_is_down_does_not_open(
    interface: FakeInterface, pair: tuple[socket.socket, socket.socket]
) -> None:
    """The kernel binds a socket to it; the first read then fails, and so would each opening anew."""
    bus = FakeSocketcan(pair[0])
    link = link_over(bus)
    interface.error = OSError(errno.ENETDOWN, "Network is down")
    with pytest.raises(LinkError, match=r"can0 cannot be opened: .*Network is down.*'ip link set can0 up"):
        link.open()
    assert interface.asked_for == ("can0", True)
    assert bus.is_shut_down
    assert not link.is_open


def test_no_frame_is_sent_behind_one_that_has_not_left(
    interface: FakeInterface, pair: tuple[socket.socket, socket.socket]
) -> None:
    link = link_over(FakeSocketcan(pair[0]))
    link.open()
    taken = []
    for interface.sending in (False, True, True, False):
        link.drain()
        frames = [link.prepare(COMMAND, data) for data in (b"\1", b"\2")]
        taken.append((link.send(frames[0]), link.send(frames[1])))  # two axes on one bus: both or none
    assert taken == [(True, True), (False, False), (False, False), (True, True)]
    assert link.counters == LinkCounters(sent=4, dropped=4)
    link.close()


def test_check_counts_what_the_kernel_lost_over_all_openings(
    interface: FakeInterface, pair: tuple[socket.socket, socket.socket]
) -> None:
    link = link_over(FakeSocketcan(pair[0]))
    link.open()
    counted = []
    for interface.lost in (0, 3, 3, 5):
        link.check()
        counted.append(link.counters.overflowed)
    link.close()
    link.open()
    interface.lost = 2  # of a new socket
    link.check()
    assert [*counted, link.counters.overflowed] == [0, 3, 3, 5, 7]
    link.close()


def test_check_fails_the_link_when_the_interface_can_carry_no_frame(
    interface: FakeInterface, pair: tuple[socket.socket, socket.socket]
) -> None:
    link = link_over(FakeSocketcan(pair[0]))
    link.open()
    link.check()
    interface.error = OSError(errno.ENOLINK, "there is no carrier, the controller is bus-off")
    with pytest.raises(LinkError, match=r"can0 failed: .*bus-off.*type can restart"):
        link.check()
    link.close()
    with pytest.raises(LinkError, match="is not open"):
        link.check()
