"""How long a move takes by the design, against moves that are made, and against the paper's law in matrices."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.duration import MoveDuration
from twostage_servo.axis.state import State
from twostage_servo.control.baselines.transcription import TranscribedLaw
from twostage_servo.control.laws.law import DesignError
from twostage_servo.control.laws.paper_design import UnitResponse
from twostage_servo.control.optimal import ServoGains

DESIGN = design_axis(axis_settings(), PERIOD_S)
WINDOW = DESIGN.settings.window.position
ACCELERATION = DESIGN.settings.limits.acceleration


def transcribed_duration_s(distance: float, velocity: float) -> float:
    """The paper's law on its own model, without a ramp: when it is within the window for good, plus the ramp's time."""
    plant = DESIGN.plant
    law = TranscribedLaw(
        plant, DESIGN.settings.law.paper.performance_index_ratio, DESIGN.settings.observer.measurement_variance
    )
    law.set_target(distance, velocity)
    position = speed = effort = 0.0
    outside = 0
    ramps = distance > DESIGN.changeover_distance(velocity)
    for tick in range(1, math.ceil(2.0 * distance / velocity / PERIOD_S) + 400):
        answer = law.step(position)
        position, speed = (
            position + plant.a12 * speed + plant.b1 * effort,
            plant.a22 * speed + plant.b2 * effort,
        )
        effort = answer
        if abs(distance - position) > WINDOW:
            outside = tick
    return PERIOD_S * (outside + 1) + (velocity / (2.0 * ACCELERATION) if ramps else 0.0)


@pytest.mark.parametrize("velocity", [10.0, 100.0, 250.0])
@pytest.mark.parametrize("distance", [0.06, 5.0, 40.0, 60.0, 100.0, 400.0])
def test_it_is_when_the_window_is_entered_for_good(distance: float, velocity: float) -> None:
    """With and without a cruise, on a plant that is the model; to two ticks."""
    rig = AxisRig(Axis(DESIGN, TRAITS)).armed()
    rig.axis.move_to(distance, velocity)
    begun = outside = rig.tick_index
    while rig.state() is not State.HOLDING:
        rig.tick()
        if abs(rig.position - distance) > WINDOW:
            outside = rig.tick_index
    duration_s = rig.axis.duration.duration_s(distance, velocity)
    assert duration_s == pytest.approx(PERIOD_S * (outside - begun), abs=2.1 * PERIOD_S)


@pytest.mark.parametrize("velocity", [10.0, 100.0, 250.0])
@pytest.mark.parametrize("share", [0.02, 0.1, 0.5, 0.9, 0.999])
def test_a_move_without_a_cruise_takes_what_the_law_in_matrices_takes_to_the_tick(
    share: float, velocity: float
) -> None:
    distance = share * DESIGN.changeover_distance(velocity)
    assert MoveDuration(DESIGN).duration_s(distance, velocity) == pytest.approx(
        transcribed_duration_s(distance, velocity), abs=1e-9
    )


@pytest.mark.parametrize("velocity", [20.0, 100.0, 250.0])
@pytest.mark.parametrize("cruise_s", [1.5, 1.503, 1.507, 4.0])
def test_a_move_with_a_cruise_takes_what_the_law_in_matrices_takes_to_a_tick_and_a_half(
    cruise_s: float, velocity: float
) -> None:
    distance = DESIGN.changeover_distance(velocity) + cruise_s * velocity
    assert MoveDuration(DESIGN).duration_s(distance, velocity) == pytest.approx(
        transcribed_duration_s(distance, velocity), abs=1.5 * PERIOD_S
    )


def test_a_millimetre_more_of_cruise_takes_its_time_and_no_more() -> None:
    duration = MoveDuration(DESIGN)
    assert duration.duration_s(401.0, 100.0) - duration.duration_s(400.0, 100.0) == pytest.approx(0.01, abs=1e-12)
    assert duration.duration_s(1000.0, 100.0) - duration.duration_s(400.0, 100.0) == pytest.approx(6.0, abs=1e-12)


def test_the_ramp_adds_half_of_its_length() -> None:
    steep = MoveDuration(design_axis(axis_settings(acceleration=4000.0), PERIOD_S))
    flat = MoveDuration(DESIGN)
    difference_s = flat.duration_s(400.0, 100.0) - steep.duration_s(400.0, 100.0)
    assert difference_s == pytest.approx(100.0 / 2.0 / 2000.0 - 100.0 / 2.0 / 4000.0, abs=1e-12)


def test_within_the_window_there_is_nothing_to_do() -> None:
    duration = MoveDuration(DESIGN)
    assert duration.duration_s(WINDOW, 100.0) == duration.duration_s(0.0, 100.0) == 0.0
    assert duration.duration_s(1.01 * WINDOW, 100.0) > 0.0
    assert duration.velocity_for(WINDOW, 10.0, 80.0) == 80.0


@given(distance=st.floats(0.06, 4000.0), longer=st.floats(1.0, 50.0))
@settings(max_examples=100, deadline=None)
def test_the_velocity_for_a_duration_gives_that_duration(distance: float, longer: float) -> None:
    duration = MoveDuration(DESIGN)
    wanted = longer * duration.duration_s(distance, 100.0)
    velocity = duration.velocity_for(distance, wanted, 100.0)
    assert 0.0 < velocity <= 100.0
    assert duration.duration_s(distance, velocity) <= wanted + 1e-9
    if longer > 1.001:
        assert velocity < 100.0
    if velocity < 100.0:
        assert duration.duration_s(distance, (1.0 - 1e-9) * velocity) > wanted - 1e-9


def test_who_has_no_time_to_lose_goes_as_fast_as_allowed() -> None:
    duration = MoveDuration(DESIGN)
    assert duration.velocity_for(400.0, 1.0, 100.0) == 100.0
    assert duration.velocity_for(400.0, duration.duration_s(400.0, 100.0), 100.0) == 100.0


def test_a_response_that_never_comes_to_rest_is_a_problem_of_the_ratio() -> None:
    with pytest.raises(DesignError, match="never comes to rest") as raised:
        UnitResponse(ServoGains(f11=-1.0, f12=0.0, f22=1e-6), DESIGN.plant, PERIOD_S)
    assert raised.value.key == ("performance_index_ratio",)
