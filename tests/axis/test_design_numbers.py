"""The numbers of a design, each by hand from the settings that it follows from."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.axis.rig import DEMO, PERIOD_S, axis_settings, paper
from twostage_servo.axis.design import AxisDesign, DesignError, _place, design_axis
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.margins import Margins
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.laws.paper_margins import loop_margins
from twostage_servo.control.laws.stop_design import StopDesign, smoothing_time_s
from twostage_servo.control.model_monitor.hypotheses import OTHER_GAINS
from twostage_servo.control.observer import NO_CORRECTION
from twostage_servo.control.plant import Plant

GAIN, POLE = 180.0, 14.0


def demo() -> AxisDesign:
    """Design the axis of the demo anew, so that each test sees the code as it is."""
    return design_axis(axis_settings(), PERIOD_S)


def designed(tables: dict[str, Any] | None = None, **limits: float) -> AxisDesign:
    tables = {"limits": DEMO["limits"] | limits} | (tables or {})
    return design_axis(AxisSettings.model_validate(DEMO | tables), PERIOD_S)


def test_rest_is_a_hundredth_of_the_velocity_limit() -> None:
    assert demo().rest_velocity == pytest.approx(2.5)


def test_the_law_is_built_with_the_limits_of_the_axis() -> None:
    for law in (demo().build_law(), demo().build_nominal_law()):
        assert isinstance(law, TwoStageLaw)
        assert law.effort_limit == 24.0
        assert law.period_s == PERIOD_S
        assert law.observer.plant == demo().plant
        assert law._ramp_limit == pytest.approx(20.0)  # 2000 mm/s² in 10 ms
        assert law._largest_step == pytest.approx(10.0)  # 1000 V/s in 10 ms
        assert law.stop_stage._rest_velocity == pytest.approx(2.5)


def test_the_law_corrects_its_estimate_by_the_samples_and_the_nominal_one_does_not() -> None:
    for law, gain in ((demo().build_law(), demo().kalman.predictor), (demo().build_nominal_law(), NO_CORRECTION)):
        law.observer.update(1.0, 0.0)
        assert (law.observer.position, law.observer.velocity, law.observer.disturbance) == pytest.approx(gain)


def test_the_observer_forgets_a_disturbance_as_the_settings_say() -> None:
    design = designed({"observer": {"disturbance_memory": 0.5}})
    law = design.build_nominal_law()
    law.observer.disturbance = 1.0
    law.observer.predict(0.0)
    assert law.observer.disturbance == 0.5


def test_the_variances_reach_the_noise_model_in_their_order() -> None:
    variances = {"position_variance": 0.2, "velocity_variance": 0.3, "disturbance_variance": 0.4}
    noise = designed({"observer": variances | {"measurement_variance": 0.05, "disturbance_memory": 0.9}}).noise
    assert noise.process_variance == (0.2, 0.3, 0.4)
    assert (noise.measurement_variance, noise.disturbance_memory) == (0.05, 0.9)


def test_the_model_monitor_is_of_the_same_plant() -> None:
    """What its hypotheses predict for an effort of 1 after a period is b1 of their plants."""
    test = demo().build_model_monitor()
    test.predict(1.0)
    model = demo().settings.plant
    expected = [
        Plant(factor * plant.gain * model.gain, plant.pole * model.pole).discretise(PERIOD_S).b1
        for factor, plant, _ in OTHER_GAINS
    ]
    assert [observer.position for observer in test._gains] == pytest.approx(expected)


def test_the_model_monitor_takes_noise_and_dates_from_the_settings() -> None:
    """A standard deviation of 0.1 mm and 3 ms, 0.8 mm at 100 mm/s in all; 1.25 of the one, a quarter of the other."""
    test = demo().build_model_monitor()
    test.update(0.0, 0.0, demo().build_law().observer, 100.0)
    assert test._least == pytest.approx(1.25 * 0.1 + 0.25 * 0.003 * 100.0)


@pytest.mark.parametrize("velocity", [100.0, -100.0])
def test_the_changeover_distance_has_no_sign(velocity: float) -> None:
    expected = 100.0 * paper(demo()).servo_gains.f11 * PERIOD_S / paper(demo()).servo_gains.f22
    assert demo().changeover_distance(velocity) == pytest.approx(expected)
    assert expected == pytest.approx(54.5, abs=0.05)


@pytest.mark.parametrize(
    ("duration_ms", "ticks"), [(0.0, 0), (10.0, 1), (10.1, 2), (29.9, 3), (30.0, 3), (30.0000001, 4), (100.0, 10)]
)
def test_ticks_are_rounded_up_but_not_for_an_error_of_rounding(duration_ms: float, ticks: int) -> None:
    assert demo().ticks(duration_ms) == ticks
    # 0.07 / 0.01 is 7.000000000000001 in floating point.
    assert demo().ticks(70.0) == 7


def test_the_effort_swings_from_that_of_the_cruise_to_that_of_braking() -> None:
    """Braking by 360 mm/s² takes 2 V less, at 1000 V/s; more than cruise and limit together it can't be."""
    assert StopDesign(paper(demo()).task).effort_time_s(100.0, 360.0) == pytest.approx(2.0 / 1000.0)
    assert StopDesign(paper(demo()).task).effort_time_s(100.0, -360.0) == pytest.approx(2.0 / 1000.0)
    most = 90.0 * POLE / GAIN + 24.0
    assert StopDesign(paper(demo()).task).effort_time_s(90.0, 1e9) == pytest.approx(most / 1000.0)
    assert StopDesign(paper(demo()).task).effort_time_s(-90.0, 1e9) == pytest.approx(most / 1000.0)


