"""What the log is told of a disabled axis, line by line and tick by tick."""

from types import SimpleNamespace
from typing import Any

import pytest
import structlog

from twostage_servo.axis.trips import Trip, TripCode
from twostage_servo.service.disabled_report import DisabledReport
from twostage_servo.timing.ticks import Tick

EVERY = 1000
"""Ticks of 10 ms in 10 s."""
MOVES = "the axis moves although its drive was told to disable"


class Told:
    """A report with the axis that it looks at, and the lines of a tick."""

    def __init__(self, period_s: float = 0.01) -> None:
        limits = SimpleNamespace(limits=SimpleNamespace(innovation_gate=0.5), unit="mm")
        self.axis: Any = SimpleNamespace(
            lasting=(), trips={}, disabled=SimpleNamespace(moved=None), settings=limits,
            design=SimpleNamespace(period_s=period_s),
        )  # fmt: skip
        axis_loop: Any = SimpleNamespace(name="x", axis=self.axis)
        self.report = DisabledReport(axis_loop)

    def lasts(self, *codes: TripCode) -> None:
        self.axis.lasting = tuple(Trip(code, f"cause of {code}", 7) for code in codes)

    def tick(self, index: int) -> list[dict[str, Any]]:
        with structlog.testing.capture_logs() as logs:
            self.report.publish(Tick(index, 0.0, 0.0, 0))
        return [dict(line) for line in logs]

    def ticks_with_a_line(self, first: int, last: int) -> list[int]:
        return [index for index in range(first, last) if self.tick(index)]


# What lasts ----------------------------------------------------------------------------------------------------------


def test_what_has_not_tripped_is_told_at_once_with_all_that_is_known_of_it() -> None:
    told = Told()
    told.lasts(TripCode.FOREIGN_COMMAND)
    (trip,) = told.axis.lasting
    assert told.tick(5) == [
        {
            "event": "a condition lasts that has not tripped the axis",
            "log_level": "error",
            "axis": "x",
            "tick": 5,
            "code": TripCode.FOREIGN_COMMAND,
            "cause": "cause of foreign_command",
            "next_action": trip.next_action,
        }
    ]


@pytest.mark.parametrize("has_tripped", [True, False])
def test_it_is_repeated_every_10_s_and_after_a_trip_from_its_own_line_on(*, has_tripped: bool) -> None:
    told = Told()
    told.lasts(TripCode.DRIVE_NOT_DISABLED)
    if has_tripped:
        told.axis.trips = {TripCode.DRIVE_NOT_DISABLED: told.axis.lasting[0]}
    lines = told.ticks_with_a_line(5, 2 * EVERY + 100)
    assert lines == ([5 + EVERY, 5 + 2 * EVERY] if has_tripped else [5, 5 + EVERY, 5 + 2 * EVERY])
    (line,) = told.tick(5 + 3 * EVERY)
    assert line["event"] == (
        "the cause of the trip lasts" if has_tripped else "a condition lasts that has not tripped the axis"
    )


@pytest.mark.parametrize(("period_s", "every"), [(0.001, 10_000), (0.1, 100)])
def test_ten_seconds_are_as_many_ticks_as_go_into_them(period_s: float, every: int) -> None:
    told = Told(period_s)
    told.lasts(TripCode.FOREIGN_COMMAND)
    assert told.tick(0)
    assert not told.tick(every - 1)
    assert told.tick(every)


def test_what_is_over_and_comes_back_is_told_at_once_and_each_by_itself() -> None:
    told = Told()
    told.lasts(TripCode.FOREIGN_COMMAND)
    assert [line["code"] for line in told.tick(0)] == [TripCode.FOREIGN_COMMAND]
    told.lasts(TripCode.FOREIGN_COMMAND, TripCode.DRIVE_STATE_MISMATCH)
    assert [line["code"] for line in told.tick(1)] == [TripCode.DRIVE_STATE_MISMATCH]
    told.lasts()
    assert told.tick(2) == []
    told.lasts(TripCode.FOREIGN_COMMAND)
    assert [line["code"] for line in told.tick(3)] == [TripCode.FOREIGN_COMMAND]


# Motion --------------------------------------------------------------------------------------------------------------


def test_motion_is_told_at_once_with_its_way_and_unit() -> None:
    told = Told()
    told.axis.disabled.moved = 1.23456789
    wanted = {"event": MOVES, "log_level": "warning", "axis": "x", "tick": 5, "moved": 1.234568, "unit": "mm"}
    assert told.tick(5) == [wanted]
    assert told.tick(6) == []


def test_motion_is_told_again_after_10_s_if_the_axis_has_gone_on_by_more_than_a_sample_may_be_off() -> None:
    told = Told()
    told.axis.disabled.moved = 1.0
    assert told.tick(5)
    told.axis.disabled.moved = 9.0
    assert told.ticks_with_a_line(6, 5 + EVERY) == []
    told.axis.disabled.moved = 1.5
    assert told.ticks_with_a_line(5 + EVERY, 5 + EVERY + 10) == []
    told.axis.disabled.moved = 0.4  # either way
    assert told.ticks_with_a_line(5 + EVERY + 10, 5 + EVERY + 20) == [5 + EVERY + 10]
    told.axis.disabled.moved = 9.0
    assert told.ticks_with_a_line(5 + EVERY + 20, 5 + 2 * EVERY + 20) == [5 + 2 * EVERY + 10]


def test_motion_after_a_rest_is_told_at_once() -> None:
    told = Told()
    for index, moved in enumerate((1.0, None, 1.0, None)):
        told.axis.disabled.moved = moved
        assert bool(told.tick(index)) is (moved is not None)
