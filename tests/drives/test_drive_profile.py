import contextlib
import math
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from cantools.database.can import Database
from hypothesis import assume, given
from hypothesis import strategies as st

from twostage_servo.axis.messages import Command, Feedback, Heartbeat, IndexMark
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.drives.dbc.checksum import crc8_j1850, sum8, xor8
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.drives.frame import FrameRejected, PositionRejected
from twostage_servo.drives.protocol_error import ProtocolError

DBC = Path(__file__).parents[2] / "config" / "servo_drive.dbc"
SHIPPED = DriveProfile.compile(ProtocolSettings(), Path(), "mm")

# A drive with other habits: 29 bits, big-endian, float effort, a counter of 14 values, sum8 in the first byte, a mode.
OTHER_DBC = """VERSION ""
BU_: Host Motor
BO_ 2566848513 Set: 8 Host
 SG_ Sum : 7|8@0+ (1,0) [0|255] "" Motor
 SG_ Torque : 15|32@0- (1,0) [-50|50] "Nm" Motor
 SG_ Mode : 47|8@0+ (1,0) [0|9] "" Motor
 SG_ On : 55|2@0+ (1,0) [0|3] "" Motor
BO_ 2566848514 Status: 8 Motor
 SG_ Angle : 7|32@0- (0.01,0) [-1000000|1000000] "deg" Host
 SG_ Error : 39|8@0+ (1,0) [0|255] "" Host
 SG_ Cycle : 43|4@0+ (1,0) [0|13] "" Host
 SG_ Unsigned : 63|8@0+ (1,0) [0|0] "" Host
BO_ 2566848516 Mark: 4 Motor
 SG_ Latch : 7|32@0- (0.01,0) [-1000000|1000000] "deg" Host
BO_ 2566848515 Paged: 8 Motor
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" Host
 SG_ Angle m1 : 8|16@1- (1,0) [0|0] "deg" Host
SIG_VALTYPE_ 2566848513 Torque : 1;
"""
OTHER: dict[str, Any] = {
    "dbc": "other.dbc",
    "checksum": "sum8",
    "feedback": {
        "message": "Status",
        "position": "Angle",
        "position_scale": -0.5,
        "enabled": False,
        "fault": False,
        "fault_code": "Error",
        "command_timeout": False,
        "safe_torque_off": False,
        "positive_limit": False,
        "negative_limit": False,
        "home_switch": False,
        "counter": "Cycle",
        "checksum": False,
    },
    "command": {
        "message": "Set",
        "effort": "Torque",
        "enable": "On",
        "counter": False,
        "checksum": "Sum",
        "constants": {"Mode": 4},
    },
    "index": {"message": False},
    "heartbeat": {"message": False},
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "other.dbc").write_text(OTHER_DBC, encoding="cp1252")
    return tmp_path


def other_settings(**changes: Any) -> ProtocolSettings:
    """Settings of the other drive; ``changes`` merge into its tables."""
    settings = {key: dict(value) if isinstance(value, dict) else value for key, value in OTHER.items()}
    for key, value in changes.items():
        settings[key] = settings[key] | value if isinstance(value, dict) else value
    return ProtocolSettings.model_validate(settings)


def shipped_settings(**changes: Any) -> ProtocolSettings:
    return ProtocolSettings.model_validate(changes)


def shipped_database() -> Database:
    database = cantools.database.load_file(DBC, strict=True)
    assert isinstance(database, Database)
    return database


def message_of(data: bytes, identifier: int = 0x181, **kwargs: Any) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, **({"is_extended_id": False} | kwargs))


# The shipped DBC --------------------------------------------------------------------------------------------------


def test_every_message_and_signal_of_the_shipped_dbc_is_documented() -> None:
    for message in shipped_database().messages:
        assert message.comment, message.name
        assert message.cycle_time or message.name == "DriveIndex", message.name  # which an event sends
        for signal in message.signals:
            assert signal.comment, f"{message.name}.{signal.name}"
            assert signal.minimum is not None, f"{message.name}.{signal.name}"
            assert signal.maximum is not None, f"{message.name}.{signal.name}"


