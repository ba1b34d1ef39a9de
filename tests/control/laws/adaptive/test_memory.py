"""What was learned before and comes back: it is believed within the bounds of identification, or not at all."""

import dataclasses
from math import inf, nan
from typing import Any

import pytest

from tests.control.laws.adaptive.test_adaptive_law import Rig, task
from twostage_servo.control.laws.law import Learned


def moved(rig: Rig, *targets: float) -> int:
    """Let a rig make moves; return the ticks that the last one takes to settle to 0.1 mm."""
    rig.ticks(50)
    for target in targets:
        rig.positions.clear()
        rig.move(target, 200.0, 200)
    return rig.settled_after(targets[-1], 0.1)


def off_its_model() -> Rig:
    return Rig(task(), 1.25, 1.0, delay=1)


def learned_in_two_moves() -> Learned:
    rig = off_its_model()
    moved(rig, 5.0, 0.0)
    return rig.law.learned


def test_what_comes_back_is_what_was_there() -> None:
    learned = learned_in_two_moves()
    law = Rig(task()).law
    law.recall(learned)
    assert law.learned == learned
    assert (learned.moves, learned.delay_ticks, learned.is_sure) == (2, 1, True)
    assert None not in learned.load
    assert -200.0 <= learned.delay_evidence < -6.0  # two moves have shown a later effort, each by 3 at least


def test_the_next_move_is_that_of_the_law_that_has_learned() -> None:
    anew = off_its_model()
    anew.law.recall(learned_in_two_moves())
    ticks = moved(anew, 5.0)
    assert ticks == pytest.approx(moved(off_its_model(), 5.0, 0.0, 5.0), abs=1)
    assert ticks < moved(off_its_model(), 5.0) - 1


@pytest.mark.parametrize(
    "changed",
    [
        {"gain": nan}, {"gain": inf}, {"gain": -225.0}, {"gain": 0.0}, {"gain": 180.0 * 1.66}, {"gain": 180.0 * 0.59},
        {"pole": nan}, {"pole": 0.0}, {"pole": 14.0 * 1.66}, {"pole": 14.0 * 0.49},
        {"gain_share": 0.0}, {"gain_share": 0.2}, {"gain_share": nan}, {"pole_share": 0.0}, {"pole_share": 10.0},
        {"delay_ticks": 2}, {"delay_ticks": -1}, {"delay_evidence": 201.0}, {"delay_evidence": nan},
        {"load": (25.0, 0.0)}, {"load": (0.0, nan)}, {"load": (0.0, -inf)},
        {"moves": 0}, {"moves": -1}, {"moves": 10**30}, {"delay_ticks": 1, "delay_evidence": 5.0},
        {"delay_ticks": 0, "delay_evidence": -5.0},
    ],
)  # fmt: skip
def test_what_identification_could_not_have_found_is_not_believed(changed: dict[str, Any]) -> None:
    learned = learned_in_two_moves()
    law = Rig(task()).law
    before = law.learned
    with pytest.raises(ValueError, match=f"^({'|'.join(changed)}).* is .*must be"):
        law.recall(dataclasses.replace(learned, **changed))
    assert law.learned == before
    assert law.control_estimate.model.plant == task().plant


def test_what_lies_at_the_bounds_is_believed() -> None:
    learned = learned_in_two_moves()
    law = Rig(task()).law
    at_the_bound = dataclasses.replace(learned, gain=1.65 * 180.0, pole=0.5 * 14.0)
    law.recall(at_the_bound)
    assert law.learned == at_the_bound
