"""What a frame means by its DBC alone, without the package's codec: the raw values by cantools, the rest by hand."""

import math
import typing
from fractions import Fraction

import can
from cantools.database.can import Signal

from tools.fuzz.drives import Kind


def refusal(kind: Kind, message: can.Message) -> str | None:
    """Return why a frame is not to be used as a message of a kind, or None if it may be."""
    number, extended = kind.identifier
    if (
        message.is_error_frame
        or message.is_remote_frame
        or message.is_fd != kind.fd
        or message.is_extended_id != extended
        or message.arbitration_id != number
        or len(message.data) != kind.message.length
    ):
        return "shape"
    data = bytes(message.data)
    if kind.checksum is not None:
        name, index = kind.checksum
        if data[index] != _checksum(name, number, data[:index] + data[index + 1 :]):
            return "checksum"
    raw = kind.message.decode(data, decode_choices=False, scaling=False)
    assert isinstance(raw, dict)  # noqa: S101 - no containers
    hints = typing.get_type_hints(kind.record)
    for role, name in kind.signals.items():
        value = raw[name]
        assert isinstance(value, (int, float))  # noqa: S101 - no choices
        signal = kind.message.get_signal_by_name(name)
        is_flag = "bool" in str(hints[role])
        is_state = kind.name == "heartbeat" and role == "state"
        if not _within_limits(signal, value) or (is_flag and value not in {0, 1}):
            return name
        if role == "position" and not abs(float(value) * float(signal.scale) + float(signal.offset)) <= kind.largest:
            return name
        if is_state and signal.choices and int(value) not in {int(choice) for choice in signal.choices}:
            return name
    return None


def _within_limits(signal: Signal, raw: float) -> bool:
    if not math.isfinite(raw):
        return False
    physical = Fraction(raw) * Fraction(str(signal.scale)) + Fraction(str(signal.offset))
    # [0|0] stands for "no limits" in a DBC, and cantools gives None for it.
    low = None if signal.minimum is None else Fraction(str(signal.minimum))
    high = None if signal.maximum is None else Fraction(str(signal.maximum))
    return (low is None or physical >= low) and (high is None or physical <= high)


def _checksum(name: str, number: int, data: bytes) -> int:
    if name == "xor8":
        value = 0
        for byte in data:
            value ^= byte
        return value
    if name == "sum8":
        return sum(data) % 256
    crc = 0xFF
    for byte in bytes((number & 0xFF, number >> 8 & 0xFF)) + data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
    return crc ^ 0xFF
