"""A bus as the service runs it, where the ticks are late."""

import pytest

from tests.service.rig import BUS
from twostage_servo.canbus.link import Link
from twostage_servo.service.port import Port
from twostage_servo.ticks import Tick


@pytest.mark.parametrize("first", [0, 1])
def test_the_bus_is_looked_after_once_a_second_though_every_other_tick_is_missed(
    monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    looked = []
    link = Link(BUS, [])
    monkeypatch.setattr(link, "check", lambda: looked.append(True))
    port = Port(link, [], 0.01)
    port.error = None
    for index in range(first, 1000, 2):
        port.publish(Tick(index, 0.01 * index, 0.0, 1))
    assert len(looked) == 10
