"""The eight-bit checksums of frames, by name."""

from collections.abc import Callable
from typing import Final, TypeAlias

from fastcrc.crc8 import sae_j1850

Checksum: TypeAlias = Callable[[int, bytes | bytearray], int]
"""``checksum(identifier, data without the checksum byte) -> 0..255``."""


def crc8_j1850(identifier: int, data: bytes | bytearray) -> int:
    """CRC-8 SAE J1850 over the data id and the data, in the manner of AUTOSAR E2E Profile 1.

    Polynomial 0x1D, initial value 0xFF, final XOR 0xFF, not reflected; its check value, over ``b"123456789"`` alone, is
    0x4B. The data id are two bytes, low byte first: a frame that turns up under another identifier fails.

    Parameters
    ----------
    identifier
        CAN identifier; of an extended one the low 16 bits count.
    data
        All data bytes of the frame but the checksum byte, in their order.

    Returns
    -------
    int
        The checksum byte.
    """
    return sae_j1850((identifier & 0xFFFF).to_bytes(2, "little") + data)


def xor8(identifier: int, data: bytes | bytearray) -> int:  # noqa: ARG001 - one signature for all
    """Exclusive or of the data bytes; the identifier is not covered.

    Any single wrong bit is found; two wrong bits in the same column, and bytes that changed places, are not.

    Parameters
    ----------
    identifier
        Not used.
    data
        All data bytes of the frame but the checksum byte.

    Returns
    -------
    int
        The checksum byte.
    """
    value = 0
    for byte in data:
        value ^= byte
    return value


def sum8(identifier: int, data: bytes | bytearray) -> int:  # noqa: ARG001 - one signature for all
    """Sum of the data bytes modulo 256; the identifier is not covered.

    Any single wrong bit is found; bytes that changed places are not.

    Parameters
    ----------
    identifier
        Not used.
    data
        All data bytes of the frame but the checksum byte.

    Returns
    -------
    int
        The checksum byte.
    """
    return sum(data) & 0xFF


CHECKSUMS: Final[dict[str, Checksum]] = {"crc8_j1850": crc8_j1850, "xor8": xor8, "sum8": sum8}
"""The algorithms that ``protocol.checksum`` can name."""
