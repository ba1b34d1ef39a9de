import math
import struct
from typing import Any

import pytest
from cantools.database import load_string
from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import assume, given, reject
from hypothesis import strategies as st

from twostage_servo.drives.dbc.message_codec import MessageCodec
from twostage_servo.drives.dbc.signal_codec import UndecodableValue

FLOAT_FORMATS = {16: "e", 32: "f", 64: "d"}


def database_of(*signals: Signal, length: int = 8, name: str = "M") -> Database:
    message = Message(frame_id=0x123, name=name, length=length, signals=list(signals), strict=False)
    return Database(messages=[message], strict=False)


def codec_of(*signals: Signal, length: int = 8) -> MessageCodec:
    return MessageCodec(database_of(*signals, length=length), "M", "test.dbc")


def signal(
    name: str = "S", start: int = 0, length: int = 8, scale: float = 1, offset: float = 0, **kwargs: Any
) -> Signal:
    conversion = BaseConversion.factory(scale=scale, offset=offset, is_float=kwargs.pop("is_float", False))
    return Signal(name, start, length, conversion=conversion, **kwargs)


def network_order(position: int) -> int:
    """DBC number of the bit at ``position`` of the big-endian sequence 7 6 .. 0, 15 14 .. 8, ..."""
    return position // 8 * 8 + 7 - position % 8


@st.composite
def layouts(draw: st.DrawFn) -> list[Signal]:
    """Signals of either byte order, any alignment, none overlapping another: claimed bit by bit from a free frame."""
    free = set(range(64))
    signals: list[Signal] = []
    for index in range(draw(st.integers(1, 6))):
        is_float = draw(st.booleans())
        length = draw(st.sampled_from([16, 32, 64])) if is_float else draw(st.integers(1, 40))
        big = draw(st.booleans())
        first = draw(st.integers(0, 64 - length))
        bits = [network_order(first + i) for i in range(length)] if big else list(range(first, first + length))
        if not free.issuperset(bits):
            continue
        free.difference_update(bits)
        signals.append(
            signal(
                f"S{index}",
                bits[0],
                length,
                draw(st.sampled_from([1, 2, 0.5, 0.001, 0.1, -0.25, 1e-4, 3.7])),
                draw(st.sampled_from([0, -40, 0.5, 1000])),
                is_float=is_float,
                is_signed=not is_float and draw(st.booleans()),
                byte_order="big_endian" if big else "little_endian",
            )
        )
    assume(signals)
    return signals


def decoded_by_cantools(signals: list[Signal], data: bytes) -> dict[str, float]:
    decoded = database_of(*signals).messages[0].decode(data, decode_choices=False)
    assert isinstance(decoded, dict)
    return {name: value for name, value in decoded.items() if isinstance(value, (int, float))}


@given(layouts(), st.binary(min_size=8, max_size=8))
def test_any_layout_decodes_as_cantools_decodes_it(signals: list[Signal], data: bytes) -> None:
    expected = decoded_by_cantools(signals, data)
    codec = codec_of(*signals)
    for one in signals:
        value = expected[one.name]
        decode = codec.quantity(one.name).decode
        if math.isfinite(value):
            assert decode(codec.word(data)) == value
        else:
            with pytest.raises(UndecodableValue) as caught:
                decode(codec.word(data))
            assert caught.value.reason == "not_finite"


@given(layouts(), st.binary(min_size=8, max_size=8))
def test_any_layout_encodes_as_cantools_encodes_it(signals: list[Signal], data: bytes) -> None:
    decoded = decoded_by_cantools(signals, data)
    values = {name: value if math.isfinite(value) else 1.0 for name, value in decoded.items()}
    codec = codec_of(*signals)
    word = 0
    for name, value in values.items():
        word |= codec.quantity(name).encode(value)
    try:
        expected = database_of(*signals).messages[0].encode(values, strict=False)
    except OverflowError:  # a rounding beyond the largest float: cantools gives up where the codec saturates
        reject()
    assert codec.data(word) == expected


@given(
    length=st.integers(2, 32),
    is_signed=st.booleans(),
    scale=st.sampled_from([1, 0.001, 0.1, -0.5, 25]),
    offset=st.sampled_from([0, 7.5, -100]),
    value=st.floats(allow_nan=False, allow_infinity=False),
)
def test_encoding_goes_to_the_nearest_step_or_saturates(
    length: int, is_signed: bool, scale: float, offset: float, value: float
) -> None:
    codec = codec_of(signal(length=length, scale=scale, offset=offset, is_signed=is_signed)).quantity("S")
    sent = codec.decode(codec.encode(value))
    nearest = min(max(value, codec.minimum), codec.maximum)
    assert codec.minimum <= sent <= codec.maximum
    assert abs(sent - nearest) <= codec.quantum * (0.5 + 1e-6)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("is_float", [False, True])