def test_a_deceleration_is_attainable_as_far_as_limit_and_rate_of_the_effort_go() -> None:
    assert StopDesign(paper(demo()).task).attainable(100.0) == 100.0
    assert StopDesign(paper(demo()).task).attainable(1e9) == pytest.approx(GAIN * 24.0)
    assert StopDesign(paper(designed(effort_rate=200.0)).task).attainable(1e9) == pytest.approx(GAIN * 200.0 / POLE)
    reversed_drive = designed({"plant": {"gain": -180.0, "pole": 14.0}}, effort_rate=200.0)
    assert StopDesign(paper(reversed_drive).task).attainable(1e9) == pytest.approx(GAIN * 200.0 / POLE)
    assert StopDesign(paper(designed({"plant": {"gain": -180.0, "pole": 14.0}})).task).attainable(1e9) == pytest.approx(
        GAIN * 24.0
    )


@pytest.mark.parametrize("velocity", [100.0, -100.0])
def test_a_stop_of_a_plant_off_its_model_coasts_by_three_tenths_of_its_free_run(velocity: float) -> None:
    """100 mm/s at 2000 mm/s²: the ramp's 2.5 mm, a tick, the swing of 11.1 V; free, the plant would run 100 / 14 mm."""
    distance = 2.5 + 100.0 * (PERIOD_S + 2000.0 / GAIN / 1000.0)
    assert demo().certain_stopping_distance(velocity, 2000.0) == pytest.approx(distance + 0.3 * 100.0 / POLE)


@pytest.mark.parametrize("velocity", [100.0, -100.0])
def test_the_time_of_a_stop_is_ramp_swing_and_settling(velocity: float) -> None:
    expected = 100.0 / 2000.0 + 2000.0 / GAIN / 1000.0 + demo().law.settling_time_s
    assert demo().stopping_time_s(velocity, 2000.0) == pytest.approx(expected)


def test_settling_is_when_the_slowest_pole_of_a_stop_has_died_down_to_a_hundredth() -> None:
    radius = loop_margins(
        demo().plant, paper(demo()).servo_gains, demo().kalman, demo().noise, Stage.BRAKE, frequencies=10
    ).spectral_radius
    assert radius ** (demo().law.settling_time_s / PERIOD_S) == pytest.approx(0.01)


def test_an_effort_limit_that_is_just_what_the_cruise_takes_is_too_low() -> None:
    """250 mm/s take 250 * 14 / 180 = 19.44 V."""
    cruise = 250.0 * POLE / GAIN
    assert designed(effort=cruise * 1.001).settings.limits.effort > cruise
    with pytest.raises(DesignError) as caught:
        designed(effort=cruise)
    assert caught.value.key == ("axis", "limits", "effort")
    reversed_drive = {"plant": {"gain": -180.0, "pole": 14.0}}
    with pytest.raises(DesignError) as caught:
        designed(reversed_drive, effort=cruise * 0.999)
    assert caught.value.key == ("axis", "limits", "effort")


def test_a_drive_mounted_the_other_way_round_is_designed_with_its_gains_turned_round() -> None:
    turned = designed({"plant": {"gain": -180.0, "pole": 14.0}})
    ours, theirs = demo().law.gains(), turned.law.gains()
    assert list(ours) == list(theirs) == ["f11", "f12", "f22"]
    assert list(theirs.values()) == pytest.approx([-gain for gain in ours.values()])


def modulus(ratio: float) -> float:
    design = designed({"law": {"performance_index_ratio": ratio}})
    return min(
        loop_margins(design.plant, paper(design).servo_gains, design.kalman, design.noise, stage).modulus_margin
        for stage in Stage
    )


def test_a_loop_is_taken_down_to_a_modulus_margin_of_four_tenths() -> None:
    """The quickest gains that are taken leave no more than that, and no less."""
    low, high = 5e-5, 10.0
    with pytest.raises(DesignError) as caught:
        designed({"law": {"performance_index_ratio": high}})
    assert caught.value.key == ("axis", "law", "performance_index_ratio")
    for _ in range(30):
        middle = math.sqrt(low * high)
        try:
            designed({"law": {"performance_index_ratio": middle}})
            low = middle
        except DesignError:
            high = middle
    assert modulus(low) == pytest.approx(0.4, abs=0.005)


