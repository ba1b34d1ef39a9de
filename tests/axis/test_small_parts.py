"""What small parts of an axis keep and tell, where no behaviour of a whole axis shows it at once."""

from types import SimpleNamespace
from typing import Any

import pytest

from tests.axis.rig import PERIOD_S, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.disabled_drive import DisabledDriveWatch
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.driven_step import DrivenStep
from twostage_servo.axis.feedback import FeedbackMonitor
from twostage_servo.axis.jog_timer import JogTimer
from twostage_servo.axis.messages import DriveTraits, Feedback
from twostage_servo.axis.moves import Move, MoveKind
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode, TripFile


def test_a_trips_file_is_told_once_it_is_whole() -> None:
    file = TripFile()
    assert (file.path, file.error) == (None, None)
    file.complete("/folder/000001.json")
    assert (file.path, file.error) == ("/folder/000001.json", None)


def test_a_move_knows_where_it_began() -> None:
    rig = AxisRig().armed()
    rig.axis.move_to(50.0, 40.0)
    assert rig.axis.move is not None
    began = rig.axis.move.start
    assert began == pytest.approx(rig.position, abs=0.01)
    assert Move(1, MoveKind.MOVE, 10.0, 5.0, 2.0).start == 2.0


@pytest.mark.parametrize(("code", "told"), [(7, "fault code 7 (over-temperature)"), (8, "fault code 8")])
def test_a_drives_fault_is_told_with_its_name_where_that_is_known(code: int, told: str) -> None:
    drive = DriveReport(axis_settings(), PERIOD_S, DriveTraits(fault_texts={7: "over-temperature"}))
    drive.begin_tick(0)
    drive.accept_feedback(Feedback(0.0, 1, fault_code=code))
    causes = dict(drive.troubles(arming=False))
    assert causes[TripCode.DRIVE_FAULT] == f"the drive reports {told}"


def test_a_bus_that_is_open_again_has_brought_nothing_too_late_yet() -> None:
    monitor = FeedbackMonitor(16)
    monitor.accept(1, late=True)
    assert monitor.late_since_fresh == 1
    monitor.forget()
    monitor.accept(2, late=True)
    assert monitor.late_since_fresh == 1


def test_a_new_origin_moves_what_the_encoder_has_shown_last() -> None:
    """Else the next sample were a motion of an encoder that stands still."""
    rig = AxisRig().armed()
    rig.axis.set_position(500.0)
    rig.tick()
    before = rig.axis.motion._shown
    rig.axis.set_position(700.0)
    assert before == pytest.approx(500.0, abs=0.01)
    assert rig.axis.motion._shown == pytest.approx(700.0, abs=0.01)


def test_a_move_is_equal_to_a_move_alone() -> None:
    move = Move(1, MoveKind.MOVE, 10.0, 5.0, 2.0)
    assert move == Move(1, MoveKind.MOVE, 10.0, 5.0, 2.0)
    assert move != Move(1, MoveKind.MOVE, 10.0, 5.0, 2.5)
    assert move.__eq__("a move") is NotImplemented


def test_a_stop_by_somebody_else_bars_a_jog_to_the_last_tick_of_its_time() -> None:
    """300 ms are 30 ticks."""
    jog = JogTimer(design_axis(axis_settings(), PERIOD_S))
    assert [jog.is_barred] == [False]
    jog.bar()
    barred = []
    for _ in range(30):
        barred.append(jog.is_barred)
        jog.begin_tick(0)
    assert barred == [True] * 30
    assert [jog.is_barred] == [False]


def test_what_is_not_known_of_a_drive_beforehand_is_not_supposed() -> None:
    traits = DriveTraits()
    assert (traits.counts_boots, traits.has_heartbeat, traits.position_period) == (False, False, 0.0)


def test_another_report_of_the_same_drive_keeps_why_frames_are_late() -> None:
    before, after = (DriveReport(axis_settings(), PERIOD_S, DriveTraits()) for _ in range(2))
    before.record_backlog(3, 500)
    after.continue_from(before)
    assert after.backlog == (3, 500)


def test_before_its_first_tick_a_latch_is_at_tick_0() -> None:
    rig = AxisRig()
    rig.axis.raise_trip(TripCode.INTERNAL_ERROR, "test")
    assert [rig.axis._latch.tick] == [0]


def test_the_speed_that_would_be_in_force_is_the_share_of_what_is_asked_for_within_the_limit() -> None:
    rig = AxisRig().armed()
    rig.axis.set_override(150.0)
    assert rig.axis.velocity_in_force(100.0) == 150.0
    assert rig.axis.velocity_in_force(200.0) == 250.0


@pytest.mark.parametrize(("tells", "period_ms"), [(True, 0.0), (False, 300.0)])
def test_a_drive_whose_feedback_does_not_tell_is_watched_by_its_heartbeat(tells: bool, period_ms: float) -> None:
    """A heartbeat of 300 ms leaves the drive 30 ticks more."""
    design = design_axis(axis_settings(), PERIOD_S)
    axis = Axis(design, DriveTraits(tells_enabled=tells))
    assert axis.disabled._patience == DisabledDriveWatch(design, report_period_ms=period_ms)._patience


@pytest.mark.parametrize("state", [State.TRIPPED_STOPPING, State.TRIPPED_QUICK_STOP, State.HOLDING])
@pytest.mark.parametrize("first", [None, TripCode.COMMANDS_DROPPED, TripCode.STALE_FEEDBACK])
@pytest.mark.parametrize("code", [TripCode.SIGN_REVERSED, TripCode.MODEL_MISMATCH, TripCode.STALL])
def test_no_commands_explain_an_answer_alone_while_the_axis_brakes_for_want_of_them(
    code: TripCode, first: TripCode | None, state: State
) -> None:
    latch = SimpleNamespace(trip=None if first is None else SimpleNamespace(code=first))
    driven: Any = SimpleNamespace(_latch=latch, _machine=SimpleNamespace(state=state))
    explained = state is not State.HOLDING and first is TripCode.COMMANDS_DROPPED and code is not TripCode.STALL
    assert [DrivenStep._lacks_commands(driven, code)] == [explained]