def test_shipped_profile_has_the_figures_of_the_documented_protocol() -> None:
    assert SHIPPED.command_id == Identifier(0x201, extended=False)
    assert SHIPPED.feedback_id == Identifier(0x181, extended=False)
    assert SHIPPED.heartbeat_id == Identifier(0x701, extended=False)
    assert SHIPPED.index_id == Identifier(0x281, extended=False)
    assert (SHIPPED.traits.effort_quantum, SHIPPED.traits.effort_limit, SHIPPED.traits.position_quantum) == (
        0.001,
        32.0,
        0.001,
    )
    assert (SHIPPED.traits.counter_modulus, SHIPPED.command_counter_modulus, SHIPPED.index_counter_modulus) == (
        16,
        16,
        16,
    )
    assert (SHIPPED.boot_counter_modulus, SHIPPED.traits.sampling) == (256, "on_command")
    assert SHIPPED.traits.position_period == pytest.approx(4294967.296, rel=1e-15)
    assert SHIPPED.traits.fault_texts[1] == "Command timeout"
    assert SHIPPED.traits.state_texts[3] == "Operation enabled"


def test_command_has_the_golden_bytes() -> None:
    # -1.5 / 0.001 = -1500 = 0xFA24; Enable bit 16; counter 7 in the high half of byte 2.
    covered = bytes.fromhex("24fa71")
    assert SHIPPED.encode_command(-1.5, enable=True, counter=7) == covered + bytes((crc8_j1850(0x201, covered),))
    assert SHIPPED.encode_command(0.0, enable=False, counter=0)[:3] == bytes(3)


@given(st.floats(-40, 40), st.booleans(), st.integers(0, 10**9))
def test_commands_are_those_of_cantools(effort: float, enable: bool, counter: int) -> None:
    data = SHIPPED.encode_command(effort, enable, counter)
    saturated = min(max(effort, -32.0), 32.0)
    values = {"Effort": saturated, "Enable": enable, "AliveCounter": counter % 16, "Checksum": data[3]}
    assert data == shipped_database().get_message_by_name("DriveCommand").encode(values, strict=False)
    assert data[3] == crc8_j1850(0x201, data[:3])


FEEDBACKS = st.builds(
    Feedback,
    st.integers(-(2**31) + 1, 2**31 - 1).map(lambda raw: raw * 0.001),
    st.integers(0, 15),
    st.booleans(),
    st.booleans(),
    st.integers(0, 255),
    *[st.booleans()] * 5,
)


@given(FEEDBACKS)
def test_feedback_is_that_of_cantools(feedback: Feedback) -> None:
    data = SHIPPED.encode_feedback(feedback)
    decoded = shipped_database().decode_message("DriveFeedback", data, decode_choices=False)
    assert isinstance(decoded, dict)
    assert decoded.pop("Checksum") == crc8_j1850(0x181, data[:7])
    assert decoded == {
        "Position": feedback.position,
        "AliveCounter": feedback.counter,
        "Enabled": feedback.enabled,
        "Fault": feedback.fault,
        "FaultCode": feedback.fault_code,
        "CommandTimeout": feedback.command_timeout,
        "SafeTorqueOff": feedback.safe_torque_off,
        "PositiveLimit": feedback.positive_limit,
        "NegativeLimit": feedback.negative_limit,
        "HomeSwitch": feedback.home_switch,
    }
    assert SHIPPED.decode_feedback(message_of(data)) == feedback


@given(st.integers(-(2**31) + 1, 2**31 - 1), st.integers(0, 15))
def test_index_is_that_of_cantools(raw: int, counter: int) -> None:
    index = IndexMark(raw * 0.001, counter)
    data = SHIPPED.encode_index(index)
    values = {"Position": index.position, "AliveCounter": counter, "Checksum": crc8_j1850(0x281, data[:5])}
    assert data == shipped_database().encode_message("DriveIndex", values)
    message = message_of(data, 0x281)
    assert SHIPPED.decode_index(message) == index