def test_the_gains_are_for_the_ratio_of_the_settings() -> None:
    """The paper's second example: (36) prints 1.43, 6.89e-2 and 6.63e-2 for Q/R = 5e-3."""
    gains = paper(designed({"law": {"performance_index_ratio": 5e-3}})).servo_gains
    assert np.allclose([gains.f11, gains.f12, gains.f22], [1.43, 6.89e-2, 6.63e-2], rtol=4e-3)


@pytest.mark.parametrize("place", ["f11", "f22"])
@pytest.mark.parametrize("gain", [0.0, -0.1, math.nan, math.inf, -math.inf])
def test_gains_that_would_not_drive_the_plant_are_refused(
    monkeypatch: pytest.MonkeyPatch, place: str, gain: float
) -> None:
    """Near the end of double precision the solution of the Riccati equation may be anything."""
    gains = replace(paper(demo()).servo_gains, **{place: gain})
    monkeypatch.setattr("twostage_servo.control.laws.paper_design.servo_gains", lambda *_: gains)
    with pytest.raises(DesignError, match="cannot drive this plant") as caught:
        designed()
    assert caught.value.key == ("axis", "law", "paper", "performance_index_ratio")


def test_small_gains_are_gains() -> None:
    gains = paper(designed({"law": {"performance_index_ratio": 1e-5}})).servo_gains
    assert 0.0 < gains.f22 * GAIN < 1.0


@pytest.mark.parametrize("worst", list(Stage))
def test_each_stage_is_judged_by_its_own_loop(monkeypatch: pytest.MonkeyPatch, worst: Stage) -> None:
    """Poles of 1.5, or a modulus margin of 0.39, in one of the three: that one is named."""
    true_margins = loop_margins
    with monkeypatch.context() as patched:
        patched.setattr(
            "twostage_servo.control.laws.paper_design.closed_loop_poles",
            lambda *loop: [0.5, 1.5j if loop[4] is worst else 0.6],
        )
        with pytest.raises(DesignError, match=f"the {worst.name.lower()} stage would be unstable"):
            designed()

    def fragile(model: Any, gains: Any, kalman: Any, noise: Any, stage: Stage, frequencies: int) -> Margins:
        margins = true_margins(model, gains, kalman, noise, stage, frequencies=frequencies)
        return replace(margins, modulus_margin=0.39 if stage is worst else 0.41)

    monkeypatch.setattr("twostage_servo.control.laws.paper_design.loop_margins", fragile)
    with pytest.raises(DesignError, match=f"the {worst.name.lower()} stage would be fragile"):
        designed()


@pytest.mark.parametrize(
    ("law", "key", "place"),
    [
        ({"type": "paper"}, "performance_index_ratio", ("paper", "performance_index_ratio")),
        ({"type": "paper", "performance_index_ratio": 2.0}, "performance_index_ratio", ("performance_index_ratio",)),
        ({"type": "paper"}, "other", ("paper", "other")),
        ({"type": "adaptive"}, "performance_index_ratio", ("adaptive", "performance_index_ratio")),
    ],
)
def test_a_key_of_a_law_is_told_where_it_stands(law: dict[str, Any], key: str, place: tuple[str, ...]) -> None:
    assert _place(AxisSettings.model_validate(DEMO | {"law": law}), (key,)) == place


@pytest.mark.parametrize("smooth", [False, True])
def test_a_stop_takes_longer_where_it_is_smoothed(smooth: bool) -> None:
    """By hand, from 100 mm/s at 2000 mm/s² with 40,000 mm/s³: 50 ms rising, to 150 mm/s, and smoothed at its end."""
    tables = {"law": {"type": "adaptive", "jerk": 40_000.0}}
    design = design_axis(AxisSettings.model_validate(DEMO | tables), PERIOD_S)
    plain = design.law.stopping_time_s(100.0, 2000.0)
    if smooth:
        fastest = 100.0 + 0.5 * 2000.0 * 0.05
        smoothed = 0.05 + design.law.stopping_time_s(fastest, 2000.0) + smoothing_time_s(fastest, 2000.0, 40_000.0)
        assert design.stopping_time_s(100.0, 2000.0, smooth=True) == pytest.approx(smoothed)
        assert smoothed > plain + 0.05
    else:
        assert design.stopping_time_s(100.0, 2000.0) == plain
        without = design_axis(AxisSettings.model_validate(DEMO | {"law": {"type": "adaptive"}}), PERIOD_S)
        assert without.stopping_time_s(100.0, 2000.0, smooth=True) == pytest.approx(plain)
