"""The effort within its limit and its rate, by hand."""

import math

import pytest

from twostage_servo.control.laws.effort_limits import limited_effort


@pytest.mark.parametrize(
    ("wanted", "before", "effort", "saturated"),
    [
        (3.0, 2.5, 3.0, False),
        (-3.0, 2.5, -2.5, False),  # 5 in a period
        (9.0, 2.5, 7.5, False),
        (10.0, 8.0, 10.0, False),
        (10.1, 8.0, 10.0, True),
        (-99.0, -8.0, -10.0, True),
        (-99.0, 8.0, 3.0, True),
    ],
)
def test_limit_and_rate(wanted: float, before: float, effort: float, saturated: bool) -> None:
    assert limited_effort(wanted, before, 10.0, 5.0) == (effort, saturated)


@pytest.mark.parametrize("wanted", [math.inf, -math.inf, math.nan])
def test_what_is_no_number_is_handed_on_and_no_limit_has_cut_it(wanted: float) -> None:
    effort, saturated = limited_effort(wanted, 2.0, 10.0, 5.0)
    assert str(effort) == str(wanted)
    assert saturated is False
