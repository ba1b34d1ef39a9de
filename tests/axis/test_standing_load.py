"""Which part of a disturbance is taken for a load, and which for friction that the model does not have."""

import pytest

from tests.axis.rig import PERIOD_S, axis_settings
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.standing_load import StandingLoad
from twostage_servo.control.model_monitor.hypotheses import ACCEPTED

DESIGN = design_axis(axis_settings(), PERIOD_S)
FRICTION = 14.0 / 180.0
"""Of the model, in V for each mm/s."""
LEAST = 1.0 - max(pole / gain for gain, pole, _ in ACCEPTED)
MOST = 1.0 - min(pole / gain for gain, pole, _ in ACCEPTED)
"""As a multiple of it, what an accepted plant has less at a speed, and more."""


def noted(velocity: float, disturbance: float, ticks: int = 1, load: StandingLoad | None = None) -> StandingLoad:
    load = StandingLoad(DESIGN) if load is None else load
    observer = DESIGN.build_law().observer
    observer.velocity, observer.disturbance = velocity, disturbance
    for _ in range(ticks):
        load.update(observer)
    return load


def test_at_rest_all_of_it_is_load_as_soon_as_it_lasts_for_some_ticks() -> None:
    assert noted(0.0, 2.0).load == pytest.approx(0.3 * 2.0)
    assert noted(0.0, 2.0, ticks=3).load == pytest.approx((1.0 - 0.7**3) * 2.0)
    assert noted(0.0, -2.0, ticks=50).load == pytest.approx(-2.0)


@pytest.mark.parametrize("velocity", [100.0, -100.0, 0.5])
@pytest.mark.parametrize("share", [LEAST + 0.001, -0.2, 0.2, MOST - 0.001])
@pytest.mark.parametrize("weight", [0.0, 1.5])
def test_what_friction_explains_is_none(velocity: float, share: float, weight: float) -> None:
    load = noted(0.0, weight, ticks=100)
    noted(velocity, weight + share * FRICTION * velocity, ticks=20, load=load)
    assert load.load == pytest.approx(weight)
    assert load.friction(velocity, weight + share * FRICTION * velocity) == pytest.approx(
        share * FRICTION if abs(velocity) > 2.5 else 0.0
    )


@pytest.mark.parametrize("velocity", [100.0, -100.0])
@pytest.mark.parametrize(("share", "explained"), [(3.0, MOST), (-3.0, LEAST)])
def test_beyond_the_friction_of_an_accepted_plant_it_is_load(velocity: float, share: float, explained: float) -> None:
    disturbance = share * FRICTION * velocity
    load = noted(velocity, disturbance)
    assert load.load == pytest.approx(0.3 * (disturbance - explained * FRICTION * velocity))
    load.start()
    assert load.load == 0.0
    assert load.friction(velocity, disturbance) == pytest.approx(explained * FRICTION)


def test_at_rest_nothing_of_it_is_friction() -> None:
    load = StandingLoad(DESIGN)
    assert load.friction(DESIGN.rest_velocity, 0.01) == 0.0
    assert load.friction(-DESIGN.rest_velocity, 0.01) == 0.0
    assert load.friction(1.001 * DESIGN.rest_velocity, 0.01) != 0.0
