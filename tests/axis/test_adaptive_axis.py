"""An axis that the adaptive law drives: healthy ones never trip, and faults are told although the law adapts."""

import contextlib
import random
from typing import Any

import pytest

from tests.axis.rig import DEMO, PERIOD_S, TRAITS, AxisRig
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.loader import load
from twostage_servo.control.laws.law import LearningLaw
from twostage_servo.control.plant import Plant


def rig_of(gain: float = 1.0, pole: float = 1.0, **homing: Any) -> AxisRig:
    """Return an axis whose plant has these multiples of the model's gain and pole."""
    settings = AxisSettings.model_validate(DEMO | {"law": {"type": "adaptive"}, "homing": homing})
    return AxisRig(Axis(design_axis(settings, PERIOD_S), TRAITS), Plant(180.0 * gain, 14.0 * pole))


def known(rig: AxisRig) -> LearningLaw:
    assert isinstance(rig.axis.law, LearningLaw)
    return rig.axis.law


@pytest.mark.parametrize("seed", range(12))
def test_a_healthy_axis_never_trips_whatever_it_is_asked_for(seed: int) -> None:
    """Plants up to 20 % off, a load, noise of 0.01 mm, and requests at any time."""
    rng = random.Random(seed)  # noqa: S311 - a test
    rig = rig_of(rng.uniform(0.8, 1.2), rng.uniform(0.8, 1.2)).armed()
    rig.load = rng.uniform(-0.5, 0.5)
    rig.sees = lambda position: round(position + rng.gauss(0.0, 0.01), 3)
    rig.seconds(0.5)
    for _ in range(12):
        choice = rng.random()
        with contextlib.suppress(Refused):  # a jog begins at rest, and a move when a stop has ended
            if choice < 0.7:
                rig.axis.move_to(rng.uniform(-600.0, 600.0), rng.uniform(5.0, 160.0))
            elif choice < 0.85:
                rig.axis.stop(quick=rng.random() < 0.5)
            else:
                rig.axis.jog(rng.choice((-1.0, 1.0)) * rng.uniform(5.0, 160.0))
        rig.seconds(rng.uniform(0.02, 3.0))
        assert rig.axis.trip is None
    rig.axis.stop()
    rig.seconds(1.5)
    assert (rig.state(), rig.axis.trip) == (State.HOLDING, None)


def test_a_move_ends_as_soon_as_it_may_and_is_told_to_have_been_reached() -> None:
    rig = rig_of(1.25, 0.8).armed()
    move = rig.axis.move_to(400.0, 100.0)
    rig.seconds(4.3)
    assert move.outcome == "reached"
    assert rig.position == pytest.approx(400.0, abs=0.02)
    assert known(rig).learned.gain == pytest.approx(225.0, rel=0.02)


def test_a_trip_makes_it_forget_the_plant() -> None:
    rig = rig_of(1.25, 0.8).armed()
    rig.axis.move_to(400.0, 100.0)
    rig.seconds(5.0)
    assert known(rig).learned.moves == 1
    rig.axis.raise_trip(TripCode.STALE_FEEDBACK, "test")
    assert known(rig).learned.moves == 0
    assert known(rig).learned.gain == 180.0


@pytest.mark.parametrize(("factor", "farthest"), [(-1.0, 10.0), (0.5, 20.0), (2.0, 5.0)])
@pytest.mark.parametrize("moves_before", [0, 2])
def test_a_scale_or_sign_that_is_wrong_from_rest_is_told_in_the_next_move(
    factor: float, farthest: float, moves_before: int
) -> None:
    """Also one that has come since a braking that showed that all was right: each move is judged by itself."""
    rig = rig_of().armed()
    for move in range(moves_before):
        rig.axis.move_to(0.0 if move % 2 else 150.0, 100.0)
        rig.seconds(1.9)
    at = rig.position
    rig.sees = lambda position: at + factor * (position - at)
    rig.axis.move_to(at + 400.0, 100.0)
    rig.seconds(3.0)
    assert rig.state() is State.TRIPPED
    assert rig.axis.trip is not None
    expected = TripCode.SIGN_REVERSED if factor < 0.0 else TripCode.MODEL_MISMATCH
    assert rig.axis.trip.code in {expected, TripCode.POSITION_JUMP}
    assert abs(rig.position - at) < farthest


def test_an_axis_that_is_stuck_is_stalled_within_its_stall_time() -> None:
    rig = rig_of().armed()
    rig.sees = lambda _: 0.0
    rig.axis.move_to(400.0, 100.0)
    ticks = 0
    while rig.axis.trip is None:
        rig.position = rig.velocity = 0.0
        rig.tick()
        ticks += 1
    assert rig.axis.trip.code is TripCode.STALL
    assert ticks <= 8
    assert max(abs(command.effort) for command in rig.commands) < 20.0


