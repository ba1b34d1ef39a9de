"""One signal of a DBC, compiled to functions between its physical value and its bits in the word of a frame.

Measured on a layout like the shipped feedback, checksum and tuple included: 1.1 µs to decode with shifts and masks,
0.7 µs with ``struct``, which needs byte-aligned signals. Not worth a second way.
"""

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Final

from cantools.database.can import Signal

_LARGEST: Final = 1e9
"""Of a scale or an offset: the largest position that an axis may have. What is beyond it is a slip of the DBC."""
_FLOAT_FORMATS: Final = {16: "<e", 32: "<f", 64: "<d"}
_LARGEST_FLOATS: Final = {16: 65504.0, 32: (2.0 - 2.0**-23) * 2.0**127, 64: (2.0 - 2.0**-52) * 2.0**1023}


class UndecodableValue(ValueError):  # noqa: N818 - not an error of the program: a finding about a frame
    """A signal's bits stand for no value.

    Attributes
    ----------
    reason : str
        ``"reserved_value"`` (beyond the limits of the DBC) or ``"not_finite"`` (NaN or infinity).
    """

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class SignalCodec:
    """One signal between the word and its physical value.

    Attributes
    ----------
    name, unit : str
        As in the DBC.
    quantum : float
        Step of the physical value; 0 for an IEEE float, whose step is not fixed.
    minimum, maximum : float
        Ends of the range that is sent and accepted: what the bits hold, within the limits of the DBC.
    choices : mapping of int to str
        The value table, raw value to text; empty when there is none.
    period : float
        Width of the raw range, in physical units, of a position that wraps; 0 for every other signal.
    decode : callable
        ``decode(word) -> value``; raises :class:`UndecodableValue`.
    encode : callable
        ``encode(value) -> bits at their place in the word``. Rounds to the nearest step, saturates at ``minimum`` and
        ``maximum``, raises ValueError when the value is not finite. A position differs, see :func:`position_codec`.
    """

    name: str
    unit: str
    quantum: float
    minimum: float
    maximum: float
    choices: Mapping[int, str]
    decode: Callable[[int], Any]
    encode: Callable[[float], int]
    period: float = 0.0


def quantity_codec(signal: Signal, shift: int, where: str, factor: float = 1) -> SignalCodec:
    """Compile a signal that carries a physical quantity.

    Parameters
    ----------
    signal
        The signal.
    shift
        Place of its least significant bit in the word.
    where
        Names file, message and signal in error texts.
    factor
        Multiplies the physical value of the DBC.

    Returns
    -------
    SignalCodec
        Of values in units of the DBC times ``factor``.

    Raises
    ------
    ValueError
        When scale, offset and limits leave no finite value.
    """
    lowest, highest = _raw_range(signal, where)
    scale, offset = _exact(signal.scale) * factor, _exact(signal.offset) * factor
    ends = [raw * scale + offset for raw in (lowest, highest)]
    mask = (1 << signal.length) - 1
    if signal.is_float:
        form, largest = _FLOAT_FORMATS[signal.length], _LARGEST_FLOATS[64]
        ends = [max(-largest, min(largest, end)) for end in ends]
        decode, encode = _float_codec(where, form, shift, mask, scale, offset, lowest, highest)
    elif all(map(math.isfinite, ends)):
        signed = signal.is_signed
        decode, encode = _integer_codec(where, shift, mask, signed, scale, offset, int(lowest), int(highest))
    else:
        raise ValueError(f"{where}: its range {ends} is not finite. Correct scale and offset in the DBC.")
    quantum = 0.0 if signal.is_float else abs(float(scale))
    choices = {int(raw): str(text) for raw, text in (signal.choices or {}).items()}
    return SignalCodec(signal.name, signal.unit or "", quantum, min(ends), max(ends), choices, decode, encode)


