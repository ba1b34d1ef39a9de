"""The soak's world: its axes are the demo's in other units, and what breaks an invariant is told."""

from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from tests.axis.rig import paper
from tools.soak.axis_soak import AxisSoak
from tools.soak.configurations import (
    GATES,
    KINDS,
    Configuration,
    Kind,
    configuration,
    converted,
    drawn_by,
    quieter,
    variants,
)
from tools.soak.drive_model import DriveModel, EncoderModel
from tools.soak.encoder_watch import ENCODER_FACTORS, certain_speed, travel_bound, undetected_travel
from tools.soak.invariants import BrokenInvariantError, Invariants
from tools.soak.run import EPISODE_TICKS, keep, kept_results, seeds_for, summarise
from tools.soak.service_soak import ServiceSoak
from twostage_servo.app.assembly import design
from twostage_servo.axis.detection import slowest_certain_velocity
from twostage_servo.axis.messages import Command, DriveTraits
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trip_latch import TripLatch
from twostage_servo.axis.trips import TripCode
from twostage_servo.config.loader import load
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper_margins import closed_loop_poles

LINEAR = KINDS[0]


def poles(overrides: list[str], stage: Stage) -> list[complex]:
    made = design(load(None, overrides or ["axis.law.type=paper"]), traits=DriveTraits())
    found = closed_loop_poles(made.plant, paper(made).servo_gains, made.kalman, made.noise, stage)
    return sorted(found, key=lambda pole: (round(pole.real, 6), pole.imag))


def overrides(keys: dict[str, Any]) -> list[str]:
    return [
        'axis.unit="u"',
        "protocol.feedback.position_scale=2.0",
        *(f"{key}={value!r}" for key, value in keys.items()),
    ]


# Units ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stage", list(Stage))
@pytest.mark.parametrize("length", [0.001, 57.3])
def test_the_poles_do_not_depend_on_the_unit_of_position(length: float, stage: Stage) -> None:
    assert poles(overrides(converted(length, 1.0, 0.01)), stage) == pytest.approx(poles([], stage), abs=1e-6)


@pytest.mark.parametrize("stage", [Stage.POSITION, Stage.BRAKE])
def test_the_poles_of_position_stage_and_stop_do_not_depend_on_the_unit_of_time(stage: Stage) -> None:
    assert poles(overrides(converted(27.2, 1.7, 0.017)), stage) == pytest.approx(poles([], stage), abs=1e-6)


def test_the_speed_stage_has_a_second_in_it() -> None:
    other = max(abs(pole) for pole in poles(overrides(converted(27.2, 1.7, 0.017)), Stage.SPEED))
    demo = max(abs(pole) for pole in poles([], Stage.SPEED))
    assert 0.005 < abs(other - demo) < 0.05


@pytest.mark.parametrize(("length", "time"), [(0.001, 1.0), (27.2, 1.7)])
def test_python_control_designs_the_same_poles_in_other_units(length: float, time: float) -> None:
    control = pytest.importorskip("control")

    def designed(keys: dict[str, Any]) -> tuple[Any, Any]:
        config = load(None, overrides(keys) if keys else []).config
        axis, tick_s = config.axis, config.service.tick_ms / 1e3
        gain, pole = axis.plant.gain, axis.plant.pole
        continuous = control.ss([[0.0, 1.0], [0.0, -pole]], [[0.0], [gain]], [[1.0, 0.0]], 0.0)
        sampled = control.sample_system(continuous, tick_s, method="zoh")
        a = np.block([[sampled.A, np.zeros((2, 1))], [-sampled.C, np.eye(1)]])
        b = np.vstack([sampled.B, [[0.0]]])
        ratio, observer = axis.law.paper.performance_index_ratio, axis.observer
        _, _, servo = control.dlqr(a, b, ratio * np.diag([1.0, 0.0, 1.0]), np.eye(1))
        extended = np.block([[sampled.A, sampled.B], [np.zeros((1, 2)), np.eye(1)]])
        process = np.diag([observer.position_variance, observer.velocity_variance, observer.disturbance_variance])
        output = np.array([[1.0, 0.0, 0.0]])
        _, _, filtered = control.dlqe(extended, np.eye(3), output, process, [[observer.measurement_variance]])
        return np.sort_complex(servo), np.sort_complex(filtered)

    for ours, demo in zip(designed(converted(length, time, 0.01 * time)), designed({}), strict=True):
        assert ours == pytest.approx(demo, abs=1e-6)