@given(st.integers(0, 7), st.integers(0, 255))
def test_heartbeat_is_that_of_cantools(state: int, boot_counter: int) -> None:
    data = SHIPPED.encode_heartbeat(Heartbeat(state, boot_counter))
    expected = shipped_database().encode_message("DriveHeartbeat", {"State": state, "BootCounter": boot_counter})
    assert data == expected
    assert SHIPPED.decode_heartbeat(message_of(data, 0x701)) == Heartbeat(state, boot_counter)


@given(st.floats(-32, 32), st.booleans(), st.integers(0, 15))
def test_a_command_arrives_within_half_a_quantum(effort: float, enable: bool, counter: int) -> None:
    command = SHIPPED.decode_command(message_of(SHIPPED.encode_command(effort, enable, counter), 0x201))
    assert abs(command.effort - effort) <= 0.0005 * (1 + 1e-9)
    assert command[1:] == (enable, counter)


@pytest.mark.parametrize("effort", [math.nan, math.inf, -math.inf])
def test_effort_that_is_not_finite_is_not_encoded(effort: float) -> None:
    with pytest.raises(ValueError, match="must be finite"):
        SHIPPED.encode_command(effort, enable=True, counter=0)


# Rejected frames ----------------------------------------------------------------------------------------------------

GOOD = SHIPPED.encode_feedback(Feedback(12.5, 3, enabled=True, fault=False, fault_code=0))


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (message_of(GOOD, is_error_frame=True), "error_frame"),
        (message_of(b"", is_remote_frame=True, dlc=8), "remote"),
        (message_of(GOOD, is_fd=True), "fd"),
        (message_of(GOOD, is_extended_id=True), "extended"),
        (message_of(GOOD, 0x182), "identifier"),
        (message_of(GOOD[:7]), "length"),
        (message_of(GOOD + b"\0"), "length"),
        (message_of(b""), "length"),
        (message_of(GOOD[:7] + bytes((GOOD[7] ^ 1,))), "checksum"),
    ],
)
def test_a_wrong_frame_is_rejected_with_its_reason_and_bytes(message: can.Message, reason: str) -> None:
    with pytest.raises(FrameRejected) as caught:
        SHIPPED.decode_feedback(message)
    assert caught.value.reason == reason
    assert f"[{message.data.hex(' ')}] rejected ({reason})" in str(caught.value)


def test_on_a_can_fd_bus_a_classic_frame_is_the_wrong_one() -> None:
    profile = DriveProfile.compile(ProtocolSettings(), Path(), "mm", fd=True)
    assert profile.decode_feedback(message_of(GOOD, is_fd=True)).position == 12.5
    with pytest.raises(FrameRejected, match="is a classic frame, a CAN FD frame is expected") as caught:
        profile.decode_feedback(message_of(GOOD))
    assert caught.value.reason == "fd"


def test_effort_beyond_the_limits_of_the_dbc_is_a_reserved_value() -> None:
    covered = (32001).to_bytes(2, "little") + b"\x01"
    with pytest.raises(FrameRejected, match="raw value 32001 is outside -32000 to 32000") as caught:
        SHIPPED.decode_command(message_of(covered + bytes((crc8_j1850(0x201, covered),)), 0x201))
    assert caught.value.reason == "reserved_value"


def test_a_position_beyond_the_limits_of_the_dbc_is_a_reserved_value(folder: Path) -> None:
    profile = DriveProfile.compile(other_settings(), folder, "mm")
    frame = (100_000_001).to_bytes(4, "big") + bytes(4)
    with pytest.raises(FrameRejected, match=r"\[05 f5 e1 01 00 00 00 00\] rejected \(reserved_value\)"):
        profile.decode_feedback(message_of(frame, 0x18FF0002, is_extended_id=True))


