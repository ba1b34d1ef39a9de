"""How old a frame is, by clocks that a test sets."""

import time
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.canbus.frame_age import FrameAge
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.canbus.link import BusSettings, Link

FEEDBACK = Identifier(0x181, extended=False)
NOW_S = 1.8e9  # the wall clock counts from 1970


class Clock:
    """Monotonic time, and a wall clock that can be set."""

    def __init__(self) -> None:
        self.monotonic_s = 5000.0
        self.set_by_s = NOW_S - self.monotonic_s

    def wall(self) -> float:
        return self.monotonic_s + self.set_by_s

    def monotonic(self) -> float:
        return self.monotonic_s

    def age(self) -> FrameAge:
        return FrameAge(self.wall, self.monotonic)


class StampingBus(can.BusABC):
    """Gives the frames that are laid into it."""

    def __init__(self) -> None:
        self.channel_info = "stamping"
        self.frames: list[can.Message] = []
        super().__init__("stamping")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return (self.frames.pop(0) if self.frames else None), True

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


class ClockedBus(StampingBus):
    def __init__(self, now_s: float) -> None:
        self.now_s = now_s
        super().__init__()

    def clock(self) -> float:
        return self.now_s


def frame(timestamp: float) -> can.Message:
    return can.Message(arbitration_id=0x181, is_extended_id=False, timestamp=timestamp)


def link_to(bus: can.BusABC, interface: str = "virtual") -> Link:
    link = Link(BusSettings(interface=interface, channel="can0"), [FEEDBACK], lambda: bus)
    link.open()
    return link


@given(waits_s=st.lists(st.floats(1e-3, 0.1), min_size=1, max_size=10), share=st.floats(0, 1))
def test_the_age_is_the_time_since_the_stamp(waits_s: list[float], share: float) -> None:
    clock = Clock()
    age = clock.age()
    for wait_s in waits_s:
        stamp_s = clock.wall() + share * wait_s
        clock.monotonic_s += wait_s
        age.drained()
        clock.monotonic_s += 0.004  # what happens after the drain ages nothing
        assert age.age_s(stamp_s) == pytest.approx((1 - share) * wait_s, abs=1e-6)


@given(step_s=st.floats(0.0015, 1e9) | st.floats(-1e9, -0.0015), before=st.booleans())
def test_a_wall_clock_that_was_set_tells_no_age_and_is_believed_again_at_the_next_drain(
    step_s: float, before: bool
) -> None:
    clock = Clock()
    age = clock.age()
    stamp_s = clock.wall() + 0.004
    clock.monotonic_s += 0.01
    if before:  # the frame came after the clock was set
        stamp_s += step_s
    clock.set_by_s += step_s
    age.drained()
    assert age.age_s(stamp_s) is None
    stamp_s = clock.wall() + 0.004
    clock.monotonic_s += 0.01
    age.drained()
    # A float of a wall clock that was set a billion seconds ahead is coarser, not wrong.
    assert age.age_s(stamp_s) == pytest.approx(0.006, abs=2e-6)


@given(st.floats(-0.0004, 0.0004), st.floats(0.001, 10.0))
def test_a_clock_that_is_being_slewed_is_believed(rate: float, wait_s: float) -> None:
    clock = Clock()
    age = clock.age()
    stamp_s = clock.wall()
    clock.monotonic_s += wait_s
    clock.set_by_s += rate * wait_s
    age.drained()
    assert age.age_s(stamp_s) == pytest.approx(wait_s * (1 + rate), abs=1e-6)


@pytest.mark.parametrize(
    ("stamp_s", "expected"),
    [(9.99, 0.02), (10.01, 0.0), (10.0100005, 0.0), (10.0101, None), (9.01, 1.0), (8.99, None), (0.0, None)],
)
def test_an_age_beyond_the_time_since_the_drain_before_is_not_believed(stamp_s: float, expected: float | None) -> None:
    now_s = 10.0
    age = FrameAge(lambda: now_s, lambda: now_s)
    now_s += 0.01
    age.drained()
    assert age.age_s(stamp_s) == (None if expected is None else pytest.approx(expected))


def test_before_the_first_drain_nothing_is_known() -> None:
    assert Clock().age().age_s(NOW_S - 0.5) is None


def test_a_bus_with_a_clock_of_its_own_is_asked() -> None:
    bus = ClockedBus(100.0)
    link = link_to(bus)
    for late_s in (0.0, 0.004, 0.009):
        bus.frames.append(frame(bus.now_s + late_s))
    bus.now_s += 0.01
    assert [link.age_s(message) for message in link.drain()] == pytest.approx([0.01, 0.006, 0.001])
    link.close()


def test_socketcan_is_dated_by_the_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(time, "time", clock.wall)
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    bus = StampingBus()
    link = link_to(bus, "socketcan")
    bus.frames = [frame(clock.wall() + 0.003)]
    clock.monotonic_s += 0.01
    (message,) = link.drain()
    assert link.age_s(message) == pytest.approx(0.007, abs=1e-6)
    bus.frames = [frame(clock.wall())]
    clock.set_by_s += 3600.0
    (message,) = link.drain()
    assert link.age_s(message) is None
    link.close()


@pytest.mark.parametrize("interface", ["virtual", "socketcand", "udp_multicast", "pcan"])
def test_where_nothing_is_known_about_the_stamps_no_age_is_told(interface: str) -> None:
    bus = StampingBus()
    link = link_to(bus, interface)
    bus.frames = [frame(time.time())]
    (message,) = link.drain()
    assert link.age_s(message) is None
    link.close()


def test_the_opener_takes_the_place_of_the_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: Any) -> can.BusABC:
        raise AssertionError("python-can was asked")

    monkeypatch.setattr(can, "Bus", refuse)
    buses = [StampingBus(), StampingBus()]
    opened = iter(buses)
    link = Link(BusSettings(interface="socketcan", channel="can0"), [FEEDBACK], lambda: next(opened))
    for bus in buses:
        link.open()
        bus.frames = [frame(0.0)]
        assert len(link.drain()) == 1
        link.close()


def test_how_long_a_frame_had_been_there_at_the_drain_before() -> None:
    now_s = 0.0
    age = FrameAge(lambda: now_s, lambda: now_s)
    for now_s in (1.0, 1.01):  # noqa: B007 - the clock reads it
        age.drained()
    assert [age.waited_s(stamp_s) for stamp_s in (1.01, 1.0, 0.98, 1.2)] == pytest.approx([0.0, 0.0, 0.02, None])
