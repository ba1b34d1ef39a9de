"""What the log is told of an axis after each tick, line by line; of an axis loop that is written by hand."""

from types import SimpleNamespace
from typing import Any

import pytest
import structlog

from twostage_servo.axis.reference import ReferenceSource
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import Trip, TripCode
from twostage_servo.service.event_log import EventLog
from twostage_servo.timing.ticks import Tick

ENCODER = "positions are the encoder's own: a reference that was set before the service started is not known"


class Told:
    """A reporter with the axis that it looks at."""

    def __init__(self) -> None:
        self.axis: Any = SimpleNamespace(
            state=State.DISARMED, trip=None, trips={}, escalation=None,
            reference=SimpleNamespace(source=ReferenceSource.ENCODER, lost_because=""),
            drive=SimpleNamespace(is_stale=True),
        )  # fmt: skip
        axis_loop: Any = SimpleNamespace(name="x", axis=self.axis)
        self.event_log = EventLog(axis_loop)

    def tick(self, index: int) -> list[dict[str, Any]]:
        with structlog.testing.capture_logs() as logs:
            self.event_log.publish(Tick(index, 0.0, 0.0, 0))
        return [dict(line) for line in logs]

    def trips(self, *codes: TripCode) -> list[Trip]:
        trips = [Trip(code, f"cause of {code}", 10 + number) for number, code in enumerate(codes)]
        self.axis.trips = {trip.code: trip for trip in trips}
        self.axis.trip = trips[0] if trips else None
        return trips


def line(event: str, level: str, tick: int, **fields: Any) -> dict[str, Any]:
    return {"event": event, "log_level": level, "axis": "x", "tick": tick} | fields


def test_what_does_not_change_is_told_once() -> None:
    told = Told()
    assert told.tick(3) == [line(ENCODER, "info", 3)]
    assert told.tick(4) == []


def test_each_state_is_told_with_the_one_before() -> None:
    told = Told()
    told.tick(0)
    told.axis.state = State.HOLDING
    assert told.tick(1) == [line("state", "info", 1, before=State.DISARMED, now=State.HOLDING)]
    assert told.tick(2) == []
    told.axis.state = State.DISARMED
    assert told.tick(3) == [line("state", "info", 3, before=State.HOLDING, now=State.DISARMED)]


def test_feedback_that_comes_and_goes_is_told_each_time() -> None:
    told = Told()
    told.tick(0)
    told.axis.drive.is_stale = False
    assert told.tick(1) == [line("feedback fresh", "info", 1)]
    assert told.tick(2) == []
    told.axis.drive.is_stale = True
    assert told.tick(3) == [line("feedback stale", "warning", 3)]


def test_on_what_positions_rest_is_told_whenever_it_changes() -> None:
    told = Told()
    reference = told.axis.reference
    reference.source, reference.lost_because = None, "never homed"
    assert told.tick(0) == [line("the position is not known: home the axis", "info", 0, reason="never homed")]
    reference.source, reference.lost_because = ReferenceSource.HOMED, ""
    assert told.tick(1) == [line("the position is known", "info", 1)]
    assert told.tick(2) == []
    text = "the position is no longer known: home the axis"
    for index, reason in ((3, "rebooted"), (4, "lost")):
        reference.source, reference.lost_because = None, reason
        assert told.tick(index) == [line(text, "warning", index, reason=reason)]


def test_a_first_trip_is_told_whole_and_once() -> None:
    told = Told()
    told.tick(0)
    (trip,) = told.trips(TripCode.STALL)
    first = line("trip", "error", 1, code=TripCode.STALL, cause="cause of stall", next_action=trip.next_action)
    assert told.tick(1) == [first]
    assert told.tick(2) == []


def test_later_trips_are_told_with_their_own_tick_and_anew_after_a_reset() -> None:
    told = Told()
    told.tick(0)
    for _ in range(2):
        told.trips(TripCode.STALL)
        assert [one["event"] for one in told.tick(20)] == ["trip"]
        _, overspeed, fault = told.trips(TripCode.STALL, TripCode.OVERSPEED, TripCode.DRIVE_FAULT)
        told.axis.trip = told.event_log._trip  # the same first one
        told.axis.escalation = fault
        assert told.tick(21) == [
            line("further trip", "error", 11, code=TripCode.OVERSPEED, cause=overspeed.cause),
            line("more severe trip", "error", 12, code=TripCode.DRIVE_FAULT, cause=fault.cause),
        ]
        assert told.tick(22) == []
        told.trips()
        assert told.tick(23) == []


def test_a_trip_with_others_in_its_tick_is_told_with_all_of_them() -> None:
    told = Told()
    told.tick(0)
    told.trips(TripCode.STALL, TripCode.OVERSPEED)
    assert [one["event"] for one in told.tick(1)] == ["trip", "further trip"]


@pytest.mark.parametrize("stale", [True, False])
def test_the_log_begins_with_the_state_of_its_axis_and_without_feedback(*, stale: bool) -> None:
    told = Told()
    told.axis.drive.is_stale = stale
    events = [one["event"] for one in told.tick(0)]
    assert events == [ENCODER] + ["feedback fresh"] * (not stale)