def test_a_boot_counter_beyond_its_limits_is_a_reserved_value(folder: Path) -> None:
    text = DBC.read_text(encoding="cp1252").replace("8|8@1+ (1,0) [0|255]", "8|8@1+ (1,0) [0|250]")
    (folder / "limited.dbc").write_text(text, encoding="cp1252")
    profile = DriveProfile.compile(shipped_settings(dbc="limited.dbc"), folder, "mm")
    with pytest.raises(FrameRejected) as caught:
        profile.decode_heartbeat(message_of(b"\x01\xfb", 0x701))
    assert caught.value.reason == "reserved_value"


def test_what_a_feedback_leaves_out_is_sent_as_zero() -> None:
    data = SHIPPED.encode_feedback(Feedback(0.001, None, None, None, None))
    assert data[:7] == bytes((1, 0, 0, 0, 0, 0, 0))


def test_a_state_outside_limits_or_value_table_is_a_reserved_value(folder: Path) -> None:
    text = DBC.read_text(encoding="cp1252").replace(' 7 "Switch on disabled"', "")
    (folder / "seven.dbc").write_text(text, encoding="cp1252")
    profile = DriveProfile.compile(shipped_settings(dbc="seven.dbc"), folder, "mm")
    assert profile.decode_heartbeat(message_of(b"\x06\x00", 0x701)).state == 6
    for state, detail in ((7, "state 7 is not in the DBC's value table"), (8, "raw value 8 is outside 0 to 7")):
        with pytest.raises(FrameRejected, match=detail) as caught:
            profile.decode_heartbeat(message_of(bytes((state, 0)), 0x701))
        assert caught.value.reason == "reserved_value"


@pytest.mark.parametrize("identifier", [0x181, 0x281])
def test_the_reserved_position_is_rejected(identifier: int) -> None:
    length, decode = (7, SHIPPED.decode_feedback) if identifier == 0x181 else (5, SHIPPED.decode_index)
    covered = bytes.fromhex("00000080").ljust(length, b"\0")
    with pytest.raises(FrameRejected, match="raw value -2147483648 is outside") as caught:
        decode(message_of(covered + bytes((crc8_j1850(identifier, covered),)), identifier))
    assert caught.value.reason == "reserved_value"


@pytest.mark.parametrize(("fault_code", "kind"), [(250, PositionRejected), (251, FrameRejected)])
def test_a_frame_without_a_position_is_heard_only_if_the_rest_of_it_makes_sense(
    folder: Path, fault_code: int, kind: type[FrameRejected]
) -> None:
    text = DBC.read_text(encoding="cp1252").replace(
        "FaultCode : 40|8@1+ (1,0) [0|255]", "FaultCode : 40|8@1+ (1,0) [0|250]"
    )
    (folder / "limited.dbc").write_text(text, encoding="cp1252")
    profile = DriveProfile.compile(shipped_settings(dbc="limited.dbc"), folder, "mm")
    covered = bytes.fromhex("0000008002") + bytes((fault_code, 0))
    with pytest.raises(FrameRejected) as caught:
        profile.decode_feedback(message_of(covered + bytes((crc8_j1850(0x181, covered),))))
    assert (type(caught.value), caught.value.reason) == (kind, "reserved_value")
    if isinstance(caught.value, PositionRejected):
        heard = caught.value.feedback
        assert (math.isnan(heard.position), heard.fault, heard.fault_code) == (True, True, fault_code)


@given(
    data=st.binary(max_size=12),
    identifier=st.sampled_from([0x181, 0x201, 0x281, 0x701, 0x18FF0001]),
    is_error_frame=st.booleans(),
    is_remote_frame=st.booleans(),
    is_fd=st.booleans(),
    is_extended_id=st.booleans(),
)
def test_whatever_arrives_decodes_or_is_rejected(data: bytes, identifier: int, **kind: bool) -> None:
    message = message_of(b"" if kind["is_remote_frame"] else data, identifier, **kind)
    for decode in (SHIPPED.decode_feedback, SHIPPED.decode_command, SHIPPED.decode_index, SHIPPED.decode_heartbeat):
        with contextlib.suppress(FrameRejected):
            values = decode(message)
            assert not any(kind.values())
            assert all(math.isfinite(value) for value in values if value is not None)