@pytest.mark.parametrize("tick_ms", [1.0, 5.0, 20.0])
def test_another_tick_keeps_the_loop_about_as_quick(tick_ms: float) -> None:
    other = design(load(None, overrides(converted(1.0, 1.0, tick_ms / 1e3))), traits=DriveTraits())
    demo = design(load(None, ["axis.law.type=paper"]))
    assert other.law.changeover_time_s == pytest.approx(demo.law.changeover_time_s, rel=0.03)
    assert other.law.settling_time_s == pytest.approx(demo.law.settling_time_s, rel=0.03)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_kind_has_the_plant_that_it_was_made_for(kind: Kind) -> None:
    plant = {
        "linear": (180.0, 14.0),
        "metres": (0.18, 14.0),
        "rotary": (900.0, 6.0),
        "slow": (0.5, 0.5),
        "quick": (5e3, 60.0),
    }
    keys = converted(kind.length, kind.time, kind.ticks_ms[0] / 1e3)
    assert (keys["axis.plant.gain"], keys["axis.plant.pole"]) == pytest.approx(plant[kind.name])


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_check_accepts_each_kind_on_each_tick(kind: Kind) -> None:
    for one, tick_ms, gate, same_loop in variants():
        if one is kind and gate in {GATES[0], GATES[-1]}:
            quiet = quieter(kind, tick_ms, gate, same_loop=same_loop)
            configuration(kind, tick_ms, gate, *quiet, same_loop=same_loop).check()


@pytest.mark.long
def test_an_episode_draws_among_all_kinds_and_gates() -> None:
    names = [drawn_by(seed)[0].name for seed in range(200)]
    assert all(any(name.startswith(kind.name) for name in names) for kind in KINDS)
    assert all(any(f"gate {gate:g} " in name for name in names) for gate in GATES)
    assert drawn_by(7)[0] == drawn_by(7)[0]


# What is modelled -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", ENCODER_FACTORS.values())
def test_an_encoder_counts_by_its_factor_from_where_it_fails_and_rightly_again_when_mended(factor: float) -> None:
    encoder = EncoderModel(0.001, 0.0, Random(1))  # noqa: S311 - a test, no secret
    assert encoder.count(10.0) == pytest.approx(10.0)
    encoder.fail(factor, 10.0)
    assert encoder.count(10.0) == pytest.approx(10.0)
    assert encoder.count(14.0) == pytest.approx(10.0 + 4.0 * factor)
    encoder.mend(14.0, absolute=False)
    assert encoder.count(15.0) == pytest.approx(11.0 + 4.0 * factor)
    encoder.mend(15.0, absolute=True)
    assert encoder.count(16.0) == pytest.approx(16.0)


def drive(seed: int = 1) -> DriveModel:
    return DriveModel(design(load(None)), 0.001, 0.0, None, Random(seed))  # noqa: S311 - a test, no secret


def test_what_a_mended_encoder_counts_is_reported_next() -> None:
    mended = drive()
    mended.encoder.fail(0.0, 0.0)
    mended.place(5.0)
    mended.mend_encoder(absolute=True)
    report = mended.feedback(1)
    assert report is not None
    assert report.position == pytest.approx(5.0)


def test_a_drive_that_is_stuck_keeps_its_effort_when_it_is_told_to_disable() -> None:
    stuck = drive()
    stuck.obey(Command(2.0, enable=True), 1)
    stuck.stuck_until = 5
    for tick in range(2, 5):
        stuck.obey(Command(0.0, enable=False), tick)
        assert (stuck.enabled, stuck.effort) == (True, 2.0)
    stuck.obey(Command(0.0, enable=False), 5)
    assert (stuck.enabled, stuck.effort) == (False, 0.0)