def test_a_value_that_is_not_finite_is_not_sent(value: float, is_float: bool) -> None:
    codec = codec_of(signal(length=32, is_float=is_float)).quantity("S")
    with pytest.raises(ValueError, match=r"test\.dbc, message M, signal S: cannot send (nan|inf|-inf), .* finite"):
        codec.encode(value)


@pytest.mark.parametrize(
    ("scale", "minimum", "maximum", "lowest", "highest"),
    [
        (0.001, -32, 32, -32000, 32000),
        (-0.001, -32, 32, -32000, 32000),
        (0.1, -0.3, 0.3, -3, 3),  # 0.3 / 0.1 is 2.9999999999999996 in floats
        (0.1, None, 0.35, -32768, 3),
        (1, -1e9, 1e9, -32768, 32767),
    ],
)
def test_dbc_limits_bound_both_ways(
    scale: float, minimum: float | None, maximum: float | None, lowest: int, highest: int
) -> None:
    one = signal(length=16, scale=scale, is_signed=True, minimum=minimum, maximum=maximum)
    codec = codec_of(one).quantity("S")
    low, high = (lowest, highest) if scale > 0 else (highest, lowest)
    assert struct.unpack("<h", codec.encode(-1e12).to_bytes(2, "little")) == (low,)
    assert struct.unpack("<h", codec.encode(1e12).to_bytes(2, "little")) == (high,)
    for raw in (lowest - 1, highest + 1):
        if -32768 <= raw <= 32767:
            with pytest.raises(UndecodableValue) as caught:
                codec.decode(raw & 0xFFFF)
            assert caught.value.reason == "reserved_value"
    assert codec.decode(highest) == highest * scale


