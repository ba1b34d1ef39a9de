"""Margins by python-control, and times and ways against the law itself on its model."""

from dataclasses import replace

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.control.laws.adaptive.test_adaptive_law import PERIOD_S, Rig, design, task
from twostage_servo.control.laws.adaptive.design import AdaptiveDesign, design_adaptive
from twostage_servo.control.laws.law import Controller, ControlTask, DesignError, Loop
from twostage_servo.control.laws.registry import LAWS
from twostage_servo.control.observer import NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant


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
    loop_at = np.squeeze((plant * controller)(np.exp(1j * np.geomspace(1e-4, np.pi, 20_000))))
    peak = float(np.max(np.abs(1.0 / (1.0 - loop_at))))  # the controller has the sign of its feedback
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


@pytest.mark.long
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


def refusal(pole: float, period_s: float, noise: float) -> DesignError:
    """Return why there is no design for a pole and a tick, with the variances that an observer has by default."""
    plant, assumed = Plant(180.0, pole), NoiseModel()
    sampled = plant.discretise(period_s)
    kalman = kalman_gain(sampled, assumed)
    made = ControlTask(plant, sampled, period_s, assumed, kalman, 250.0, 2000.0, 24.0, 1000.0, 2.5)
    with pytest.raises(DesignError) as caught:
        design_adaptive(made, noise, learns=True)
    return caught.value


def test_a_fragile_stop_is_refused_with_its_numbers_and_what_to_change() -> None:
    refused = refusal(0.5, 0.1, 0.0)
    assert refused.key == ()
    assert str(refused) == (
        "the brake stage would be fragile: its modulus margin is 0.397, and at least 0.4 is needed, with "
        "axis.plant.pole = 0.5 and service.tick_ms = 100; choose a shorter tick, or other observer variances "
        "(axis.observer)"
    )


def test_the_encoder_is_to_blame_only_where_its_noise_has_chosen_the_poles() -> None:
    """A plant so quick that it settles within a tick."""
    refused = refusal(1000.0, 0.1, 0.0)
    assert refused.key == ()
    assert str(refused).startswith("the speed stage would be fragile: its modulus margin is 0.2")
    assert str(refused).endswith("choose a shorter tick, or correct axis.plant.pole if the plant is slower")
    refused = refusal(1000.0, 0.01, 9.0)
    assert refused.key == ("encoder_noise",)
    assert "; up to 0.0072, if the encoder is that quiet, encoder_noise selects other poles" in str(refused)


def test_an_unstable_stage_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which no plant reaches: the poles are placed."""
    monkeypatch.setattr("twostage_servo.control.laws.adaptive.design.poles_of", lambda *_: [0.5, 1.5j])
    with pytest.raises(DesignError, match=r"the speed stage would be unstable: .* a pole of magnitude 1\.5000, with"):
        design_adaptive(task(), 0.0, learns=True)


@pytest.mark.parametrize("velocity", [20.0, 100.0, 200.0])
def test_the_change_over_is_where_a_known_plant_begins_to_brake(velocity: float) -> None:
    """In whole ticks, so up to one earlier."""
    made = task()
    rig = Rig(made).ticks(30)
    rig.move(200.0, 100.0, 300).move(0.0, 100.0, 300)
    rig.law.set_target(4.0 * velocity, velocity)
    changeovers = rig.law.changeovers
    while rig.law.changeovers == changeovers:
        left = 4.0 * velocity - rig.law.control_estimate.position
        rig.ticks(1)
    tick, found = velocity * PERIOD_S, design(made).changeover_distance(velocity)
    assert found - tick <= left - tick <= found + tick


def test_a_short_move_takes_as_long_as_its_triangle() -> None:
    """1 mm less a window of 0.1 mm, without an acceleration limit: up with 180 times 24, down with 0.66 of that.

    A cap of 30 mm/s is below the top of that, 55.7 mm/s. To this come half a tick for what braking goes in steps, one
    for an average over three (15.84 V, of which three quarters of 10 V are a step), and three for settling.
    """
    rising, braking = 180.0 * 24.0, 0.66 * 180.0 * 24.0
    made = design(task(acceleration=1e9))
    top = (2.0 * 0.9 * rising * braking / (rising + braking)) ** 0.5
    after = (0.5 + 1.0 + 3.0) * PERIOD_S
    assert made.move_duration_s(1.0, 200.0, 0.1) == pytest.approx(top / rising + top / braking + after)
    ramps = 0.5 * 30.0 / rising + 0.5 * 30.0 / braking
    assert made.move_duration_s(1.0, 30.0, 0.1) == pytest.approx(0.9 / 30.0 + ramps + after)
    assert made.move_duration_s(0.05, 30.0, 0.1) == pytest.approx(3.0 * PERIOD_S)


def test_only_the_position_stage_feeds_the_position_back() -> None:
    made = design(task())
    loops, gains = made.loops(), made.gains()
    assert list(loops) == ["speed", "position", "unknown_speed", "unknown_position", "brake"]
    fed_back = {name: -loop.controller.c[0][0] for name, loop in loops.items() if loop.controller is not None}
    assert fed_back["position"] == pytest.approx(gains["f1"])
    assert 0.0 < fed_back["unknown_position"] < gains["f1"]
    assert [fed_back[name] for name in ("speed", "unknown_speed", "brake")] == [0.0, 0.0, 0.0]
    poles = {name: abs(loop.poles[0]) for name, loop in loops.items()}
    assert poles["position"] < poles["unknown_position"] < 1.0


@pytest.mark.parametrize(("known", "step", "noise"), [(0.0, 0.06, 0.0173205), (0.02, 0.06, 0.02), (0.02, 0.0, 0.02)])
def test_an_encoder_is_taken_to_have_the_noise_of_its_step_at_least(known: float, step: float, noise: float) -> None:
    """Of an even distribution: the step over the root of twelve."""
    law = LAWS.get("adaptive")
    made = law.design(law.settings.model_validate({"encoder_noise": known}), replace(task(), encoder_step=step))
    assert isinstance(made, AdaptiveDesign)
    assert made.noise == pytest.approx(noise)
