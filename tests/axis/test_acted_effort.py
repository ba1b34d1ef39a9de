"""Which effort has acted, by hand: 8 V after 2 V."""

from types import SimpleNamespace
from typing import Any

import pytest

from tests.axis.rig import PERIOD_S, axis_settings
from twostage_servo.axis.acted_effort import ActedEffort
from twostage_servo.axis.design import design_axis
from twostage_servo.control.laws.timing import Timing


def followed(lag_s: float = 0.0, dating: float = 0.0) -> tuple[ActedEffort, list[Timing]]:
    """Return efforts of 2 and 8 V, and what the law is told of them."""
    told: list[Timing] = []
    law = design_axis(axis_settings(), PERIOD_S).build_law()
    date: Any = SimpleNamespace(lag_s=lag_s, dating=dating)
    effort = ActedEffort(law, date, PERIOD_S)
    assert effort._law is law
    listening: Any = SimpleNamespace(tell_timing=told.append)
    effort._law = listening
    effort.start(2.0)
    effort.give(8.0)
    return effort, told


@pytest.mark.parametrize(("share", "mean"), [(0.0, 8.0), (0.004, 8.0), (0.25, 6.5), (1.0, 2.0)])
def test_until_the_last_one_came_the_one_before_acted(share: float, mean: float) -> None:
    effort, told = followed()
    effort.begin_late(share)
    assert effort.mean == mean
    effort.tell_law()
    assert told == ([Timing(mean - 8.0, share)] if share > 0.005 else [])
    assert effort.mean == 8.0  # it acts in time from here on


@pytest.mark.parametrize(("lag_s", "is_told"), [(0.0, False), (4e-5, False), (6e-5, True), (-6e-5, True)])
def test_a_sample_of_another_age_is_told_as_well(lag_s: float, *, is_told: bool) -> None:
    effort, told = followed(lag_s, 0.3)
    effort.tell_law()
    assert told == ([Timing(lag_s=lag_s, dating=0.3)] if is_told else [])


def test_a_law_that_takes_no_account_of_it_is_told_nothing() -> None:
    law: Any = SimpleNamespace(step=None, skip=None)
    date: Any = SimpleNamespace(lag_s=0.0, dating=0.0)
    effort = ActedEffort(law, date, PERIOD_S)
    effort.start(2.0)
    effort.give(8.0)
    effort.begin_late(0.5)
    effort.tell_law()
    assert effort.mean == 8.0


@pytest.mark.parametrize(
    ("share", "late_effort", "more_way"), [(0.0, 0.0, 0.0), (0.25, -1.5, -1.125), (1.0, -6.0, 0.0)]
)
def test_what_the_way_is_more_by(share: float, late_effort: float, more_way: float) -> None:
    """8 V from a quarter of a period on, and 2 V before, twice integrated: 2 T/4 (T - T/8) + 8 (3T/4)²/2."""
    assert Timing(late_effort, share).more_way == pytest.approx(more_way)
    if share == 0.25:
        assert 0.5 * (8.0 + late_effort + more_way) == pytest.approx(2.0 * 0.25 * 0.875 + 8.0 * 0.75**2 / 2.0)