@given(data=st.binary(min_size=8, max_size=8), flip=st.integers(0, 63))
def test_a_flipped_bit_never_gets_through(data: bytes, flip: int) -> None:
    assume(data[:4] != b"\0\0\0\x80")
    good = data[:7] + bytes((crc8_j1850(0x181, data[:7]),))
    assert math.isfinite(SHIPPED.decode_feedback(message_of(good)).position)
    bad = (int.from_bytes(good, "little") ^ 1 << flip).to_bytes(8, "little")
    with pytest.raises(FrameRejected, match="checksum"):
        SHIPPED.decode_feedback(message_of(bad))


# Another drive ------------------------------------------------------------------------------------------------------


def test_another_drive_is_described_by_its_dbc_and_the_settings(folder: Path) -> None:
    profile = DriveProfile.compile(other_settings(), folder, "mm")
    assert profile.command_id == Identifier(0x18FF0001, extended=True)
    assert profile.heartbeat_id is None
    assert (profile.traits.counter_modulus, profile.command_counter_modulus) == (14, 1)
    assert (profile.traits.effort_quantum, profile.traits.effort_limit, profile.traits.position_quantum) == (
        0.0,
        50.0,
        0.005,
    )

    data = profile.encode_command(12.25, enable=True, counter=99)
    # 12.25 is 0x41440000; Mode 4; On = 01 in the two highest bits of byte 6.
    assert data[1:] == bytes.fromhex("41440000 04 40 00")
    assert data[0] == sum8(0, data[1:])
    received = profile.decode_command(message_of(data, 0x18FF0001, is_extended_id=True))
    assert received == Command(12.25, enable=True, counter=None)

    frame = bytes.fromhex("ffffff9c 07 0d 00 00")  # -100 * 0.01 deg * -0.5 = 0.5; Error 7; Cycle 13
    feedback = profile.decode_feedback(message_of(frame, 0x18FF0002, is_extended_id=True))
    assert feedback == Feedback(0.5, 13, enabled=None, fault=None, fault_code=7, command_timeout=None)
    assert profile.encode_feedback(feedback) == frame
    assert profile.encode_feedback(feedback._replace(counter=14))[5] == 0


def test_nan_effort_in_a_float_signal_is_rejected(folder: Path) -> None:
    profile = DriveProfile.compile(other_settings(), folder, "mm")
    covered = bytes.fromhex("7fc00000 04 40 00")
    message = message_of(bytes((sum8(0, covered),)) + covered, 0x18FF0001, is_extended_id=True)
    with pytest.raises(FrameRejected) as caught:
        profile.decode_command(message)
    assert caught.value.reason == "not_finite"


def test_a_drive_without_heartbeat_has_none_to_decode_or_encode(folder: Path) -> None:
    profile = DriveProfile.compile(other_settings(), folder, "mm")
    message = message_of(b"\0\0", 0x701)
    with pytest.raises(FrameRejected, match="no heartbeat"):
        profile.decode_heartbeat(message)
    with pytest.raises(ValueError, match="no heartbeat"):
        profile.encode_heartbeat(Heartbeat(0, 0))


def test_a_drive_without_index_has_none_to_decode_or_encode(folder: Path) -> None:
    profile = DriveProfile.compile(other_settings(), folder, "mm")
    message = message_of(bytes(6), 0x281)
    assert (profile.index_id, profile.index_counter_modulus) == (None, 1)
    with pytest.raises(FrameRejected, match="no index message"):
        profile.decode_index(message)
    with pytest.raises(ValueError, match="no index message"):
        profile.encode_index(IndexMark(0.0, 0))


