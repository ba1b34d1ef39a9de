"""Samples that are missing: the innovation gate allows what the model can be wrong by in that time, and no more."""

import itertools
from pathlib import Path

import pytest

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign, design_axis
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.messages import IN_TIME, DriveTraits, Feedback, Reception
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.sample_gap import SampleGap
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.config.loader import load
from twostage_servo.control.plant import Plant

EXAMPLE_2 = design_axis(load(Path("config/example2.toml")).config.axis, PERIOD_S)
DEMO = design_axis(axis_settings(), PERIOD_S)


class DatedRig(AxisRig):
    """An axis whose samples are dated, as a bus with time stamps does it."""

    def tick(self, missed: int = 0):  # type: ignore[no-untyped-def]
        take = self.axis.accept_feedback
        self.axis.accept_feedback = lambda feedback, reception=IN_TIME: take(
            feedback._replace(position=self.answer), Reception((1 + missed) * PERIOD_S)
        )
        command = super().tick(missed)
        self.axis.accept_feedback = take
        self.answer = self.sample  # of the command that has left just now
        return command

    answer = 0.0


@pytest.mark.long
@pytest.mark.parametrize("rig_class", [AxisRig, DatedRig])
@pytest.mark.parametrize("missed", [2, 5])
def test_a_gap_on_a_plant_that_is_off_its_model_is_no_jump_of_the_encoder(
    rig_class: type[AxisRig], missed: int
) -> None:
    """Gain 30 % up, pole 30 % down, an acceleration without limit: in 50 ms the model is wrong by 3 mm."""
    for tick in range(0, 300, 3):
        rig = rig_class(Axis(EXAMPLE_2, TRAITS), Plant(234.0, 9.8)).armed()
        rig.axis.move_to(200.0, 100.0)
        rig.seconds(tick * PERIOD_S)
        rig.tick(missed)
        rig.seconds(0.5)
        assert rig.axis.trip is None, (tick, rig.axis.trip)


@pytest.mark.parametrize("rig_class", [AxisRig, DatedRig])
def test_a_jump_in_a_gap_is_still_one(rig_class: type[AxisRig]) -> None:
    for tick in (10, 30, 100):
        rig = rig_class(Axis(EXAMPLE_2, TRAITS), Plant(234.0, 9.8)).armed()
        rig.axis.move_to(200.0, 100.0)
        rig.seconds(tick * PERIOD_S)
        rig.sees = lambda position: position + 12.0
        rig.tick(5)
        rig.seconds(3.0 * PERIOD_S)
        assert rig.axis.trip is not None
        assert rig.axis.trip.code is TripCode.POSITION_JUMP


def test_a_host_that_misses_every_other_tick_does_not_widen_the_gate_for_ever() -> None:
    rig = DatedRig(Axis(DEMO, TRAITS)).cruising(velocity=100.0, for_s=1.0)
    usual = rig.axis.motion.innovation_gate
    widest = 0.0
    for _ in range(50):
        rig.tick(1)
        widest = max(widest, rig.axis.motion.innovation_gate)
    assert rig.axis.state is State.SPEED_STAGE
    assert widest < 1.5 * usual


def gap(design: AxisDesign, ticks: int, velocity: float = 100.0, effort: float = 10.0) -> SampleGap:
    observer = design.build_law().observer
    observer.velocity = velocity
    one = SampleGap(design)
    for _ in range(ticks):
        one.miss(observer, effort)
    return one


def test_the_allowance_grows_with_the_gap_and_goes_with_the_samples() -> None:
    assert SampleGap(DEMO).allowance == 0.0
    grown = [gap(DEMO, ticks).allowance for ticks in range(1, 8)]
    assert all(after > before > 0.0 for before, after in itertools.pairwise(grown))
    # 30 % of (180 * 10 + 14 * 100) mm/s2 for 50 ms, less what the pole takes away: 0.96 mm.
    assert gap(DEMO, 5).allowance == pytest.approx(0.5 * 0.3 * 3200.0 * 0.05**2, rel=0.2)
    one = gap(DEMO, 5)
    for _ in range(100):
        one.accept()
    assert one.allowance == 0.0


def test_a_plant_turned_round_has_the_same_allowance() -> None:
    settings = axis_settings().model_copy(update={"plant": axis_settings().plant.model_copy(update={"gain": -180.0})})
    mirrored = design_axis(settings, PERIOD_S)
    assert gap(mirrored, 4, velocity=-100.0).allowance == pytest.approx(gap(DEMO, 4).allowance)


def test_an_encoder_that_stands_still_does_not_look_alive_by_the_dates_of_its_samples() -> None:
    drive = DriveReport(axis_settings(), PERIOD_S, DriveTraits(counter_modulus=16))
    motion = Motion(DEMO, drive, 0.001)

    def report(age_s: float, counter: int) -> None:
        drive.begin_tick(0, motion.expected_position(driven=True))
        motion.begin_tick(0)
        drive.accept_feedback(Feedback(0.0, counter % 16, True), Reception(age_s))

    for counter in range(3):
        report(PERIOD_S, counter)
        motion.track()
    motion.start()
    motion.set_target(50.0, 20.0)
    for counter in range(3, 10):
        report(PERIOD_S + 0.002 * (-1.0) ** counter, counter)
        motion.step()
    assert abs(motion.law.observer.velocity) > 2.0  # so that each date moves the sample by more than the resolution
    assert motion.unchanged_effort > 0.5


def test_a_gap_that_is_closed_surprises_nothing_whatever_its_error_was() -> None:
    one = gap(DEMO, 5)
    assert one.surprise >= one.allowance > 0.0
    one.close()
    assert one._error.velocity != 0.0
    assert (one.surprise, one.allowance) == (0.0, 0.0)


def test_a_sample_that_is_not_believed_lets_the_error_go_on_and_adds_nothing_to_it() -> None:
    one, alone = gap(DEMO, 3), DEMO.build_law().observer
    alone.continue_from(one._error)
    one.doubt()
    alone.predict(0.0)
    assert one.allowance == pytest.approx(abs(alone.position))
    assert (one._error.velocity, one._error.disturbance) == pytest.approx((alone.velocity, alone.disturbance))


def test_an_old_sample_begins_the_gap_anew_with_what_was_hidden_before_it() -> None:
    """The speed that a steady innovation hides: gain 1 of it in a tick; of a gap that has not been, none."""
    observer = DEMO.build_law().observer
    fresh = SampleGap(DEMO)
    fresh.reopen(0, observer, 0.0)
    assert fresh._error.velocity == 0.0
    observer.innovation = -0.2
    fresh.close()
    fresh.miss(observer, 0.0)
    hidden = abs(observer.gain[0] * 0.2) / DEMO.plant.a12
    observer.innovation = 0.0
    fresh.reopen(0, observer, 0.0)
    assert fresh._error.velocity == pytest.approx(hidden)
