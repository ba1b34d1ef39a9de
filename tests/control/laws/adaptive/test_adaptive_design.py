"""Margins by python-control, and times and ways against the law itself on its model."""

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.control.laws.adaptive.test_adaptive_law import PERIOD_S, Rig, design, task
from twostage_servo.control.laws.law import Controller, Loop
from twostage_servo.control.laws.registry import LAWS


def systems(loop: Loop) -> tuple[control.StateSpace, control.StateSpace]:
    """Return plant and controller of the position stage of the demo's axis, built here."""
    shown = loop.controller
    assert isinstance(shown, Controller)
    plant = control.c2d(control.ss([[0.0, 1.0], [0.0, -14.0]], [[0.0], [180.0]], [[1.0, 0.0]], 0.0), PERIOD_S)
    return plant, control.ss(shown.a, shown.b, shown.c, 0.0, PERIOD_S)


def test_the_position_stage_is_as_stable_as_the_study_says() -> None:
    """Peak sensitivity 2.0, a delay margin of two ticks, and 0.148 mm for a load step of 1 V."""
    loop = design(task(effort=10.0)).loops()["position"]
    plant, controller = systems(loop)
    sensitivity = control.feedback(1.0, -plant * controller)
    angles = np.geomspace(1e-4, np.pi, 20_000) / PERIOD_S
    magnitude, _, _ = control.frequency_response(sensitivity, angles)
    peak = float(np.max(np.squeeze(magnitude)))
    assert peak == pytest.approx(1.0 / loop.modulus_margin, rel=1e-3)
    assert peak < 2.05
    assert loop.delay_margin_s >= 2.0 * PERIOD_S
    disturbed = control.feedback(plant, controller, sign=1)
    _, response = control.step_response(disturbed, np.arange(0, 3.0, PERIOD_S))
    assert float(np.max(response)) == pytest.approx(0.148, abs=0.002)
    assert abs(float(np.squeeze(response)[-1])) < 1e-6  # a load leaves no error


def test_before_a_plant_is_known_the_margins_are_wide() -> None:
    loops = design(task()).loops()
    assert list(loops) == ["speed", "position", "unknown_speed", "unknown_position", "brake"]
    assert loops["unknown_position"].modulus_margin > 0.6
    assert loops["unknown_position"].delay_margin_s > 5.0 * PERIOD_S
    for loop in loops.values():
        assert max(abs(pole) for pole in loop.poles) < 1.0


@settings(max_examples=40, deadline=None)
@given(st.floats(0.05, 4.0), st.floats(5.0, 250.0))
def test_a_move_takes_as_long_as_is_computed(time_s: float, velocity: float) -> None:
    """Within 60 ms, once the plant is known."""
    distance = time_s * velocity
    made = task()
    rig = Rig(made).ticks(30)
    rig.move(200.0, 100.0, 300).move(0.0, 100.0, 300)
    begins = len(rig.positions)
    rig.move(distance, velocity, round(100.0 * distance / velocity) + 100)
    taken = (rig.settled_after(distance, 0.05) - begins) * PERIOD_S
    assert design(made).move_duration_s(distance, velocity, 0.05) == pytest.approx(taken, abs=0.06)


def test_the_change_over_is_where_it_is_said_to_be() -> None:
    """At the velocity limit, in a cruise."""
    made = task()
    rig = Rig(made).ticks(30)
    rig.law.set_target(1000.0, 250.0)
    rig.ticks(600, until=lambda: rig.law.changeovers == 1)
    left = 1000.0 - rig.plant.position
    assert design(made).changeover_time_s * 250.0 == pytest.approx(left, abs=2.0 * 250.0 * PERIOD_S)


def test_it_is_installed_under_its_name() -> None:
    law = LAWS.get("adaptive")
    made = law.design(law.settings(), task())
    assert made == design(task())
    assert set(made.gains()) == {"f1", "f2", "l1", "l2", "l3"}