def test_a_drive_that_creeps_says_that_it_is_disabled() -> None:
    creeping = drive()
    creeping.creeping, creeping.creeping_until = 3.0, 100
    for tick in range(1, 100):
        creeping.obey(Command(0.0, enable=False), tick)
    feedback = creeping.feedback(100)
    assert feedback is not None
    assert feedback.enabled is False
    assert abs(creeping.position) > 10.0


# What is told ---------------------------------------------------------------------------------------------------------


def linear(gate: float = GATES[0]) -> Configuration:
    return configuration(LINEAR, 10.0, gate)


def soak_of(made: Configuration, monkeypatch: pytest.MonkeyPatch, without: frozenset[str] = frozenset()) -> AxisSoak:
    monkeypatch.setattr("tools.soak.axis_soak.drawn_by", lambda seed: (made, Random(seed)))  # noqa: S311 - a test
    soak = AxisSoak(1, without)
    soak.operator.act = lambda: None  # type: ignore[method-assign]
    return soak


def test_the_bound_of_a_travel_follows_from_the_limits() -> None:
    soak = design(linear().load())
    limits = soak.settings.limits
    coasting = 100.0 / (14.0 * 0.7)
    assert undetected_travel(soak) == limits.position_overrun
    expected = limits.position_overrun + 100.0 * 0.04 + coasting + soak.settings.window.position
    assert travel_bound(soak, 100.0, -1.0) == pytest.approx(expected)
    assert travel_bound(soak, 100.0, 0.5) == pytest.approx(travel_bound(soak, 200.0, -1.0))


def ticks(soak: AxisSoak, count: int) -> None:
    for _ in range(count):
        soak._one_tick(0)


def armed(soak: AxisSoak) -> AxisSoak:
    ticks(soak, 10)
    if not soak.axis.referenced:
        soak.axis.set_position(0.0)
    soak.axis.arm()
    ticks(soak, 20)
    assert soak.axis.state is State.HOLDING
    return soak


def test_an_axis_that_goes_on_with_a_wrong_encoder_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.axis.move_to(400.0, 100.0)
    ticks(soak, 100)
    monkeypatch.setattr(TripLatch, "raise_trip", lambda *_, **__: None)  # an axis that notices nothing
    soak.drive.encoder.fail(0.0, soak.drive.position)
    soak.watch.begin(0.0, soak.drive.position, soak.drive.velocity)
    with pytest.raises(BrokenInvariantError, match=r"encoder frozen since it was moving_speed_stage at 99"):
        ticks(soak, 500)


def test_an_axis_that_is_armed_with_a_wrong_place_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.axis.disarm()
    soak._one_tick(0)
    soak.watch.begin(-1.0, 0.0, 0.0)
    soak.watch.mended()
    allowed = 2.0 * travel_bound(soak.axis.design, 0.0, -1.0)
    for place, told in ((0.9 * allowed, False), (1.1 * allowed, True)):
        soak.axis.machine.state = State.DISARMED
        assert soak.watch.check(place, 0.0, 0.0) is None
        soak.axis.machine.state = State.HOLDING
        wrong = soak.watch.check(place, 0.0, 0.0)
        assert ("counts as referenced" in (wrong or "")) is told
    soak.watch.placed(0.0)
    soak.axis.machine.state = State.DISARMED
    soak.watch.check(0.0, 0.0, 0.0)
    soak.axis.machine.state = State.HOLDING
    assert soak.watch.check(0.1 * allowed, 0.0, 0.0) is not None


def test_a_place_told_of_an_axis_that_has_just_set_out_may_be_off_by_what_its_samples_do_not_show_yet() -> None:
    soak = AxisSoak(1)
    design = soak.axis.design
    for speed, off_by in ((0.0, 0.0), (design.rest_velocity, 0.0), (20.0 * design.rest_velocity, 1.0)):
        soak.watch.placed(speed)
        assert soak.watch.in_doubt is (off_by > 0.0)


def test_an_effort_beyond_its_limit_its_rate_or_its_state_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    axis = soak_of(linear(), monkeypatch).axis
    for command, what in (
        (Command(25.0, enable=True), "beyond 24"),
        (Command(float("nan"), enable=True), "beyond 24"),
        (Command(1.0, enable=True), "while the axis is disarmed"),
    ):
        with pytest.raises(BrokenInvariantError, match=what):
            Invariants(axis).check(command, 0.0)
    with pytest.raises(BrokenInvariantError, match="beyond its limits"):
        Invariants(axis).check(Command(0.0, enable=False), 1e6)
    Invariants(axis).check(Command(0.0, enable=False), 1e6, place_known=False)


