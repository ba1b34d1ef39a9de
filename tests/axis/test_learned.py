"""What an axis' law has learned: how long it is kept, and what makes it forget."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from tests.axis.rig import DEMO, PERIOD_S, TRAITS, AxisRig
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.learned_plant import LearnedPlant
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.laws.law import Learned
from twostage_servo.control.plant import Plant


def axis_of(law: dict[str, Any] | None = None, **changed: Any) -> Axis:
    settings = AxisSettings.model_validate(DEMO | {"law": {"type": "adaptive"} | (law or {})} | changed)
    return Axis(design_axis(settings, PERIOD_S), TRAITS)


def rig_of(law: dict[str, Any] | None = None, **changed: Any) -> AxisRig:
    return AxisRig(axis_of(law, **changed), Plant(225.0, 11.2))


def learned(rig: AxisRig) -> Learned:
    assert rig.axis.learned is not None
    return rig.axis.learned


def after_moves(rig: AxisRig, *targets: float) -> AxisRig:
    rig.armed()
    for target in targets:
        rig.axis.move_to(target, 100.0)
        rig.seconds(5.0)
        assert rig.state() is State.HOLDING
    return rig


def refusal(rig: AxisRig) -> tuple[RefusalCode, str]:
    with pytest.raises(Refused) as refused:
        rig.axis.forget()
    return refused.value.code, str(refused.value)


@pytest.mark.parametrize(("memory", "moves"), [("moves", 3), ("file", 3), ("none", 1)])
def test_it_is_kept_from_move_to_move_unless_each_is_to_begin_anew(memory: str, moves: int) -> None:
    rig = after_moves(rig_of({"memory": memory}), 400.0, 0.0, 400.0)
    assert learned(rig).moves == moves
    assert learned(rig).gain == pytest.approx(225.0, rel=0.02)
    assert rig.axis.times_forgotten == 0


def test_without_a_memory_each_move_begins_with_the_configured_plant() -> None:
    rig = after_moves(rig_of({"memory": "none"}), 400.0)
    assert learned(rig).moves == 1  # and is shown, until the next one begins
    rig.axis.move_to(0.0, 100.0)
    assert (learned(rig).moves, learned(rig).gain) == (0, 180.0)
    rig.seconds(5.0)
    rig.axis.jog(50.0)
    assert (learned(rig).moves, learned(rig).gain) == (0, 180.0)


def test_a_leg_of_a_move_goes_on_with_what_the_leg_before_has_learned() -> None:
    rig = rig_of({"memory": "none"}, approach={"direction": "positive", "distance": 20.0})
    after_moves(rig, -300.0)
    assert learned(rig).moves == 2


def test_an_operator_makes_it_forget_at_rest() -> None:
    rig = after_moves(rig_of(), 400.0)
    before = rig.commands[-1].effort
    rig.axis.forget()
    assert (learned(rig).moves, learned(rig).gain, rig.axis.times_forgotten) == (0, 180.0, 1)
    rig.seconds(1.0)
    assert rig.position == pytest.approx(400.0, abs=0.02)
    assert max(abs(command.effort - before) for command in rig.commands[-100:]) < 0.05
    rig.axis.disarm()
    rig.axis.forget()
    assert rig.axis.times_forgotten == 2


def test_an_axis_that_moves_keeps_what_it_knows() -> None:
    rig = after_moves(rig_of(), 400.0)
    rig.axis.move_to(0.0, 100.0)
    rig.seconds(1.0)
    code, text = refusal(rig)
    assert code is RefusalCode.BUSY
    assert text == "the axis is moving_speed_stage: `stop` it, or wait until it holds, then `forget`."
    rig.axis.stop()
    rig.seconds(0.02)
    assert refusal(rig) == (RefusalCode.BUSY, "the axis is stopping: wait until it is at rest, then `forget`.")
    assert learned(rig).moves >= 1
    rig.seconds(2.0)
    rig.axis.forget()
    assert learned(rig).moves == 0


@pytest.mark.parametrize(
    "law", [{"type": "paper"}, {"adaptive": {"identification": False}}], ids=["another law", "not identifying"]
)
def test_a_law_that_learns_nothing_says_so(law: dict[str, Any]) -> None:
    rig = rig_of(law)
    code, text = refusal(rig)
    assert code is RefusalCode.LEARNS_NOTHING
    assert f"axis.law.type = {law.get('type', 'adaptive')})" in text
    assert rig.axis.learned is None


def test_a_trip_is_counted_as_forgetting() -> None:
    rig = after_moves(rig_of(), 400.0)
    rig.axis.raise_trip(TripCode.STALE_FEEDBACK, "test")
    assert (learned(rig).moves, rig.axis.times_forgotten) == (0, 1)


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        ({"cruise_velocity": 50.0}, True),
        ({"plant": {"gain": 190.0, "pole": 14.0}}, False),
        ({"law": {"type": "adaptive", "memory": "none"}}, False),
        ({"law": {"type": "adaptive", "memory": "file"}}, True),
        ({"law": {"type": "adaptive", "adaptive": {"encoder_noise": 0.01}}}, False),
        ({"law": {"type": "paper"}}, False),
    ],
)
def test_settings_that_are_read_again_keep_it_if_the_plant_is_the_same(change: dict[str, Any], kept: bool) -> None:
    rig = after_moves(rig_of(), 400.0)
    rig.axis.disarm()
    rig.seconds(0.1)
    fresh = axis_of(**change) if "law" not in change else axis_of(change["law"])
    fresh.continue_from(rig.axis)
    assert (fresh.learned is not None and fresh.learned == rig.axis.learned) is kept


@pytest.mark.parametrize("load", [(-23.9, -23.9), (23.9, 23.9), (12.0, -12.0), (None, 9.1)])
def test_a_learned_load_that_the_axis_does_not_show_at_rest_is_forgotten(load: tuple[float | None, float]) -> None:
    """A file with 23.9 V made a move of 5 mm at 5 mm/s go 4.4 mm the wrong way, at up to 85 mm/s."""
    known = Learned(180.0, 14.0, 0.01, 0.01, 0, 50.0, load, 3, is_sure=True)
    rig = AxisRig(axis_of())
    rig.axis.recall(known)
    rig.armed()
    rig.axis.move_to(-5.0, 5.0)
    places, speeds = [], []
    for _ in range(150):
        rig.tick()
        places.append(rig.position)
        speeds.append(abs(rig.velocity))
    assert max(places) < 0.02
    assert max(speeds) < 5.5
    assert rig.position == pytest.approx(-5.0, abs=0.05)
    assert rig.axis.trip is None


def test_a_learned_load_that_friction_explains_is_kept() -> None:
    known = Learned(180.0, 14.0, 0.01, 0.01, 0, 50.0, (1.5, 1.5), 3, is_sure=True)
    rig = AxisRig(axis_of())
    rig.axis.recall(known)
    rig.armed()
    rig.axis.move_to(5.0, 50.0)
    rig.tick()
    assert learned(rig).load == (1.5, 1.5)


def test_the_model_monitor_is_told_of_a_plant_once() -> None:
    axis = axis_of()
    told: list[object] = []
    monitor: Any = SimpleNamespace(
        accept=lambda plant, estimate, is_late: told.append((plant, estimate, is_late)),
        forget_identified=lambda: told.append(None),
    )
    law: Any = SimpleNamespace(identified=None, plant_estimate="estimate", learned=SimpleNamespace(delay_ticks=1))
    plant = LearnedPlant(axis.design, axis.law)
    plant._law = law
    plant.tell(monitor)
    found = Plant(200.0, 12.0)
    for law.identified in (found, found, found, None, None):
        plant.tell(monitor)
    assert told == [(found, "estimate", True), None]


def test_another_set_point_on_the_way_is_the_same_move_to_a_law_that_forgets_between_moves() -> None:
    rig = rig_of({"memory": "none"}).armed()
    known = replace(learned(rig), gain=190.0, moves=7)
    rig.axis.recall(known)
    rig.axis.move_to(400.0, 100.0)
    assert learned(rig).moves == 0
    rig.seconds(0.5)
    rig.axis.recall(known)
    rig.axis.move_to(300.0, 100.0)
    assert learned(rig).moves == 7


def test_a_move_back_is_not_judged_by_what_held_the_axis_at_speed() -> None:
    """A plant of 1.3 times the gain and 0.7 times the pole seems to be pushed by 4 V at speed.

    Of 10 V the nominal response then had too little left the other way, and fell behind: `following_error`.
    """
    settings = AxisSettings.model_validate(
        DEMO | {"limits": DEMO["limits"] | {"effort": 10.0, "velocity": 115.0}, "law": {"type": "adaptive"}}
    )
    rig = AxisRig(Axis(design_axis(settings, PERIOD_S), TRAITS), Plant(1.3 * 180.0, 0.7 * 14.0))
    rig.armed()
    for target in (490.0, 0.0):
        rig.axis.move_to(target, 110.0)
        rig.seconds(2.0)
        assert abs(rig.axis.following_error) < 5.0
        rig.seconds(5.0)
        assert rig.axis.trip is None
        assert rig.position == pytest.approx(target, abs=0.1)


def test_a_sample_is_believed_where_the_identified_plant_expects_it() -> None:
    """And nowhere else: the gate is 0.5 mm around either estimate, and without an identified plant around the first."""
    rig = after_moves(rig_of(), 400.0)
    motion = rig.axis.motion
    own, gate = motion.law.observer, motion.innovation_gate
    assert motion.plant.expected_position == pytest.approx(own.position, abs=0.1)
    expected = motion.plant.expected_position
    assert expected is not None
    for off, believed in ((-4.0, False), (-2.0, True), (0.9 * gate, True), (1.1 * gate, False)):
        own.place(expected - 2.0)
        rig.axis.drive.fresh, rig.axis.drive.position, rig.axis.drive.age_s = True, expected + off, None
        assert (motion._believed_sample(0.0) is not None) is believed
    rig.axis.motion.plant.forget()
    assert motion.plant.expected_position is None
    rig.axis.drive.position = expected
    assert motion._believed_sample(0.0) is None