def test_the_index_of_another_drive_has_the_scale_of_its_feedback(folder: Path) -> None:
    index = {"message": "Mark", "position": "Latch", "counter": False, "checksum": False}
    profile = DriveProfile.compile(other_settings(index=index), folder, "mm")
    assert profile.index_id == Identifier(0x18FF0004, extended=True)
    frame = message_of(bytes.fromhex("ffffff9c"), 0x18FF0004, is_extended_id=True)
    assert profile.decode_index(frame) == IndexMark(0.5, None)
    assert profile.encode_index(IndexMark(0.5, 3)) == frame.data


def test_the_algorithm_is_the_one_that_the_settings_name() -> None:
    profile = DriveProfile.compile(shipped_settings(checksum="xor8"), Path(), "mm")
    data = profile.encode_command(1.0, enable=True, counter=1)
    assert data[3] == xor8(0, data[:3])
    with pytest.raises(FrameRejected, match="checksum"):
        SHIPPED.decode_command(message_of(data, 0x201))


def test_a_drive_may_have_no_checksum_at_all() -> None:
    settings = shipped_settings(
        checksum="none",
        feedback={"checksum": False},
        index={"checksum": False},
        command={"checksum": False, "constants": {"Checksum": 85.0}},
    )
    profile = DriveProfile.compile(settings, Path(), "mm")
    assert profile.encode_command(0.0, enable=False, counter=0) == bytes((0, 0, 0, 85))
    assert profile.decode_feedback(message_of(bytes(8))).position == 0.0


# Refused settings ---------------------------------------------------------------------------------------------------


def test_wrong_unit_is_refused_unless_a_scale_says_how_to_convert() -> None:
    with pytest.raises(ProtocolError, match="Position is in 'mm', the axis in 'rad'") as caught:
        DriveProfile.compile(ProtocolSettings(), Path(), "rad")
    assert caught.value.key == ("axis", "unit")
    settings = shipped_settings(feedback={"position_scale": 0.001})
    assert DriveProfile.compile(settings, Path(), "m").traits.position_quantum == pytest.approx(1e-6)


