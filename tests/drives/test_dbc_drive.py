"""A drive that a DBC describes, from both ends: what each makes of the other's frames."""

import subprocess
import sys
from pathlib import Path

import can
import pytest

from twostage_servo.axis.messages import Command, Feedback, ForeignCommand, Heartbeat, IndexMark
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.drives.dbc.drive import DbcDrive
from twostage_servo.drives.dbc.drive_side import DbcDriveSide
from twostage_servo.drives.dbc.drive_type import DBC
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.drives.frame import FrameRejected
from twostage_servo.drives.protocol_error import ProtocolError
from twostage_servo.drives.registry import DRIVES, DriveType


def drive(**tables: object) -> DbcDrive:
    return DBC.build(ProtocolSettings.model_validate(tables), Path(), "mm", False)


PLAIN = {
    "index": {"message": False},
    "heartbeat": {"message": False},
}


def received(frame: tuple[Identifier, bytes]) -> can.Message:
    (number, extended), data = frame
    return can.Message(arbitration_id=number, is_extended_id=extended, data=data)


def test_it_is_the_type_of_its_entry_point() -> None:
    assert DRIVES.get("dbc") is DBC
    assert isinstance(DBC, DriveType)
    assert DBC.settings is ProtocolSettings


def test_a_configuration_is_read_without_what_compiles_a_dbc() -> None:
    script = (
        "import sys; from twostage_servo.config.loader import load; load(None); sys.exit('cantools' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)  # noqa: S603 - our own interpreter and text


def test_its_commands_count_up_and_say_what_was_asked_for() -> None:
    one, side = drive(), DBC.side(drive())
    for counter in (1, 2, 3):
        (frame,) = one.encode(Command(-1.5, enable=True))
        assert frame[0] == one.command_id
        assert side.decode(received(frame)) == Command(-1.5, enable=True, counter=counter)


def test_two_drives_count_by_themselves() -> None:
    first, second = drive(), drive()
    first.encode(Command(0.0, enable=False))
    assert first.encode(Command(0.0, enable=False)) != second.encode(Command(0.0, enable=False))


@pytest.mark.parametrize("effort", [float("nan"), float("inf")])
def test_an_effort_that_is_not_finite_is_not_sent(effort: float) -> None:
    with pytest.raises(ValueError, match="must be finite"):
        drive().encode(Command(effort, enable=True))


def test_each_report_of_the_drive_finds_its_decoder() -> None:
    one = drive()
    side = DbcDriveSide(one.profile)
    reports = (
        Feedback(12.5, 3, True, False, 0, False, False, False, True, False),
        IndexMark(-4.25, 2),
        Heartbeat(3, 7),
    )
    feedback, mark, heartbeat = reports
    frames = (*side.feedback(feedback), *side.index(mark), *side.heartbeat(heartbeat))
    assert [frame.identifier for frame in frames] == [Identifier(number, False) for number in (0x181, 0x281, 0x701)]
    assert list(one.decoders) == [*(frame.identifier for frame in frames), Identifier(0x201, False)]
    assert [one.decoders[frame.identifier](received(frame)) for frame in frames] == list(reports)
    assert side.answers() == ()


def test_what_it_does_not_have_is_neither_listened_to_nor_sent() -> None:
    one = drive(**PLAIN)
    side = DbcDriveSide(one.profile)
    assert list(one.decoders) == [one.feedback_id, one.command_id]
    assert (side.has_index, side.has_heartbeat) == (False, False)
    assert (side.index(IndexMark(0.0, 0)), side.heartbeat(Heartbeat(0, 0))) == ((), ())
    assert [frame.name for frame in one.cyclic_frames(0.01, 0.1)] == ["command", "feedback"]


def test_it_obeys_its_command_alone_and_needs_no_start() -> None:
    one = drive()
    assert one.obeyed == (one.command_id,)
    assert DbcDriveSide(one.profile).identifiers == (one.command_id,)
    assert one.start_up == ()
    assert "command time-out" in one.dead_host


def test_a_command_of_somebody_else_is_read_as_far_as_it_can_be() -> None:
    one, other = drive(), drive()
    foreign = one.decoders[one.command_id]
    ((identifier, data),) = other.encode(Command(3.0, enable=True))
    text = f"0x201 [{data.hex(' ')}]"
    assert foreign(received((identifier, data))) == ForeignCommand(text, Command(3.0, enable=True, counter=1))
    spoilt = bytes((*data[:-1], data[-1] ^ 1))
    assert foreign(received((identifier, spoilt))) == ForeignCommand(f"0x201 [{spoilt.hex(' ')}]", None, "checksum")
    with pytest.raises(FrameRejected, match="29 bits"):
        foreign(received((Identifier(0x201, extended=True), data)))


def test_another_content_of_the_dbc_is_told(tmp_path: Path) -> None:
    shipped = (Path(__file__).parents[2] / "config" / "servo_drive.dbc").read_bytes()
    (tmp_path / "mine.dbc").write_bytes(shipped)
    settings = ProtocolSettings(dbc="mine.dbc")
    traits = DBC.build(settings, tmp_path, "mm", False).traits
    DBC.check_unchanged(settings, tmp_path, traits)
    (tmp_path / "mine.dbc").write_bytes(shipped + b"\n")
    with pytest.raises(ProtocolError, match="restart the service") as caught:
        DBC.check_unchanged(settings, tmp_path, traits)
    assert caught.value.key == ("protocol", "dbc")
