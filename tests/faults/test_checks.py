"""When a check of the campaign calls a reaction too late, on either side of its bound."""

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from twostage_servo.axis.state import State
from twostage_servo.config.loader import load
from twostage_servo.faults.checks import trips_early
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
