"""How long a move takes by the design, against moves that are made."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.duration import MoveDuration
from twostage_servo.axis.state import State

DESIGN = design_axis(axis_settings(), PERIOD_S)
DURATION = MoveDuration(DESIGN)


@pytest.mark.parametrize("velocity", [10.0, 100.0, 250.0])
@pytest.mark.parametrize("distance", [0.04, 5.0, 40.0, 60.0, 100.0, 400.0])
def test_it_is_when_the_window_is_entered_for_good(distance: float, velocity: float) -> None:
    """With and without a cruise, on a plant that is the model; to two ticks."""
    rig = AxisRig(Axis(DESIGN, 16, resolution=0.001)).armed()
    rig.axis.move_to(distance, velocity)
    begun = outside = rig.tick_index
    while rig.state() is not State.HOLDING:
        rig.tick()
        if abs(rig.position - distance) > DESIGN.settings.window.position:
            outside = rig.tick_index
    assert DURATION.duration_s(distance, velocity) == pytest.approx(PERIOD_S * (outside - begun), abs=2.1 * PERIOD_S)


@given(distance=st.floats(0.01, 4000.0), longer=st.floats(1.0, 50.0))
@settings(max_examples=100, deadline=None)
def test_the_velocity_for_a_duration_gives_that_duration(distance: float, longer: float) -> None:
    wanted = longer * DURATION.duration_s(distance, 100.0)
    velocity = DURATION.velocity_for(distance, wanted, 100.0)
    assert 0.0 < velocity <= 100.0
    assert DURATION.duration_s(distance, velocity) <= wanted + PERIOD_S
    if velocity < 100.0:
        assert DURATION.duration_s(distance, 0.999 * velocity) >= wanted - PERIOD_S
