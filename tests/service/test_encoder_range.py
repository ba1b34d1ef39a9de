"""An encoder that comes round to the same count: how long an armed axis may go unseen."""

import pytest

from twostage_servo.app.build import build_parts
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.loader import load

RANGE = "protocol.feedback.position_scale=1.52587890625e-5"
"""The shipped drive's 32 bits, with the range of 16 bits of micrometres: half of it is 102 ms at 320 mm/s."""


@pytest.mark.parametrize(
    ("stale_ms", "missed_ticks", "taken"),
    [(30, 2, True), (100, 0, True), (103, 0, False), (30, 7, True), (30, 8, False)],
)
def test_an_armed_axis_never_goes_half_a_round_unseen(stale_ms: int, missed_ticks: int, *, taken: bool) -> None:
    """Neither while frames are missing nor while ticks are missed, nor in both together."""
    loaded = load(
        None, [RANGE, f"axis.limits.stale_feedback_ms={stale_ms}", f"axis.limits.missed_ticks={missed_ticks}"]
    )
    if taken:
        build_parts(loaded)
        return
    with pytest.raises(ConfigError, match=r"allow less than 102\.4 ms for both") as refused:
        build_parts(loaded)
    assert [problem.key for problem in refused.value.problems] == ["axis.limits.stale_feedback_ms"]


def test_where_the_axis_is_short_the_nearest_round_is_the_right_one() -> None:
    short = ["axis.limits.position_minimum=-5", "axis.limits.position_maximum=5", "axis.limits.position_overrun=2"]
    short.append("axis.limits.undetected_travel=8")
    build_parts(load(None, [RANGE, *short, "axis.limits.stale_feedback_ms=500"]))
