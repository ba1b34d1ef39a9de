from functools import reduce
from operator import xor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.drives.dbc.checksum import CHECKSUMS, crc8_j1850, sum8, xor8

BYTES = st.binary(max_size=8)
IDENTIFIERS = st.integers(0, 0x1FFFFFFF)


def crc8_bit_by_bit(data: bytes) -> int:
    """SAE J1850 as a shift register: no table, no shared code."""
    register = 0xFF
    for byte in data:
        for bit in range(7, -1, -1):
            feedback = (register >> 7) ^ (byte >> bit & 1)
            register = (register << 1 & 0xFF) ^ (0x1D if feedback else 0)
    return register ^ 0xFF


def test_shift_register_gives_the_published_check_value() -> None:
    assert crc8_bit_by_bit(b"123456789") == 0x4B


def test_crc_gives_the_published_check_value_when_the_data_id_is_the_first_two_digits() -> None:
    assert crc8_j1850(int.from_bytes(b"12", "little"), b"3456789") == 0x4B


@pytest.mark.parametrize(
    ("data", "crc"),
    [
        ("00000000", 0x59),
        ("f20183", 0x37),
        ("0faa0055", 0x79),
        ("00ff5511", 0xB8),
        ("332255aabbccddeeff", 0xCB),
        ("926b55", 0x8C),
        ("ffffffff", 0x74),
    ],
)
def test_crc_gives_the_values_that_autosar_publishes(data: str, crc: int) -> None:
    """Specification of CRC routines, CRC8 (SAE J1850): its table of examples; the first two bytes are the data id."""
    content = bytes.fromhex(data)
    assert crc8_bit_by_bit(content) == crc
    assert crc8_j1850(int.from_bytes(content[:2], "little"), content[2:]) == crc


@given(IDENTIFIERS, BYTES)
def test_crc_covers_the_low_16_bits_of_the_identifier_and_the_data(identifier: int, data: bytes) -> None:
    assert crc8_j1850(identifier, data) == crc8_bit_by_bit((identifier & 0xFFFF).to_bytes(2, "little") + data)


@given(IDENTIFIERS, BYTES)
def test_crc_accepts_the_bytearray_of_a_message(identifier: int, data: bytes) -> None:
    assert crc8_j1850(identifier, bytearray(data)) == crc8_j1850(identifier, data)


@given(IDENTIFIERS, BYTES)
def test_xor8_and_sum8_cover_the_data_only(identifier: int, data: bytes) -> None:
    assert xor8(identifier, data) == reduce(xor, data, 0)
    assert sum8(identifier, data) == sum(data) % 256


@pytest.mark.parametrize("name", sorted(CHECKSUMS))
@given(data=st.binary(min_size=1, max_size=8), position=st.integers(0, 63))
def test_every_single_wrong_bit_is_found(name: str, data: bytes, position: int) -> None:
    checksum = CHECKSUMS[name]
    wrong = bytearray(data)
    wrong[position // 8 % len(data)] ^= 1 << position % 8
    assert checksum(0x181, wrong) != checksum(0x181, data)


def test_crc_finds_every_pair_of_wrong_bits_in_a_feedback_frame() -> None:
    data = bytes(range(7))
    right = crc8_j1850(0x181, data)
    word = int.from_bytes(data, "little")
    for first in range(56):
        for second in range(first):
            wrong = (word ^ 1 << first ^ 1 << second).to_bytes(7, "little")
            assert crc8_j1850(0x181, wrong) != right
