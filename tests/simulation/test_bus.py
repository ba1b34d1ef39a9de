import asyncio
import errno
from collections.abc import Iterable, Iterator
from functools import partial

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.canbus.identifier import Identifier
from twostage_servo.canbus.link import BusSettings, Link, LinkError
from twostage_servo.drives.dbc.drive_side import DbcDriveSide
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.frame import FrameRejected
from twostage_servo.simulation.bus import Wire, WireBus
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.simulation.node import DriveNode
from twostage_servo.simulation.settings import SimulationSettings
from twostage_servo.timing.ticks import Ticks
from twostage_servo.timing.virtual_clock import run

SETTINGS = BusSettings(interface="socketcan", channel="can0")
FEEDBACK = Identifier(0x181, extended=False)


class Clock:
    now_s = 5.0

    def __call__(self) -> float:
        return self.now_s


class Rig:
    """A wire with three nodes on it."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.wire = Wire(self.clock)
        self.a, self.b, self.c = (self.wire.attach(name) for name in "abc")

    def send(self, *numbers: int) -> None:
        for number in numbers:
            self.a.send(frame(number), timeout=0)

    def received(self, bus: WireBus) -> list[tuple[int, float]]:
        """First byte and time stamp of what has arrived."""
        received = []
        while (message := bus.recv(0)) is not None:
            received.append((message.data[0], message.timestamp))
        return received


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    for bus in (rig.a, rig.b, rig.c):
        bus.shutdown()


def frame(number: int) -> can.Message:
    return can.Message(arbitration_id=0x181, is_extended_id=False, data=bytes((number,)), check=True)


def test_a_frame_reaches_every_other_node_at_once_in_order_and_stamped(rig: Rig) -> None:
    rig.send(1, 2)
    rig.clock.now_s += 0.5
    rig.send(3)
    assert rig.received(rig.b) == rig.received(rig.c) == [(1, 5.0), (2, 5.0), (3, 5.5)]
    assert rig.received(rig.a) == []
    assert rig.received(rig.b) == []


def test_each_receiver_has_a_frame_of_its_own(rig: Rig) -> None:
    sent = frame(1)
    rig.a.send(sent)
    received = [bus.recv(0) for bus in (rig.b, rig.c)]
    assert received[0] is not None
    received[0].data[0] = 99
    assert received[1] is not None
    assert (received[1].data[0], sent.data[0], sent.timestamp) == (1, 1, 0.0)


def test_a_frame_arrives_as_it_was_sent_whatever_its_sender_does_with_it_afterwards(rig: Rig) -> None:
    sent = frame(1)
    rig.a.send(sent)
    rig.wire.node("b").inject(sent)
    sent.data[0] = 99
    rig.clock.now_s += 0.5
    assert rig.received(rig.b) == [(1, 5.0), (1, 5.0)]
    assert rig.received(rig.c) == [(1, 5.0)]


def test_a_disturbance_may_change_one_message_between_its_deliveries(rig: Rig) -> None:
    def disturb(_: str, message: can.Message, __: float) -> Iterable[tuple[float, can.Message]]:
        yield 0.0, message
        message.data[0] += 1
        yield 0.25, message

    rig.wire.disturb(disturb)
    rig.send(1)
    rig.clock.now_s += 0.25
    assert rig.received(rig.b) == rig.received(rig.c) == [(1, 5.0), (2, 5.25)]


@pytest.mark.parametrize("timeout", [None, 0.1])
def test_it_never_waits(rig: Rig, timeout: float | None) -> None:
    with pytest.raises(ValueError, match=r"use recv\(0\)"):
        rig.b.recv(timeout)


delays = st.lists(st.lists(st.sampled_from([0.0, 0.001, 0.0095, 0.01, 0.03]), max_size=2), min_size=1, max_size=20)


@given(delays=delays, looks=st.integers(1, 10))
def test_what_is_lost_doubled_or_late_arrives_so_whenever_somebody_looks(delays: list[list[float]], looks: int) -> None:
    """Oracle: sort all deliveries by their time, first sent first."""
    rig = Rig()

    def disturb(sender: str, message: can.Message, now_s: float) -> Iterable[tuple[float, can.Message]]:
        assert (sender, now_s) == ("a", rig.clock.now_s)
        return [(delay_s, message) for delay_s in delays[message.data[0]]]

    rig.wire.disturb(disturb)
    expected = [(5.0 + 0.01 * number + delay_s, number) for number, copies in enumerate(delays) for delay_s in copies]
    seen: list[tuple[int, float]] = []
    for number in range(len(delays)):
        rig.clock.now_s = 5.0 + 0.01 * number
        rig.send(number)
        if number % looks == 0:
            seen += rig.received(rig.b)
            assert len(seen) == sum(at_s <= rig.clock.now_s + 1e-10 and sent <= number for at_s, sent in expected)
    rig.clock.now_s += 1.0
    seen += rig.received(rig.b)
    assert sorted((at_s, number) for number, at_s in seen) == sorted(expected)
    times_s = [at_s for _, at_s in seen]
    assert times_s == pytest.approx(sorted(times_s), abs=1e-9)
    for bus in (rig.a, rig.b, rig.c):
        bus.shutdown()


def test_a_late_frame_comes_behind_a_later_one(rig: Rig) -> None:
    rig.wire.disturb(lambda _, message, __: [(0.009 if message.data[0] == 1 else 0.0, message)])
    rig.send(1)
    rig.clock.now_s += 0.005
    rig.send(2)
    assert rig.received(rig.b) == [(2, 5.005)]
    rig.clock.now_s += 0.004
    assert rig.received(rig.b) == [(1, 5.009)]


def test_a_disturbance_may_damage_a_frame(rig: Rig, profile: DriveProfile) -> None:
    def flip_a_bit(_: str, message: can.Message, __: float) -> list[tuple[float, can.Message]]:
        message.data[0] ^= 1
        return [(0.0, message)]

    rig.wire.disturb(flip_a_bit)
    data = profile.encode_command(1.0, enable=True, counter=1)
    rig.a.send(can.Message(arbitration_id=0x201, is_extended_id=False, data=data))
    received = rig.b.recv(0)
    assert received is not None
    with pytest.raises(FrameRejected, match="checksum"):
        profile.decode_command(received)


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=0x04, is_error_frame=True, data=bytes(8)),
        can.Message(arbitration_id=0x181, is_extended_id=False, is_remote_frame=True, dlc=8),
        can.Message(arbitration_id=0x181, is_extended_id=True, data=bytes(8)),
        can.Message(arbitration_id=0x181, is_extended_id=False, is_fd=True, data=bytes(12)),
        can.Message(arbitration_id=0x201, is_extended_id=False),
    ],
    ids=["error", "remote", "extended", "FD", "empty"],
)
def test_any_frame_can_be_put_into_one_node(rig: Rig, message: can.Message) -> None:
    rig.wire.disturb(lambda *_: [])
    rig.wire.node("b").inject(message)
    received = rig.b.recv(0)
    assert received is not None
    assert received.equals(message, timestamp_delta=None, check_direction=False)
    assert received.timestamp == 5.0
    assert (rig.a.recv(0), rig.c.recv(0)) == (None, None)


def test_a_queue_that_nobody_reads_loses_its_oldest_frames(rig: Rig) -> None:
    for number in range(1030):
        rig.wire.node("b").inject(frame(number % 256))
    assert rig.received(rig.b)[0] == (6, 5.0)
    assert (rig.wire.node("b").dropped, rig.wire.node("c").dropped) == (6, 0)


def test_a_bus_that_is_full_or_fails_does_so_at_its_node_alone(rig: Rig) -> None:
    link = Link(SETTINGS, [FEEDBACK], partial(rig.wire.attach, "link"))
    link.open()
    node = rig.wire.node("link")
    node.fail_to_send(can.CanOperationError("No buffer space available", errno.ENOBUFS))
    assert not link.send(link.prepare(FEEDBACK, b"\1"))
    assert link.counters.dropped == 1
    node.fail_to_send(None)
    assert link.send(link.prepare(FEEDBACK, b"\2"))
    assert rig.received(rig.b) == [(2, 5.0)]
    node.fail_to_receive(OSError(errno.ENODEV, "No such device"))
    rig.send(3)
    assert rig.received(rig.b) == [(3, 5.0)]
    with pytest.raises(LinkError, match=r"failed while receiving: .*No such device"):
        link.drain()
    node.fail_to_receive(None)
    assert [message.data[0] for message in link.drain()] == [3]
    link.close()


def test_an_interface_that_is_down_fails_until_it_is_up_and_what_came_meanwhile_is_lost(rig: Rig) -> None:
    link = Link(SETTINGS, [FEEDBACK], partial(rig.wire.attach, "link"))
    link.open()
    rig.send(1)
    node = rig.wire.node("link")
    node.take_down()
    rig.send(2)
    for fail in (link.drain, partial(link.send, link.prepare(FEEDBACK, b"\1"))):
        with pytest.raises(LinkError, match="Network is down"):
            fail()
    link.close()
    with pytest.raises(LinkError, match=r"cannot be opened: .*Network is down"):
        link.open()
    node.bring_up()
    link.open()
    assert link.drain() == []
    rig.send(3)
    assert [message.data[0] for message in link.drain()] == [3]
    link.close()


def test_a_link_tells_the_age_of_its_frames_in_simulated_time(rig: Rig) -> None:
    link = Link(SETTINGS, [FEEDBACK], partial(rig.wire.attach, "link"))
    link.open()
    rig.wire.disturb(lambda _, message, __: [(0.004, message), (0.01, message)])
    rig.send(1)
    rig.clock.now_s += 0.01
    messages = link.drain()
    assert [link.age_s(message) for message in messages] == pytest.approx([0.006, 0.0])
    link.close()


def test_a_node_has_one_bus_at_a_time_and_begins_with_an_empty_queue(rig: Rig) -> None:
    with pytest.raises(OSError, match="node b has an open bus") as caught:
        rig.wire.attach("b")
    assert caught.value.errno == errno.EBUSY
    rig.send(1)
    rig.b.shutdown()
    rig.b.shutdown()
    rig.send(2)
    for fail in (partial(rig.b.recv, 0), partial(rig.b.send, frame(1))):
        with pytest.raises(can.CanOperationError, match="closed"):
            fail()
    rig.b = rig.wire.attach("b")
    assert rig.received(rig.b) == []
    rig.send(3)
    assert rig.received(rig.b) == [(3, 5.0)]


def test_a_drive_and_a_controller_meet_on_it_in_simulated_time(profile: DriveProfile) -> None:
    async def main() -> tuple[list[tuple[float, float]], list[float | None]]:
        loop = asyncio.get_running_loop()
        wire = Wire(loop.time)
        wire.disturb(lambda sender, message, _: [(0.003 if sender == "drive" else 0.0, message)])
        settings = SimulationSettings(command_timeout_ms=1000.0)
        drive = SimulatedDrive(settings, DbcDriveSide(profile), loop.time())
        node = DriveNode(drive, Link(SETTINGS, [profile.command_id], partial(wire.attach, "drive")), 0.001)
        running = asyncio.create_task(node.run())
        link = Link(SETTINGS, [profile.feedback_id], partial(wire.attach, "controller"))
        link.open()
        seen: list[tuple[float, float]] = []
        ages: list[float | None] = []
        async for tick in Ticks(0.01):
            for message in link.drain():
                seen.append((message.timestamp, profile.decode_feedback(message).position))
                ages.append(link.age_s(message))
            if tick.index == 50:
                break
            data = profile.encode_command(1.0, tick.index > 2, tick.index)
            link.send(link.prepare(profile.command_id, data))
        node.stop()
        await running
        link.close()
        return seen, ages

    seen, ages = run(main())
    assert (seen, ages) == run(main())
    assert seen[-1][1] > 0.0
    # The drive answers in its next cycle of 1 ms at the latest, and 3 ms later the answer is there.
    assert len(ages) > 40
    assert all(age_s is not None and 0.0059 < age_s < 0.0071 for age_s in ages[2:])


@pytest.mark.parametrize("by_s", [3600.0, -3600.0])
def test_a_frame_on_its_way_arrives_though_the_clock_is_set(rig: Rig, by_s: float) -> None:
    """With the stamp of before; it waited for an hour where the clock was set back."""
    rig.wire.disturb(lambda _sender, message, _now_s: [(0.25, message)])
    rig.send(1)
    rig.clock.now_s += by_s
    rig.wire.clock_was_set(by_s)
    assert rig.received(rig.b) == []
    rig.clock.now_s += 0.25
    assert rig.received(rig.b) == [(1, 5.25)]
    rig.send(2)
    rig.clock.now_s += 0.25
    ((number, stamp_s),) = rig.received(rig.b)
    assert number == 2
    assert stamp_s == pytest.approx(5.5 + by_s)
