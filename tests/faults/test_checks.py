"""When a check of the campaign calls a reaction too late, on either side of its bound."""

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from twostage_servo.app.assembly import design
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.state import State
from twostage_servo.config.loader import load
from twostage_servo.faults.checks import continuous, trips_early, within_stall_effort
from twostage_servo.faults.servo_gains import servo_gains_of
from twostage_servo.faults.world import World


def tripped_after(distance: float, tick_ms: float) -> World:
    """Return a world in which the axis has gone so far (mm) from the place of the fault until it tripped."""
    settings = load(None).config.axis
    samples: list[Any] = [
        SimpleNamespace(state=State.SPEED_STAGE.value, position=7.0),
        SimpleNamespace(state=State.TRIPPED_QUICK_STOP.value, position=7.0 - distance),
        SimpleNamespace(state=State.TRIPPED.value, position=-500.0),  # what the stop costs is the budget's
    ]
    world = SimpleNamespace(
        axis=SimpleNamespace(settings=settings), period_s=1e-3 * tick_ms, samples=samples, fault_place=7.0
    )
    return cast("World", world)


@pytest.mark.parametrize(
    ("tick_ms", "distance", "in_time"),
    [
        (10.0, 4.99, True),  # ten times the innovation gate of 0.5 mm
        (10.0, 5.01, False),
        (2.0, 5.01, False),
        (20.0, 5.99, True),  # three ticks of the cruise at 100 mm/s
        (20.0, 6.01, False),
    ],
)
def test_a_wrong_encoder_is_noticed_early_within_ten_gates_or_the_samples_that_it_takes(
    tick_ms: float, distance: float, *, in_time: bool
) -> None:
    wrong = asyncio.run(trips_early(tripped_after(distance, tick_ms)))
    assert (wrong is None) is in_time


def retargeted(usual_step: float, first_step: float, later_step: float, law: str = "paper") -> World:
    """Return a world whose effort rises evenly, until a new set-point after two ticks gives it other steps."""
    design = load_design(law)
    efforts = [0.0, usual_step]
    with_it = [*efforts, usual_step + first_step, usual_step + first_step + later_step]
    without = [*efforts, 2.0 * usual_step, 3.0 * usual_step]

    def samples(run: list[float]) -> list[Any]:
        return [SimpleNamespace(time_s=0.01 * n, effort=effort, velocity=100.0) for n, effort in enumerate(run)]

    world = SimpleNamespace(
        axis=SimpleNamespace(design=design), period_s=0.01, velocity=100.0, fault_s=0.015,
        samples=samples(with_it), undisturbed=samples(without),
    )  # fmt: skip
    return cast("World", world)


def load_design(law: str = "paper") -> AxisDesign:
    return design(load(None, [f"axis.law.type={law}"]))


_SUM = servo_gains_of(load_design()).f11 * 0.01 * 100.0 * 1.1
"""What the law's sum adds to the effort in a tick, in V."""


@pytest.mark.parametrize(
    ("usual", "first", "later", "is_continuous"),
    [
        (0.5, 0.9, 1.49, True),  # a turn: three usual steps
        (0.5, 0.9, 1.51, False),
        (0.05, 0.04 + _SUM, 0.05, True),  # a limit of the acceleration keeps the usual steps small, not the sum's tick
        (0.05, 0.06 + _SUM, 0.05, False),
        (0.05, 0.04 + _SUM, 0.06 + _SUM, False),
    ],
)
def test_a_new_set_point_is_taken_without_a_bump(
    usual: float, first: float, later: float, *, is_continuous: bool
) -> None:
    wrong = asyncio.run(continuous(retargeted(usual, first, later)))
    assert (wrong is None) is is_continuous, wrong


@pytest.mark.parametrize(
    ("first", "later", "is_continuous"),
    [(4.0, 4.0, True), (11.9, 11.9, True), (-4.7, 4.0, True), (-4.9, 4.0, False), (8.0, 12.1, False)],
)
def test_a_law_that_follows_a_plan_begins_another_by_no_more_than_twice_what_it_has_begun_with(
    first: float, later: float, *, is_continuous: bool
) -> None:
    """The first tick after the set-point differs from a usual step of 4 V by two and a tenth, a later one is three."""
    wrong = asyncio.run(continuous(retargeted(4.0, first, later, "adaptive")))
    assert (wrong is None) is is_continuous, wrong
    wrong = asyncio.run(continuous(retargeted(4.0, first, later)))
    assert (wrong is None) is (0.0 < first <= 4.0 + _SUM and is_continuous)


def stalled(law: str, effort: float, ticks: int, velocity: float = 0.0) -> World:
    """Return a world whose axis is stuck, before it sets out or at a velocity, and pushed for so many ticks."""
    before = SimpleNamespace(time_s=0.0, state=State.HOLDING.value, effort=0.0, velocity=velocity)
    pushed = [
        SimpleNamespace(time_s=0.01 * n, state=State.SPEED_STAGE.value, effort=effort) for n in range(1, ticks + 1)
    ]
    after = SimpleNamespace(time_s=0.01 * (ticks + 1), state=State.TRIPPED_QUICK_STOP.value, effort=effort)
    world = SimpleNamespace(
        axis=SimpleNamespace(design=load_design(law), settings=load(None).config.axis), begun_s=0.005, velocity=100.0,
        samples=[before, *pushed, after], target=400.0, fault_place=200.0,
        undisturbed=[SimpleNamespace(effort=-17.0), SimpleNamespace(effort=7.8)],
    )  # fmt: skip
    return cast("World", world)


@pytest.mark.parametrize(
    ("law", "effort", "ticks", "is_met"),
    [
        ("adaptive", 19.4, 3, True),  # 17 V of the same move without a stall, and 2.5 V that tell one
        ("adaptive", 19.6, 3, False),
        (
            "adaptive",
            19.4,
            4,
            False,
        ),  # in all more than the paper's law, which rises evenly to 9 V in 15.5 ticks: 69.8 V
        ("adaptive", 8.9, 9, True),
        ("adaptive", 7.8, 100, False),  # not told in time
        ("paper", 19.4, 5, False),
        ("paper", 9.1, 5, False),
        ("paper", 8.9, 5, True),
    ],
)
def test_an_axis_that_is_stuck_is_pushed_as_its_plan_would_and_no_more_than_tells_a_stall(
    law: str, effort: float, ticks: int, is_met: bool
) -> None:
    wrong = asyncio.run(within_stall_effort(stalled(law, effort, ticks)))
    assert (wrong is None) is is_met, wrong


@pytest.mark.parametrize(
    ("effort", "velocity", "ticks", "is_met"),
    [(24.0, 100.0, 4, True), (24.1, 100.0, 4, False), (24.0, 2.4, 2, False), (24.0, 100.0, 5, False)],
)
def test_quick_loops_may_push_an_axis_that_stops_in_mid_motion_up_to_the_limit(
    effort: float, velocity: float, ticks: int, is_met: bool
) -> None:
    wrong = asyncio.run(within_stall_effort(stalled("adaptive", effort, ticks, velocity)))
    assert (wrong is None) is is_met, wrong