def position_codec(signal: Signal, shift: int, where: str, factor: float = 1) -> SignalCodec:
    """Compile a signal that carries a position: like :func:`quantity_codec`, but it wraps as an encoder does.

    An integer wraps when the limits of the DBC leave out no more than one of its raw values: an excluded one, at
    either end, is reserved for "position invalid". A position that falls on it is sent as its neighbour. With narrower
    limits there is no wrap: the position saturates.

    NaN and infinity are sent as the reserved raw value, by an IEEE float as NaN; a signal that holds neither raises
    ValueError. Parameters, return value and errors are those of :func:`quantity_codec`.
    """
    codec = quantity_codec(signal, shift, where, factor)
    if signal.is_float:
        form = _FLOAT_FORMATS[signal.length]
        invalid: int | None = int.from_bytes(struct.pack(form, math.nan), "little") << shift
        return replace(codec, encode=_or_invalid(codec.encode, invalid, where))
    lowest, highest = _raw_range(signal, where)
    modulus = 1 << signal.length
    first = -(modulus >> 1) if signal.is_signed else 0
    last = first + modulus - 1
    excluded = first if lowest > first else last if highest < last else None
    invalid = None if excluded is None else (excluded & modulus - 1) << shift
    if highest - lowest < modulus - 2:
        return replace(codec, encode=_or_invalid(codec.encode, invalid, where))
    scale, offset = _exact(signal.scale) * factor, _exact(signal.offset) * factor
    bottom, top = int(lowest), int(highest)

    def encode(value: float) -> int:
        raw = max(-_LARGEST_FLOATS[64], min(_LARGEST_FLOATS[64], (value - offset) / scale))
        wrapped = (round(raw) - first) % modulus + first
        return (max(bottom, min(top, wrapped)) & modulus - 1) << shift

    return replace(codec, encode=_or_invalid(encode, invalid, where), period=modulus * codec.quantum)


def count_codec(signal: Signal, shift: int, where: str) -> SignalCodec:
    """Compile a signal that carries a plain count: unsigned, scale 1, offset 0, from 0 on.

    Parameters and return value are those of :func:`quantity_codec`; the values are integers.

    Raises
    ------
    ValueError
        When the signal is of another kind.
    """
    lowest, highest = _raw_range(signal, where)
    if signal.is_float or signal.is_signed or signal.scale != 1 or signal.offset != 0 or lowest != 0:
        raise ValueError(
            f"{where}: must be an unsigned integer that starts at 0, with scale 1 and offset 0, but is "
            f"{'an IEEE float' if signal.is_float else 'signed' if signal.is_signed else 'unsigned'} with scale "
            f"{signal.scale}, offset {signal.offset} and limits [{signal.minimum}|{signal.maximum}]. "
            "Name another signal or correct the DBC."
        )
    codec, mask = quantity_codec(signal, shift, where), (1 << signal.length) - 1
    if highest < mask:
        return codec

    def decode(word: int) -> int:
        return word >> shift & mask

    return replace(codec, decode=decode)


def flag_codec(signal: Signal, shift: int, where: str) -> SignalCodec:
    """Compile a signal that says yes (1) or no (0). In a signal of several bits every other value is reserved.

    Parameters and return value are those of :func:`quantity_codec`; the values are booleans.

    Raises
    ------
    ValueError
        When :func:`count_codec` would refuse the signal, or its limits exclude 1.
    """
    codec = count_codec(signal, shift, where)
    if codec.maximum < 1:
        raise ValueError(f"{where}: its limits [{signal.minimum}|{signal.maximum}] exclude 1. Correct the DBC.")
    bit, other_bits = 1 << shift, (1 << signal.length) - 2 << shift

    def decode(word: int) -> bool:
        return word & bit != 0

    def decode_several_bits(word: int) -> bool:
        if word & other_bits:
            raise UndecodableValue("reserved_value", f"{where}: is neither 0 nor 1")
        return word & bit != 0

    def encode(value: float) -> int:
        return bit if value else 0

    return replace(codec, maximum=1.0, decode=decode_several_bits if other_bits else decode, encode=encode)


def _exact(number: float) -> float:
    """Turn 2.0 into 2: integer arithmetic stays exact."""
    return int(number) if abs(number) < 1 << 53 and number == int(number) else float(number)


