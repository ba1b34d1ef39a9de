"""Somebody else's commands: for how long they count, and what is said of them."""

import pytest

from tests.axis.rig import PERIOD_S, axis_settings
from twostage_servo.axis.foreign_commands import ForeignCommands

LASTS = 50
"""500 ms of arming time-out."""


def after(ticks: int, foreign: ForeignCommands, missed: int = 0) -> ForeignCommands:
    for _ in range(ticks):
        foreign.begin_tick(missed)
    return foreign


def new() -> ForeignCommands:
    return ForeignCommands(axis_settings(), PERIOD_S)


def test_before_the_first_there_is_none() -> None:
    foreign = after(3, new())
    assert (foreign.lasts, foreign.came_within(1e9)) == (False, False)
    assert (foreign.latest.frame, foreign.latest.enables) == ("", None)


@pytest.mark.parametrize("missed", [0, 4])
def test_one_lasts_for_as_long_as_arming_may_take(missed: int) -> None:
    foreign = new()
    foreign.record("0x201", enables=False)
    ticks = LASTS // (1 + missed)
    assert after(ticks - 1, foreign, missed).lasts
    assert not after(1, foreign, missed).lasts
    assert (foreign.latest.frame, foreign.latest.enables) == ("0x201", False)


def test_how_many_there_were_and_how_long_ago_is_said_unless_it_is_the_first_of_this_tick() -> None:
    foreign = new()
    foreign.record("0x201", enables=True)
    assert str(foreign) == "0x201"
    assert str(after(3, foreign)) == "0x201 (frame 1, 30 ms ago)"
    foreign.record("0x202", enables=None)
    assert str(foreign) == "0x202 (frame 2, 0 ms ago)"
    assert foreign.latest.enables is None
    after(LASTS - 1, foreign)
    foreign.record("0x203", enables=None)
    assert str(foreign) == "0x203 (frame 3, 0 ms ago)"
    after(LASTS, foreign)
    foreign.record("0x204", enables=None)  # nothing lasted any more
    assert str(foreign) == "0x204"


def test_one_came_within_a_time_that_is_no_shorter_than_its_age() -> None:
    foreign = new()
    foreign.record("0x201", enables=True)
    assert foreign.came_within(0.0)
    after(3, foreign)
    assert [foreign.came_within(duration_ms) for duration_ms in (29.0, 30.0, 31.0)] == [False, True, True]


def test_after_other_settings_the_same_is_known() -> None:
    former, foreign = new(), new()
    for _ in range(3):
        former.record("0x201", enables=True)
    after(2, former)
    foreign.continue_from(former)
    assert (str(foreign), foreign.latest.enables, foreign.lasts) == ("0x201 (frame 3, 20 ms ago)", True, True)