def test_an_axis_that_takes_itself_to_be_elsewhere_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.invariants.check(Command(soak.axis.effort, enable=True), soak.drive.position + 0.9)
    with pytest.raises(BrokenInvariantError, match="takes itself to be at"):
        Invariants(soak.axis).check(Command(0.0, enable=True), soak.drive.position + 1.2)


def test_a_drive_that_stays_enabled_untold_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.drive.stuck_until = 10_000
    soak.axis.disarm()
    ticks(soak, 100)  # which the product tells, and the soak is silent
    assert TripCode.DRIVE_NOT_DISABLED in soak.axis.trips
    with pytest.raises(Refused, match="that it is enabled"):
        soak.axis.reset()
    monkeypatch.setattr(soak.axis, "check_reset", lambda: None)
    with pytest.raises(BrokenInvariantError, match="a reset would be carried out"):
        ticks(soak, 1)
    monkeypatch.setattr(TripLatch, "raise_trip", lambda *_, **__: None)
    soak.axis.trips.clear()
    with pytest.raises(BrokenInvariantError, match="its trips are none"):
        ticks(soak, 1)


def test_a_motion_while_disabled_that_is_told_to_nobody_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.axis.disarm()
    ticks(soak, 100)
    soak.drive.creeping, soak.drive.creeping_until = 3.0, 10_000
    ticks(soak, 200)
    assert soak.axis.disabled.moved is not None
    monkeypatch.setattr(type(soak.axis.disabled), "moved", None)
    with pytest.raises(BrokenInvariantError, match="and nobody is told"):
        ticks(soak, 1)


def test_a_hand_that_moves_an_axis_whose_drive_creeps_has_not_moved_it_by_that_drive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.axis.disarm()
    ticks(soak, 100)
    soak.drive.creeping, soak.drive.creeping_until = 3.0, 10_000
    monkeypatch.setattr(type(soak.axis.disabled), "moved", None)
    ticks(soak, 1)
    soak.drive.place(soak.drive.position + 500.0)
    soak.drive_watch.moved_by_hand(soak.drive.position - 500.0, soak.drive.position)
    ticks(soak, 1)


def way_told(soak: AxisSoak) -> float:
    return abs(soak.axis.disabled.moved or 0.0)


def test_a_drive_that_has_rebooted_counts_its_way_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.axis.disarm()
    ticks(soak, 100)
    soak.drive.creeping, soak.drive.creeping_until = 3.0, 10_000
    ticks(soak, 200)
    before = way_told(soak)
    soak.drive.boots += 1
    ticks(soak, 10)  # in which there is one heartbeat
    assert way_told(soak) < 0.2 * before
    ticks(soak, 200)  # and is told once more, from there on
    assert way_told(soak) > 0.5 * before


