"""What small parts of an axis keep and tell, where no behaviour of a whole axis shows it at once."""

import pytest

from tests.axis.rig import PERIOD_S, AxisRig, axis_settings
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.feedback import FeedbackMonitor
from twostage_servo.axis.messages import DriveTraits, Feedback
from twostage_servo.axis.moves import Move, MoveKind
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