@pytest.mark.parametrize(
    ("changes", "key", "text"),
    [
        ({"feedback": {"message": "DriveFedback"}}, "feedback.message", "Did you mean 'DriveFeedback'"),
        ({"feedback": {"position": "Postion"}}, "feedback.position", "Did you mean 'Position'"),
        ({"feedback": {"fault": "Faulty"}}, "feedback.fault", "has no signal 'Faulty'"),
        (
            {"feedback": {"position": "FaultCode", "fault_code": False, "enabled": "Position"}},
            "feedback.enabled",
            "must be an unsigned integer",
        ),
        ({"feedback": {"fault": "Enabled"}}, "feedback.fault", "used for two purposes"),
        ({"feedback": {"checksum": "AliveCounter"}}, "feedback.checksum", "one whole byte"),
        ({"command": {"effort": "Efort"}}, "command.effort", "Did you mean 'Effort'"),
        ({"command": {"effort": "Enable", "enable": False}}, "command.effort", "effort of both signs"),
        ({"command": {"counter": False}}, "command.constants", "there is no value to send in AliveCounter"),
        ({"command": {"constants": {"Mode": 1.0}}}, "command.constants.Mode", "has no signal 'Mode'"),
        ({"command": {"constants": {"Enable": 1.0}}}, "command.constants.Enable", "used for two purposes"),
        (
            {"command": {"counter": False, "constants": {"AliveCounter": 16.0}}},
            "command.constants.AliveCounter",
            "outside 0 to 15",
        ),
        ({"command": {"message": "DriveFeedback", "effort": "Position"}}, "command.enable", "has no signal 'Enable'"),
        ({"heartbeat": {"message": "Heart"}}, "heartbeat.message", "has no message 'Heart'"),
        ({"heartbeat": {"state": "Stat"}}, "heartbeat.state", "Did you mean 'State'"),
        (
            {"heartbeat": {"message": "DriveFeedback", "state": "FaultCode", "boot_counter": False}},
            "",
            "must be different messages",
        ),
        ({"checksum": "none"}, "feedback.checksum", "protocol.checksum is 'none', but feedback.checksum names"),
        ({"checksum": "none", "feedback": {"checksum": False}}, "command.checksum", "command.checksum names a signal"),
        (
            {"checksum": "none", "feedback": {"checksum": False}, "command": {"checksum": False}},
            "index.checksum",
            "set index.message to false",
        ),
        (
            {
                "feedback": {"checksum": False},
                "command": {"checksum": False, "constants": {"Checksum": 0.0}},
                "index": {"checksum": False},
            },
            "checksum",
            "neither feedback.checksum nor command.checksum nor index.checksum",
        ),
        ({"feedback": {"home_switch": "Home"}}, "feedback.home_switch", "Did you mean 'HomeSwitch'"),
        ({"index": {"message": "DriveIndx"}}, "index.message", "Did you mean 'DriveIndex'"),
        ({"index": {"counter": "Position"}}, "index.counter", "used for two purposes"),
        ({"index": {"position": "AliveCounter", "counter": False}}, "index.position", "its wrap period is 16, that"),
        ({"dbc": "inch.dbc"}, "index.position", "its unit is in, that of the feedback's position mm"),
        (
            {"dbc": "narrow.dbc"},
            "index.position",
            "its wrap period is 65.536, that of the feedback's position 4294967.296",
        ),
        ({"dbc": "absent.dbc"}, "dbc", "cannot read the DBC file"),
        ({"dbc": "broken.dbc"}, "dbc", "cannot read the DBC file"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_key_to_change(
    changes: dict[str, Any], key: str, text: str, tmp_path: Path
) -> None:
    (tmp_path / "broken.dbc").write_text("BO_ nonsense")
    before, latched, after = DBC.read_text(encoding="cp1252").partition("BO_ 641 DriveIndex")
    narrow = after.replace("0|32@1- (0.001,0) [-2147483.647|2147483.647]", "0|16@1- (0.001,0) [-32.768|32.767]", 1)
    (tmp_path / "narrow.dbc").write_text(before + latched + narrow, encoding="cp1252")
    (tmp_path / "inch.dbc").write_text(before + latched + after.replace('"mm"', '"in"', 1), encoding="cp1252")
    with pytest.raises(ProtocolError) as caught:
        DriveProfile.compile(shipped_settings(**changes), tmp_path, "mm")
    assert caught.value.key == ("protocol", *(key.split(".") if key else []))
    assert text in str(caught.value)


def test_multiplexed_feedback_is_refused(folder: Path) -> None:
    changes = {"message": "Paged", "fault_code": False, "counter": False}
    with pytest.raises(ProtocolError, match="multiplexed") as caught:
        DriveProfile.compile(other_settings(feedback=changes), folder, "mm")
    assert caught.value.key == ("protocol", "feedback", "position")


def test_an_effort_that_cannot_be_zero_is_refused(folder: Path) -> None:
    shifted = DBC.read_text(encoding="cp1252").replace("Effort : 0|16@1- (0.001,0)", "Effort : 0|16@1- (0.001,0.0005)")
    (folder / "shifted.dbc").write_text(shifted, encoding="cp1252")
    with pytest.raises(ProtocolError, match="cannot represent 0 exactly") as caught:
        DriveProfile.compile(shipped_settings(dbc="shifted.dbc"), folder, "mm")
    assert caught.value.key == ("protocol", "command", "effort")


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_position_scale_is_finite_and_not_zero(value: float) -> None:
    with pytest.raises(ValueError, match="position_scale"):
        shipped_settings(feedback={"position_scale": value})


def test_a_role_is_a_name_or_false_never_true() -> None:
    with pytest.raises(ValueError, match=r"feedback\.fault"):
        shipped_settings(feedback={"fault": True})
