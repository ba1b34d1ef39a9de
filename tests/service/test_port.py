"""A bus as the service runs it, where the ticks are late."""

import errno

import pytest

from tests.service.rig import BUS
from twostage_servo.canbus.link import Link, LinkError
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
    port = Port(link, [], 0.01)
    monkeypatch.setattr(link, "check", check)
    monkeypatch.setattr(port, "_lose", lost.append)
    port.error = None
    port.publish(Tick(100, 1.0, 0.0, 0))
    assert lost == []
    port.publish(Tick(101, 1.01, 0.0, 0))
    assert [getattr(error.__cause__, "errno", None) for error in lost] == ([] if then is None else [then])
