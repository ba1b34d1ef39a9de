"""A position wraps as the encoder behind it does."""

import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drives.test_message_codec import codec_of, signal
from twostage_servo.drives.dbc.signal_codec import SignalCodec, UndecodableValue

SCALES = st.sampled_from([1, 0.001, 0.25, -0.5])
# Whole steps, which may be many turns of the widest signal: a float holds them exactly, and their product with a scale
# to a small fraction of a step.
STEPS = st.integers(-(2**40), 2**40)


def position(factor: float = 1, **kwargs: Any) -> SignalCodec:
    return codec_of(signal(**kwargs)).position("S", factor)


def two_complement(number: int, length: int) -> int:
    return number & (1 << length) - 1


@given(steps=STEPS, length=st.integers(2, 32), is_signed=st.booleans(), scale=SCALES)
def test_what_has_all_its_raw_values_wraps_like_a_counter(
    steps: int, length: int, is_signed: bool, scale: float
) -> None:
    codec = position(length=length, is_signed=is_signed, scale=scale)
    assert codec.encode(steps * scale) == two_complement(steps, length)
    assert codec.period == 2**length * abs(scale)


@given(steps=STEPS, length=st.integers(3, 32), scale=SCALES)
def test_the_reserved_lowest_value_is_never_sent_for_a_position(steps: int, length: int, scale: float) -> None:
    lowest = -(1 << length - 1)
    ends = sorted(((lowest + 1) * scale, (-lowest - 1) * scale))
    codec = position(length=length, is_signed=True, scale=scale, minimum=ends[0], maximum=ends[1])
    sent = codec.encode(steps * scale)
    expected = two_complement(steps, length)
    if expected == two_complement(lowest, length):
        expected += 1
    assert sent == expected
    assert codec.period == 2**length * abs(scale)
    assert codec.decode(sent) == codec.decode(expected)


def test_the_reserved_highest_value_of_an_unsigned_position_has_its_neighbour_sent() -> None:
    codec = position(length=16, minimum=0, maximum=65534)
    assert [codec.encode(value) for value in (65533, 65534, 65535, 65536, -1, -2)] == [
        65533, 65534, 65534, 0, 65534, 65534,
    ]  # fmt: skip
    assert codec.encode(math.nan) == 65535
    assert codec.period == 65536


@given(value=st.floats(allow_nan=False, allow_infinity=False), factor=st.sampled_from([1.0, -0.001, 3.0]))
def test_any_finite_position_is_sent_as_one_that_decodes(value: float, factor: float) -> None:
    codec = position(factor, length=16, is_signed=True, offset=7, minimum=-32760, maximum=32774)
    sent = codec.decode(codec.encode(value))
    if abs(value) < 1e9:
        turned_away = math.remainder(sent - value, codec.period)
        assert abs(turned_away) <= 1.5 * codec.quantum + 1e-6  # a step and a half: the neighbour of the reserved value


@given(value=st.floats(-1e12, 1e12))
def test_with_narrower_limits_there_is_no_wrap_but_an_end(value: float) -> None:
    codec = position(length=32, is_signed=True, scale=0.01, minimum=-5000, maximum=5000)
    assert codec.period == 0.0
    assert codec.decode(codec.encode(value)) == pytest.approx(min(max(value, -5000.0), 5000.0), abs=0.0051)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_position_is_sent_as_the_reserved_value_which_is_rejected(value: float) -> None:
    for codec in (
        position(length=32, is_signed=True, minimum=-(2**31) + 1, maximum=2**31 - 1),
        position(length=32, is_signed=True, minimum=-5000, maximum=5000),
        position(start=8, length=8, is_signed=False, minimum=1, maximum=255),
    ):
        with pytest.raises(UndecodableValue) as caught:
            codec.decode(codec.encode(value))
        assert caught.value.reason == "reserved_value"
    assert position(length=32, is_signed=True, minimum=-5000, maximum=5000).encode(value) == 0x80000000
    full = position(length=32, is_signed=True)
    with pytest.raises(ValueError, match="no raw value for an invalid position"):
        full.encode(value)


@pytest.mark.parametrize("length", [32, 64])
def test_a_float_position_neither_wraps_nor_hides_a_nan(length: int) -> None:
    codec = position(length=length, is_float=True)
    assert codec.period == 0.0
    assert codec.decode(codec.encode(1e9)) == 1e9
    bits = codec.encode(math.inf).to_bytes(length // 8, "little")
    assert math.isnan(struct.unpack({32: "<f", 64: "<d"}[length], bits)[0])
    with pytest.raises(UndecodableValue) as caught:
        codec.decode(codec.encode(math.nan))
    assert caught.value.reason == "not_finite"