def _raw_range(signal: Signal, where: str) -> tuple[float, float]:
    """Smallest and largest raw value: what the bits hold, within the limits of the DBC (as fractions, hence exact)."""
    if not 0.0 < abs(signal.scale) <= _LARGEST or not abs(signal.offset) <= _LARGEST:
        raise ValueError(
            f"{where}: scale {signal.scale:g} and offset {signal.offset:g} must be finite and at most {_LARGEST:g} in "
            "magnitude, and the scale must not be 0. Correct the DBC."
        )
    scale, offset = Fraction(str(signal.scale)), Fraction(str(signal.offset))
    limits = [
        None if limit is None else (Fraction(str(limit)) - offset) / scale for limit in (signal.minimum, signal.maximum)
    ]
    low, high = limits if scale > 0 else limits[::-1]
    if signal.is_float:
        form, largest = _FLOAT_FORMATS[signal.length], _LARGEST_FLOATS[signal.length]
        lowest: float = -largest if low is None else _nearest_float(form, low, largest)
        highest: float = largest if high is None else _nearest_float(form, high, largest)
    else:
        lowest = -(1 << signal.length - 1) if signal.is_signed else 0
        highest = lowest + (1 << signal.length) - 1
        lowest = lowest if low is None else max(lowest, math.ceil(low))
        highest = highest if high is None else min(highest, math.floor(high))
    if lowest > highest:
        raise ValueError(
            f"{where}: the limits [{signal.minimum}|{signal.maximum}] allow no value that its bits can represent. "
            "Correct the DBC."
        )
    return lowest, highest


def _or_invalid(encode: Callable[[float], int], invalid: int | None, where: str) -> Callable[[float], int]:
    """Encode what is not finite as ``invalid``."""

    def encode_any(value: float) -> int:
        if math.isfinite(value):
            return encode(value)
        if invalid is None:
            raise ValueError(f"{where}: cannot send {value}: it has no raw value for an invalid position")
        return invalid

    return encode_any


def _nearest_float(form: str, limit: Fraction, largest: float) -> float:
    within = largest if limit > largest else -largest if limit < -largest else float(limit)
    nearest: float = struct.unpack(form, struct.pack(form, within))[0]
    return nearest


def _integer_codec(
    where: str, shift: int, mask: int, is_signed: bool, scale: float, offset: float, lowest: int, highest: int
) -> tuple[Callable[[int], float], Callable[[float], int]]:
    # Two's complement: flipping the sign bit and subtracting it again extends the sign.
    sign = mask + 1 >> 1 if is_signed else 0

    def decode(word: int) -> float:
        raw = (word >> shift & mask ^ sign) - sign
        if lowest <= raw <= highest:
            return raw * scale + offset
        raise UndecodableValue("reserved_value", f"{where}: raw value {raw} is outside {lowest} to {highest}")

    def encode(value: float) -> int:
        if not math.isfinite(value):
            raise ValueError(f"{where}: cannot send {value}, a value must be finite")
        raw = (value - offset) / scale
        if raw >= highest:
            return (highest & mask) << shift
        if raw <= lowest:
            return (lowest & mask) << shift
        return (round(raw) & mask) << shift

    return decode, encode


def _float_codec(
    where: str, form: str, shift: int, mask: int, scale: float, offset: float, lowest: float, highest: float
) -> tuple[Callable[[int], float], Callable[[float], int]]:
    ieee = struct.Struct(form)

    def decode(word: int) -> float:
        raw: float = ieee.unpack((word >> shift & mask).to_bytes(ieee.size, "little"))[0]
        value = raw * scale + offset
        if not math.isfinite(value):
            raise UndecodableValue("not_finite", f"{where}: value is {value}")
        if not lowest <= raw <= highest:
            raise UndecodableValue("reserved_value", f"{where}: raw value {raw} is outside {lowest} to {highest}")
        return value

    def encode(value: float) -> int:
        if not math.isfinite(value):
            raise ValueError(f"{where}: cannot send {value}, a value must be finite")
        raw = min(max((value - offset) / scale, lowest), highest)
        return int.from_bytes(ieee.pack(raw), "little") << shift

    return decode, encode