@pytest.mark.parametrize("effort", [1.5, 5.0, 10.0])
@pytest.mark.parametrize("load", [0.0, 0.5])
def test_a_hard_stop_is_found_and_left(effort: float, load: float) -> None:
    way: dict[str, Any] = {"velocity": 20.0, "slow_velocity": 5.0, "travel": 200.0, "back_off": 3.0, "position": 48.0}
    rig = rig_of(method="hard_stop", direction="positive", effort=effort, **way)
    rig.load = -load
    rig.armed()
    rig.axis.home()
    for _ in range(4000):
        rig.tick()
        if rig.position >= 60.0:
            rig.position, rig.velocity = 60.0, min(rig.velocity, 0.0)
        if rig.state() is not State.HOMING:
            break
    assert (rig.state(), rig.axis.trip) == (State.HOLDING, None)
    assert 56.5 <= rig.position <= 57.0
    assert max(abs(command.effort) for command in rig.commands) <= effort * 1.02


@pytest.mark.parametrize("jerk", [None, 20_000.0])
@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize("distance", [0.0, -0.0, 1e-300, 1e-15, -1e-12, 1e-9, 1e-7, -1e-5, 1e-3])
def test_a_move_to_where_the_axis_stands_is_at_its_end_at_once(
    distance: float, learned: bool, jerk: float | None
) -> None:
    """With a way of nothing the reference did not rise, so the move never ended; a smooth one divided by nothing."""
    law: dict[str, Any] = {"type": "adaptive"} | ({} if jerk is None else {"jerk": jerk})
    rig = AxisRig(Axis(design_axis(AxisSettings.model_validate(DEMO | {"law": law}), PERIOD_S), TRAITS)).armed()
    if learned:
        rig.axis.move_to(50.0, 100.0)
        rig.seconds(3.0)
    for place in (rig.axis.motion.law.observer.position, rig.axis.drive.position, rig.axis.law.target):
        assert place is not None
        move = rig.axis.move_to(place + distance, 100.0)
        rig.seconds(0.3)
        assert move.outcome == "reached"
        assert rig.position == pytest.approx(place + distance, abs=0.003)


@pytest.mark.parametrize("velocity", [20.0, 100.0, 250.0])
@pytest.mark.parametrize("distance", [0.001, 0.01, -0.05, 0.1, 0.2, -0.4, 1.0, 5.0])
def test_on_a_plant_that_is_known_no_move_is_too_short(distance: float, velocity: float) -> None:
    """A move by 0.001 mm swung by 0.38 mm with 17 V: a braking that ends within a tick was never late."""
    rig = AxisRig(
        Axis(design_axis(AxisSettings.model_validate(DEMO | {"law": {"type": "adaptive"}}), PERIOD_S), TRAITS)
    )
    rig.armed().axis.move_to(50.0, 100.0)
    rig.seconds(3.0)
    move = rig.axis.move_by(distance, velocity)
    places = [rig.seconds(PERIOD_S).position for _ in range(60)]
    assert move.outcome == "reached"
    sign = 1.0 if distance > 0.0 else -1.0
    assert max(sign * (place - 50.0 - distance) for place in places) < 0.002
    assert min(sign * (place - 50.0) for place in places) > -0.002


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("file", ["metres.toml", "rotary_table.toml", "fast_tick.toml", "plain_drive.toml"])
def test_short_moves_arrive_on_axes_of_other_units_and_ticks(file: str, smooth: bool) -> None:
    """Of nothing, and from a millionth of the position window to four of it; on a plant that is known."""
    path, law = shipped_configuration(file), "axis.law.type=adaptive"
    jerk = 10.0 * load(path).config.axis.limits.acceleration
    config = load(path, [law, f"axis.law.jerk={jerk}"] if smooth else [law]).config
    settings, design = config.axis, design_axis(config.axis, config.service.tick_ms / 1e3)
    rig = AxisRig(Axis(design, TRAITS), Plant(settings.plant.gain, settings.plant.pole), design.period_s)
    window, velocity = settings.window.position, settings.cruise_velocity
    rig.seconds(10.0 * design.period_s)
    rig.axis.set_position(0.0)
    rig.seconds(10.0 * design.period_s)
    rig.axis.arm()
    rig.seconds(0.5)
    for distance in (0.0, velocity, 0.0, 1e-6 * window, 0.02 * window, 0.3 * window, 4.0 * window):
        move = rig.axis.move_by(distance, velocity)
        target = rig.axis.set_point
        farthest = max(rig.seconds(design.period_s).position for _ in range(round(6.0 / design.period_s)))
        assert move.outcome == "reached", (distance, rig.axis.trip)
        assert farthest <= target + 0.02 * window, distance
