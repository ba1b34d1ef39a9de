"""What error frames say about the CAN controller; the bits are those of linux/can/error.h."""

from typing import Any

import can
import pytest

from tests.canbus.test_link import FEEDBACK, FakeBus, frame
from twostage_servo.canbus.link import BusSettings, Link, LinkCounters, LinkError


def error_frame(status: int | None, classes: int = 0x04) -> can.Message:
    data = b"" if status is None else bytes((0, status, 0, 0, 0, 0, 0, 0))
    return can.Message(arbitration_id=classes, is_error_frame=True, is_extended_id=False, data=data)


def link_that_gets(*frames: can.Message, interface: str = "socketcan") -> Link:
    queue: list[Any] = [*frames, None]
    link = Link(
        BusSettings(interface=interface, channel="can0"),
        [FEEDBACK],
        lambda: FakeBus(lambda: queue.pop(0) if queue else None, lambda: None),
    )
    link.open()
    return link


@pytest.mark.parametrize(
    ("frames", "state"),
    [
        ([], "active"),
        ([error_frame(0x04)], "warning"),  # receive errors
        ([error_frame(0x08)], "warning"),  # transmit errors
        ([error_frame(0x10)], "passive"),
        ([error_frame(0x20)], "passive"),
        ([error_frame(0x24)], "passive"),  # transmit passive, receive warning: the worse one counts
        ([error_frame(0x08), error_frame(0x20), error_frame(0x08)], "warning"),  # and recovering
        ([error_frame(0x20), error_frame(0x40)], "active"),
        ([error_frame(0x20), error_frame(0x01), error_frame(0x00)], "passive"),  # an overflow says nothing about it
        ([error_frame(0x20), error_frame(0x40, classes=0x08)], "passive"),  # byte 1 of another class
        ([error_frame(0x20), error_frame(None)], "passive"),
        ([error_frame(0x20), error_frame(0x00, classes=0x100)], "active"),  # restarted
        ([error_frame(0x20, classes=0x04 | 0x08 | 0x20)], "passive"),  # several classes in one frame
    ],
)
def test_the_latest_error_frame_gives_the_state(frames: list[can.Message], state: str) -> None:
    link = link_that_gets(*frames, frame())
    assert len(link.drain()) == 1
    assert link.controller_state == state
    assert link.counters.errors == sum(link.counters.errors_by_kind.values()) == len(frames)
    link.close()


def test_error_frames_are_counted_by_what_they_say() -> None:
    frames = [error_frame(0x04), error_frame(0x20), error_frame(0x20), error_frame(0x40), error_frame(0x01)]
    link = link_that_gets(*frames, error_frame(0x00, classes=0x100), error_frame(0x00, classes=0x08), frame())
    link.drain()
    assert link.counters.errors_by_kind == {"warning": 1, "passive": 2, "active": 1, "other": 2, "restarted": 1}
    link.close()


def test_the_controllers_error_counters_are_the_latest_that_an_error_frame_tells() -> None:
    telling = can.Message(
        arbitration_id=0x204, is_error_frame=True, is_extended_id=False, data=bytes((0, 0x20, 0, 0, 0, 0, 130, 96))
    )
    link = link_that_gets(telling, error_frame(0x20))  # the second has bytes 6 and 7, and does not say what they are
    counters = [link.error_counters]
    link.drain()
    counters.append(link.error_counters)
    link.close()
    link.open()
    assert [*counters, link.error_counters] == [None, (130, 96), None]
    link.close()


def test_a_link_that_opens_anew_begins_active() -> None:
    link = link_that_gets(error_frame(0x20))
    link.drain()
    link.close()
    states = [link.controller_state]
    link.open()
    states.append(link.controller_state)
    assert states == ["passive", "active"]
    link.close()


def test_bus_off_still_fails_the_link() -> None:
    link = link_that_gets(error_frame(0x20, classes=0x44))
    with pytest.raises(LinkError, match="went bus-off"):
        link.drain()
    link.close()


def test_an_interface_with_other_error_frames_tells_no_state() -> None:
    link = link_that_gets(error_frame(0x20), error_frame(0x20, classes=0x44), interface="pcan")
    assert link.drain() == []
    assert (link.controller_state, link.counters.errors_by_kind) == ("active", {"other": 2})
    link.close()


def test_rejections_are_counted_by_their_reason() -> None:
    counters = LinkCounters()
    for reason in ("length", "checksum", "length"):
        counters.count_rejection(reason)
    assert counters == LinkCounters(rejected=3, rejected_by_reason={"length": 2, "checksum": 1})
