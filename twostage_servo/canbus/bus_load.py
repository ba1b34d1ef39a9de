"""How much of a classic CAN bus' time cyclic frames take at most, and how many frames a bus can carry in a time."""

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

FASTEST_BIT_RATE: Final = 1e6
"""Highest nominal bit rate of ISO 11898-2, bit/s: taken where nobody says which one a bus has."""
_SHORTEST_CLASSIC_BITS: Final = 47
"""No data and no stuff bit: g + 13 of :func:`frame_bits`, with 11 bits of identifier."""
_SHORTEST_FD_BITS: Final = 30
"""Of a CAN FD frame, the bits that have the nominal rate: 17 before the bit rate switch, 13 from the CRC delimiter to
the end of the intermission. Its data phase, up to eight times as fast, is taken for nothing."""


class CyclicFrame(NamedTuple):
    """A classic data frame that is sent again and again.

    Attributes
    ----------
    name
        What it is called in a report.
    data_bytes
        Length of its data, 0 to 8.
    extended
        Whether its identifier has 29 bits.
    period_s
        Time from one to the next, s.
    """

    name: str
    data_bytes: int
    extended: bool
    period_s: float


def frame_bits(data_bytes: int, *, extended: bool) -> int:
    """Return the largest number of bit times from the start of a frame to the earliest start of the next.

    By ISO 11898-1 a classic data frame of s bytes has g + 8 s bits that are subject to bit stuffing. With an identifier
    of 11 bits g = 34: start of frame 1, identifier 11, RTR 1, IDE 1, r0 1, DLC 4, CRC 15. With 29 bits g = 54: SRR 1,
    18 more of the identifier and r1 1 besides. Behind them come 13 that are not stuffed: CRC delimiter 1,
    acknowledgement 2, end of frame 7, intermission 3.

    A stuff bit follows five equal bits, and counts as the first of the next five: in the worst case the first one comes
    after five bits, each further one after four more, which makes ⌊(g + 8 s - 1) / 4⌋. So a frame with 8 bytes takes
    135 bits, or 160 with 29 bits of identifier.

    The formula is (1) of R. I. Davis, A. Burns, R. J. Bril and J. J. Lukkien, "Controller Area Network (CAN)
    schedulability analysis: refuted, revisited and revised", Real-Time Systems 35 (2007), 239-272. T. Nolte,
    H. Hansson, C. Norström and S. Punnekkat, "Using bit-stuffing distributions in CAN analysis" (IEEE/IEE Real-Time
    Embedded Systems Workshop, 2001) found real frames to be some 10 % shorter.

    Raises
    ------
    ValueError
        If a classic frame cannot have that many bytes.
    """
    if not 0 <= data_bytes <= 8:
        raise ValueError(f"{data_bytes} data bytes: a classic CAN frame has 0 to 8")
    stuffed = (54 if extended else 34) + 8 * data_bytes
    return stuffed + 13 + (stuffed - 1) // 4


def bus_load(frames: Iterable[CyclicFrame], bit_rate: float) -> float:
    """Return the share of the bus' time that the frames take at most; above 1 the bus cannot carry them.

    Parameters
    ----------
    frames
        Everything that is sent.
    bit_rate
        Nominal bit rate, bit/s.
    """
    return sum(frame_bits(one.data_bytes, extended=one.extended) / one.period_s for one in frames) / bit_rate


def most_frames(duration_s: float, bit_rate: float | None = None, *, fd: bool = False) -> int:
    """Return the largest number of frames that a bus can carry in a time, rounded up.

    Parameters
    ----------
    duration_s
        The time, s.
    bit_rate
        Nominal bit rate, bit/s; None for the highest that there is.
    fd
        Whether they are CAN FD frames.
    """
    shortest = _SHORTEST_FD_BITS if fd else _SHORTEST_CLASSIC_BITS
    return math.ceil(duration_s * (FASTEST_BIT_RATE if bit_rate is None else bit_rate) / shortest)