@pytest.mark.parametrize("length", [16, 32, 64])
def test_a_float_saturates_at_its_largest_finite_value(length: int) -> None:
    codec = codec_of(signal(length=length, is_float=True)).quantity("S")
    largest = struct.unpack("<" + FLOAT_FORMATS[length], codec.encode(1.79e308).to_bytes(length // 8, "little"))[0]
    assert math.isfinite(largest)
    assert largest == codec.maximum or length == 64
    assert codec.maximum == {16: 65504.0, 32: 3.4028234663852886e38, 64: 1.7976931348623157e308}[length]


def test_a_float_that_its_scale_makes_infinite_is_rejected() -> None:
    codec = codec_of(signal(length=64, is_float=True, scale=10)).quantity("S")
    with pytest.raises(UndecodableValue) as caught:
        codec.decode(int.from_bytes(struct.pack("<d", 1e308), "little"))
    assert caught.value.reason == "not_finite"


def test_a_float_keeps_to_limits_that_it_cannot_hold_exactly() -> None:
    codec = codec_of(signal(length=32, is_float=True, minimum=-0.1, maximum=0.1)).quantity("S")
    bits = codec.encode(5.0)
    assert codec.decode(bits) == struct.unpack("<f", struct.pack("<f", 0.1))[0]
    with pytest.raises(UndecodableValue, match="outside"):
        codec.decode(bits + 1)


def test_factor_changes_unit_and_quantum() -> None:
    codec = codec_of(signal(length=16, is_signed=True, scale=0.5, offset=3)).quantity("S", -2.0)
    assert (codec.quantum, codec.minimum, codec.maximum) == (1.0, -32773.0, 32762.0)
    assert codec.decode(codec.encode(-10.0)) == -10.0
    assert codec.decode(2) == -8.0  # (2 * 0.5 + 3) * -2


def test_a_flag_of_two_bits_knows_neither_2_nor_3() -> None:
    codec = codec_of(signal(start=5, length=2)).flag("S")
    assert [codec.decode(raw << 5) for raw in (0, 1)] == [False, True]
    assert [codec.encode(value) for value in (False, True)] == [0, 1 << 5]
    for raw in (2, 3):
        with pytest.raises(UndecodableValue, match="neither 0 nor 1"):
            codec.decode(raw << 5)


def test_a_flag_that_can_only_be_no_is_refused() -> None:
    with pytest.raises(ValueError, match="exclude 1"):
        codec_of(signal(length=2, minimum=0, maximum=0.5)).flag("S")


def test_a_count_may_end_before_its_bits_do() -> None:
    codec = codec_of(signal(length=4, minimum=0, maximum=14)).count("S")
    assert codec.maximum == 14
    assert codec.decode(14) == 14
    with pytest.raises(UndecodableValue):
        codec.decode(15)


@pytest.mark.parametrize(
    "unfit",
    [
        signal(is_signed=True),
        signal(scale=2),
        signal(offset=1),
        signal(length=32, is_float=True),
        signal(minimum=1, maximum=15),
    ],
    ids=["signed", "scale", "offset", "float", "minimum"],
)
def test_a_count_is_a_plain_unsigned_integer(unfit: Signal) -> None:
    with pytest.raises(ValueError, match=r"signal S: must be an unsigned integer that starts at 0"):
        codec_of(unfit).count("S")


@pytest.mark.parametrize(
    ("start", "order", "index"), [(24, "little_endian", 3), (0, "little_endian", 0), (31, "big_endian", 3)]
)
def test_a_whole_byte_is_found(start: int, order: Any, index: int) -> None:
    codec = codec_of(signal(start=start, byte_order=order))
    assert codec.byte_index("S") == index
    assert message_byte_set_by_cantools(signal(start=start, byte_order=order)) == index


def message_byte_set_by_cantools(one: Signal) -> int:
    return bytes(database_of(one).messages[0].encode({"S": 0xFF})).index(0xFF)


@pytest.mark.parametrize(
    "unfit",
    [signal(start=4), signal(length=7), signal(length=16), signal(start=24, byte_order="big_endian")],
    ids=["not aligned", "7 bits", "16 bits", "big-endian, not aligned"],
)
def test_a_checksum_must_fill_a_byte(unfit: Signal) -> None:
    with pytest.raises(ValueError, match="must fill one whole byte"):
        codec_of(unfit).byte_index("S")


def test_a_checksum_needs_all_its_values() -> None:
    with pytest.raises(ValueError, match="all values from 0 to 255"):
        codec_of(signal(minimum=0, maximum=200)).byte_index("S")


def test_unknown_names_are_answered_with_those_that_exist() -> None:
    database = database_of(signal("Position"), name="DriveFeedback")
    with pytest.raises(ValueError, match=r"no message 'DriveFedback'. Its messages: DriveFeedback. Did you mean"):
        MessageCodec(database, "DriveFedback", "test.dbc")
    codec = MessageCodec(database, "DriveFeedback", "test.dbc")
    with pytest.raises(
        ValueError, match=r"test\.dbc, message DriveFeedback has no signal 'Pos'. Its signals: Position"
    ):
        codec.quantity("Pos")


def test_a_signal_serves_one_purpose() -> None:
    codec = codec_of(signal("A"), signal("B", 8))
    codec.quantity("A")
    assert codec.unused_signals == ["B"]
    with pytest.raises(ValueError, match="used for two purposes"):
        codec.flag("A")


def test_overlapping_signals_are_refused() -> None:
    with pytest.raises(ValueError, match="overlapping"):
        codec_of(signal("A", 0, 8), signal("B", 4, 8))


def test_a_signal_outside_its_message_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        codec_of(signal("A", 4, 8), length=1)


def test_multiplexed_signals_are_refused() -> None:
    database = load_string(
        'VERSION ""\nBU_: N\nBO_ 5 M: 8 N\n SG_ Page M : 0|8@1+ (1,0) [0|0] "" N\n'
        ' SG_ Paged m1 : 8|8@1+ (1,0) [0|0] "" N\n SG_ Plain : 16|8@1+ (1,0) [0|0] "" N\n',
        "dbc",
    )
    assert isinstance(database, Database)
    codec = MessageCodec(database, "M", "test.dbc")
    assert codec.quantity("Plain").maximum == 255
    for name in ("Page", "Paged"):
        with pytest.raises(ValueError, match=f"signal {name}: is multiplexed"):
            codec.quantity(name)


def test_a_message_for_can_fd_is_refused_on_a_classic_bus() -> None:
    with pytest.raises(ValueError, match=r"12 bytes need CAN FD.*set bus\.fd = true"):
        codec_of(signal(), length=12)


def test_a_can_fd_message_has_a_length_that_there_is() -> None:
    database = database_of(signal(), length=12)
    codec = MessageCodec(database, "M", "test.dbc", fd=True)
    word = int.from_bytes(bytes(range(12)), "little")
    assert codec.data(word) == bytes(range(12))
    assert codec.word(bytes(range(12))) == word
    with pytest.raises(ValueError, match="no CAN FD frame has 13 bytes"):
        MessageCodec(database_of(signal(), length=13), "M", "test.dbc", fd=True)


@pytest.mark.parametrize(
    ("unfit", "text"),
    [
        (signal(scale=0), "scale must not be 0"),
        (signal(minimum=300, maximum=400), "allow no value"),
    ],
    ids=["scale 0", "empty range"],
)
def test_a_signal_without_values_is_refused(unfit: Signal, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        codec_of(unfit).quantity("S")


@pytest.mark.parametrize(
    ("scale", "offset"),
    [
        (0.0, 0.0),
        (math.nan, 0.0),
        (math.inf, 0.0),
        (1e308, 0.0),
        (-2e9, 0.0),
        (1.0, math.nan),
        (1.0, math.inf),
        (1.0, -1e10),
    ],
)
def test_a_scale_or_offset_that_no_drive_has_is_refused_before_anything_runs(scale: float, offset: float) -> None:
    with pytest.raises(ValueError, match=r"scale .* and offset .* must be finite and at most 1e\+09 in magnitude"):
        codec_of(signal(scale=scale, offset=offset)).quantity("S")


def test_a_unit_that_makes_the_range_infinite_is_refused() -> None:
    with pytest.raises(ValueError, match="not finite"):
        codec_of(signal(scale=1e9)).quantity("S", factor=1e300)