@pytest.mark.parametrize(
    ("gain", "pole", "before", "then", "told"),
    [
        (1.2, 1.0, 100.0, 100.0, True),  # in a cruise it shows, whatever the plant
        (1.2, 1.0, 80.0, 100.0, False),  # speeding up it does not, and what it looks like is accepted
        (0.8, 1.0, 80.0, 100.0, False),  # nor a plant of 0.4 times the gain, in the midst of a motion
        (1.2, 1.0, 0.0, 100.0, False),
        (0.8, 1.0, 0.0, 100.0, True),
        (0.8, 0.7, 0.0, 100.0, False),  # one that has 0.57 times the speed in a cruise may be
        (0.8, 1.0, 0.0, 1.0, False),  # as slow as that it may creep
    ],
)
def test_another_scale_is_held_to_a_bound_where_it_shows(
    gain: float, pole: float, before: float, then: float, *, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    far = 10.0 * travel_bound(soak.axis.design, 100.0, 0.5)
    for _ in range(30):
        soak.watch.check(0.0, before, 0.0)
    soak.watch.begin(0.5, 0.0, then if before else 0.0, gain, pole)
    soak.watch.check(0.0, then, 0.0)
    assert (soak.watch.check(far, then, 0.0) is not None) is told


def frozen_at_rest(monkeypatch: pytest.MonkeyPatch) -> tuple[AxisSoak, float, float, float]:
    """Return an axis whose encoder stands still, its stall effort, its effort, and a travel beyond any bound."""
    soak = armed(soak_of(linear(), monkeypatch))
    soak.watch.begin(0.0, 0.0, 0.0)
    return (
        soak,
        soak.axis.settings.limits.stall_effort,
        soak.axis.effort,
        10.0 * travel_bound(soak.axis.design, 100.0, 0.0),
    )


def test_an_encoder_that_stood_still_before_a_move_is_held_to_a_bound_from_the_stall_effort_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    soak, stall, effort, far = frozen_at_rest(monkeypatch)
    soak.watch.check(0.0, 0.0, effort + 1.1 * stall)
    soak.watch.move_asked(0.0, 100.0, 0.0, at_rest=True)
    assert soak.watch.check(far, 1.0, effort + 0.9 * stall) is None
    assert soak.watch.check(2.0 * far, 1.0, effort + 1.1 * stall) is not None


def test_an_encoder_that_stood_still_is_compared_with_the_effort_at_which_it_did(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Other moves may begin meanwhile, at another effort, until the axis is armed anew."""
    soak, stall, effort, far = frozen_at_rest(monkeypatch)
    monkeypatch.setattr(type(soak.axis), "effort", effort - 0.5 * stall)
    soak.watch.move_asked(0.0, 100.0, 0.0, at_rest=True)
    for _ in range(8):
        assert soak.watch.check(0.0, 1.0, effort + 0.9 * stall) is None
    assert soak.watch.check(far, 1.0, effort + 0.9 * stall) is None
    for _ in range(8):
        assert soak.watch.check(far, 1.0, effort + 1.1 * stall) is None
    assert soak.watch.check(0.0, 1.0, effort) is not None


def test_an_effort_that_was_large_for_less_than_the_stall_time_leaves_an_encoder_untold(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """50 ms are five ticks, and a sample is two older."""
    soak, stall, effort, far = frozen_at_rest(monkeypatch)
    for _ in range(2):
        for _ in range(7):
            assert soak.watch.check(0.0, 1.0, effort + 1.1 * stall) is None
        assert soak.watch.check(far, 1.0, effort + 0.9 * stall) is None
        assert soak.watch.check(0.0, 1.0, effort + 0.9 * stall) is None
    for _ in range(8):
        assert soak.watch.check(0.0, 1.0, effort + 1.1 * stall) is None
    assert soak.watch.check(far, 1.0, effort + 0.9 * stall) is not None


@pytest.mark.parametrize(
    ("tick_ms", "share", "told"),
    [(10.0, 3.45, False), (10.0, 3.55, True), (20.0, 6.9, False), (20.0, 7.1, True), (5.0, 3.55, True)],
)
def test_from_rest_another_scale_shows_at_several_times_the_speed_at_which_it_does_in_a_cruise(
    tick_ms: float, share: float, *, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    soak = soak_of(configuration(LINEAR, tick_ms, GATES[0]), monkeypatch)
    slowest = slowest_certain_velocity(soak.axis.design)
    speed = share * certain_speed(soak.axis.design, slowest, 1000.0)
    soak.watch.check(0.0, 1000.0, 0.0)
    far = 10.0 * travel_bound(soak.axis.design, 100.0, 0.5)
    soak.watch.begin(0.5, 0.0, 0.0, 0.8)
    soak.watch.check(0.0, speed, 0.0)
    assert (soak.watch.check(far, speed, 0.0) is not None) is told


@pytest.mark.parametrize(("share", "told"), [(0.99, True), (1.01, False)])
def test_a_move_of_an_axis_that_creeps_on_from_a_stop_does_not_show_another_scale_from_rest_on(
    share: float, *, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It holds by its encoder, which counts half, and truly goes three times its velocity at rest: seed 1119."""
    soak = soak_of(linear(), monkeypatch)
    design = soak.axis.design
    soak.watch.begin(0.5, 0.0, 0.0, 0.74)  # an answer to the effort that no accepted plant has
    soak.watch.move_asked(0.0, 100.0, share * design.rest_velocity, at_rest=True)
    soak.watch.check(0.0, 200.0, 0.0)
    assert (soak.watch.check(10.0 * travel_bound(design, 100.0, 0.5), 200.0, 0.0) is not None) is told


@pytest.mark.parametrize(("gain", "pole", "share"), [(1.0, 1.0, 1.0), (1.18, 1.0, 1.25), (1.0, 0.9, 1.25)])
def test_an_axis_whose_plant_is_off_its_model_may_go_a_quarter_farther(
    gain: float, pole: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    bound = share * travel_bound(soak.axis.design, 100.0, -1.0)
    soak.watch.begin(-1.0, 0.0, 100.0, gain, pole)
    assert soak.watch.check(0.99 * bound, 100.0, 0.0) is None
    assert soak.watch.check(1.01 * bound, 100.0, 0.0) is not None


@pytest.mark.parametrize(
    ("gain", "at", "state", "share"),
    [
        (0.85, 0.99, State.QUICK_STOPPING, 2.0),
        (0.85, 1.01, State.QUICK_STOPPING, 1.25),  # certain
        (0.85, 0.99, State.HOLDING, 1.25),  # not in a stop
        (0.85, 0.99, State.SPEED_STAGE, 1.25),  # nor in a cruise
        (1.0, 0.99, State.QUICK_STOPPING, 1.0),
    ],
)
def test_an_encoder_that_turns_round_unseen_in_a_stop_may_cost_twice_the_way(
    gain: float, at: float, state: State, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    monkeypatch.setattr(type(soak.axis), "state", state)
    speed = at * certain_speed(soak.axis.design, slowest_certain_velocity(soak.axis.design), 0.0)
    bound = share * travel_bound(soak.axis.design, speed, -1.0)
    for _ in range(40):
        soak.watch.check(0.0, speed, 0.0)
    soak.watch.begin(-1.0, 0.0, speed, gain)
    assert soak.watch.check(0.99 * bound, speed, 0.0) is None
    assert soak.watch.check(1.01 * bound, speed, 0.0) is not None


@pytest.mark.parametrize(("ticks_before", "told"), [(299, False), (300, True)])
def test_what_a_cruise_is_has_a_unit_of_time(ticks_before: int, *, told: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """It lasts 300 ms. Of a tick of 1 ms, 30 had been enough, in which the speed of any axis hardly changes."""
    soak = soak_of(configuration(LINEAR, 1.0, GATES[0]), monkeypatch)
    far = 10.0 * travel_bound(soak.axis.design, 200.0, 2.0)
    for _ in range(ticks_before):
        soak.watch.check(0.0, 200.0, 0.0)
    soak.watch.begin(2.0, 0.0, 200.0, 1.2)
    soak.watch.check(0.0, 200.0, 0.0)
    assert (soak.watch.check(far, 200.0, 0.0) is not None) is told


@pytest.mark.parametrize(("asked", "told"), [(100.0, True), (92.0, True), (70.0, False), (130.0, False)])
def test_an_axis_that_is_about_to_change_its_speed_does_not_cruise(
    asked: float, *, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another velocity had just been asked for, and another scale looked like an accepted plant as it slowed down."""
    soak = armed(soak_of(linear(), monkeypatch))
    soak.axis.move_to(2000.0, asked)
    for _ in range(30):
        soak.watch.check(0.0, 100.0, 0.0)
    soak.watch.begin(2.0, 0.0, 100.0, 1.2)
    soak.watch.check(0.0, 100.0, 0.0)
    assert (soak.watch.check(10.0 * travel_bound(soak.axis.design, 130.0, 2.0), 100.0, 0.0) is not None) is told


def test_a_late_sample_of_a_fast_axis_hides_another_scale() -> None:
    made = design(linear().load())
    slowest = slowest_certain_velocity(made)
    hidden = certain_speed(made, slowest, 250.0) / slowest
    assert certain_speed(made, slowest, 0.0) == pytest.approx(slowest)
    noise, late = 1.25 * made.noise.measurement_variance**0.5, 0.25e-3 * made.settings.limits.innovation_time_ms
    assert hidden == pytest.approx((noise + 250.0 * late) / (noise + slowest * late))
    assert hidden > 1.1


def test_an_axis_that_speeds_up_is_held_to_the_bound_of_the_speed_that_was_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.axis.move_to(400.0, 200.0)
    ticks(soak, 5)
    assert abs(soak.drive.velocity) < 100.0
    soak.watch.begin(-1.0, 0.0, soak.drive.velocity)
    bound = travel_bound(soak.axis.design, 200.0, -1.0)
    assert soak.watch.check(0.99 * bound, 0.0, 0.0) is None
    assert soak.watch.check(1.01 * bound, 0.0, 0.0) is not None


def test_what_a_hand_moves_is_no_travel(monkeypatch: pytest.MonkeyPatch) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.watch.begin(-1.0, 0.0, 0.0)
    bound = travel_bound(soak.axis.design, 0.0, -1.0)
    soak.watch.moved_by_hand(0.0, 500.0)
    assert soak.watch.check(500.0 + 0.99 * bound, 0.0, 0.0) is None
    assert soak.watch.check(500.0 + 1.01 * bound, 0.0, 0.0) is not None


def test_an_encoder_fails_on_a_drive_that_obeys(monkeypatch: pytest.MonkeyPatch) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.drive.creeping_until = soak._tick + 10
    soak._encoder_fails()
    assert not soak.watch.active


def test_a_load_is_gone_for_half_a_second_before_an_encoder_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    soak = armed(soak_of(linear(), monkeypatch))
    soak.drive.load = 3.0
    soak._encoder_fails()
    assert soak.drive.load == 0.0
    assert not soak.watch.active
    soak._tick += 49
    soak._encoder_fails()
    assert not soak.watch.active
    soak._tick += 1  # the estimate has had 500 ms for it
    soak._encoder_fails()
    assert soak.watch.active


# Running it -----------------------------------------------------------------------------------------------------------


def test_the_seeds_of_a_run_come_to_its_hours() -> None:
    seeds = seeds_for("axis", 5.0 * 3600.0, 3)
    hours = [EPISODE_TICKS["axis"] * drawn_by(seed)[0].tick_s / 3600.0 for seed in seeds]
    assert seeds.start == 3
    assert sum(hours) >= 5.0
    assert sum(hours[:-1]) < 5.0


def test_a_run_goes_on_from_what_was_kept(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    assert kept_results(path) == []
    for seed in (1, 2):
        keep(path, {"seed": seed, "broken": None})
    assert [result["seed"] for result in kept_results(path)] == [1, 2]


def test_an_episode_follows_from_its_seed() -> None:
    without = frozenset({"encoder", "drive"})
    soaks = [AxisSoak(seed, without) for seed in (4, 4, 5)]
    for soak in soaks:
        soak.run(3000)
    assert soaks[0].drive.position == soaks[1].drive.position != soaks[2].drive.position


def test_a_summary_names_what_broke_by_its_seed() -> None:
    result = {
        "seed": 3, "broken": "it broke", "configuration": "c", "process": 1, "simulated_s": 3600.0, "seconds": 1.0,
        "requests": 1, "refusals": 0, "trips": 0, "moves_reached": 0, "encoder_faults": 2, "travel_over_bound": 0.5,
        "overrun_over_bound": 0.1, "resident_mb": 100.0,
    }  # fmt: skip
    summary = summarise([result, result | {"seed": 4, "broken": None, "resident_mb": 101.0}], 10.0, "axis")
    assert summary["broken"] == [{"seed": 3, "configuration": "c", "what": "it broke"}]
    assert (summary["simulated_hours"], summary["encoder_faults"], summary["memory_growth_mb"]) == (2.0, 4, 1.0)


def test_a_service_lives_through_a_share_of_its_soak() -> None:
    soak = ServiceSoak(6, frozenset({"encoder", "drive", "backlog", "clients", "descriptors", "socket"}))
    soak.run(2000)
    assert soak.ticks >= 2000
    assert soak.requests > 0
