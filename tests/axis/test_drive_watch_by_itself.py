"""What an axis makes of what comes from its drive, with the parts that are told of it standing in."""

from types import SimpleNamespace
from typing import Any

import pytest

from twostage_servo.axis.drive_watch import DriveWatch
from twostage_servo.axis.messages import Feedback
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode


class Bench:
    """A watch, and what it has told the other parts."""

    def __init__(self, state: State = State.HOLDING, *, sure: bool = True, reason: str | None = None) -> None:
        self.lost: list[str] = []
        self.tripped: list[tuple[TripCode, str]] = []
        self.counted: list[dict[str, Any]] = []
        self.driven: list[bool] = []
        machine: Any = SimpleNamespace(state=state)
        self.law: Any = SimpleNamespace(observer=SimpleNamespace(velocity=-20.0), cruise_velocity=-50.0)
        drive: Any = SimpleNamespace(
            accept_feedback=self._accept, fresh=True, position=7.0, counts_boots=True, age_s=0.004, sure=sure
        )

        def update(missed: int, position: float | None, speed: float, **facts: Any) -> str | None:
            self.counted.append({"missed": missed, "position": position, "speed": speed} | facts)
            return reason

        count: Any = SimpleNamespace(update=update)
        reference: Any = SimpleNamespace(lose=self.lost.append, is_homed=True)
        latch: Any = SimpleNamespace(raise_trip=lambda code, cause: self.tripped.append((code, cause)))
        motion: Any = SimpleNamespace(law=self.law)
        nothing: Any = None
        self.machine, self.drive = machine, drive
        self.watch = DriveWatch(machine, drive, nothing, count, motion, reference, nothing, latch)

    def _accept(self, _feedback: Feedback, _reception: object, *, driven: bool) -> bool:
        self.driven.append(driven)
        sure: bool = self.drive.sure
        return sure


@pytest.mark.parametrize(("state", "driven"), [(State.HOLDING, True), (State.STOPPING, True), (State.ARMING, False)])
def test_feedback_is_told_whether_the_axis_is_driven(state: State, driven: bool) -> None:
    bench = Bench(state)
    bench.watch.accept_feedback(Feedback(1.0))
    assert (bench.driven, bench.lost) == ([driven], [])


def test_a_position_that_may_be_half_a_revolution_off_is_lost_with_its_reason() -> None:
    bench = Bench(sure=False)
    bench.watch.accept_feedback(Feedback(1.0))
    (reason,) = bench.lost
    assert "half of its encoder's counting range" in reason


def test_the_count_is_compared_with_all_that_is_known() -> None:
    bench = Bench(State.SPEED_STAGE)
    bench.watch.begin_tick(2)
    bench.watch.check_count()
    facts = {"driven": True, "homed": True, "counts_boots": True, "age_s": 0.004}
    assert bench.counted == [{"missed": 2, "position": 7.0, "speed": 50.0} | facts]
    bench.law.cruise_velocity, bench.drive.fresh, bench.drive.age_s = 10.0, False, None
    bench.watch.check_count()
    assert bench.counted[1] == {"missed": 2, "position": None, "speed": 20.0} | facts | {"age_s": None}


@pytest.mark.parametrize(
    ("before", "now", "driven"),
    [
        (State.HOLDING, State.HOLDING, True),
        (State.HOLDING, State.TRIPPED, True),  # disabled in this tick: its sample is of before
        (State.DISARMED, State.ARMING, True),
        (State.DISARMED, State.DISARMED, False),
    ],
)
def test_while_it_is_driven_or_was_as_the_tick_began_its_speed_may_be_any(
    before: State, now: State, driven: bool
) -> None:
    bench = Bench(before)
    bench.watch.begin_tick(0)
    bench.machine.state = now
    bench.watch.check_count()
    assert bench.counted[0]["driven"] is driven
    assert bench.counted[0]["speed"] == 20.0  # the cruise velocity is one only while a set-point is in force


@pytest.mark.parametrize(
    ("state", "trips"),
    [
        (State.HOLDING, True), (State.STOPPING, True), (State.TRIPPED_STOPPING, False), (State.TRIPPED, False),
        (State.DISARMED, False), (State.ARMING, False),
    ],
)  # fmt: skip
def test_a_count_that_began_anew_loses_the_reference_and_trips_an_axis_that_goes_by_it(
    state: State, trips: bool
) -> None:
    bench = Bench(state, reason="it counts anew")
    bench.watch.check_count()
    assert bench.tripped == [(TripCode.POSITION_JUMP, "it counts anew")] * trips
    assert bench.lost == ["it counts anew"]
