"""The recording: the last ticks in memory, kept when the axis trips."""

import math
import struct
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple, overload

from twostage_servo.axis.state import State


class Record(NamedTuple):
    """One tick as the loop saw it; units are the axis' own, times in s and µs."""

    tick: int
    missed: int
    lateness_us: float
    state: State
    measured_position: float | None
    position: float
    velocity: float
    disturbance: float
    effort: float
    target: float
    speed_reference: float
    following_error: float


_LAYOUT: Final = struct.Struct("=qqdB8d")
_STATES: Final = tuple(State)
_NUMBERS: Final = {state: number for number, state in enumerate(_STATES)}


class Recording(Sequence[Record]):
    """Some ticks, oldest first; each is unpacked when it is asked for, so that a long recording costs nothing to keep.

    Parameters
    ----------
    packed
        The records, packed by a :class:`Recorder`.
    """

    __slots__ = ("_packed",)

    def __init__(self, packed: tuple[bytes, ...]) -> None:
        self._packed = packed

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self._packed)

    @overload
    def __getitem__(self, index: int) -> Record: ...

    @overload
    def __getitem__(self, index: slice) -> "Recording": ...

    def __getitem__(self, index: int | slice) -> "Record | Recording":
        """Return a tick, or the recording of a part of them."""
        if isinstance(index, slice):
            return Recording(self._packed[index])
        tick, missed, lateness_us, state, measured_position, *rest = _LAYOUT.unpack(self._packed[index])
        measured = None if math.isnan(measured_position) else measured_position
        return Record(tick, missed, lateness_us, _STATES[state], measured, *rest)


class Recorder:
    """A ring of the last `capacity` ticks. :meth:`keep` sets the ring of this moment aside.

    The ticks are packed: the collector of cyclic garbage looks at each tuple there is, which takes it 5 ms where a
    recording has 100 000 of them. At bytes it does not look.
    """

    __slots__ = ("_kept", "_ring")

    def __init__(self, capacity: int) -> None:
        self._ring: deque[bytes] = deque(maxlen=capacity)
        self._kept: Recording | None = None

    def add(self, record: Record) -> None:
        """Append a tick; the oldest goes. A measured position that is no number is kept as none."""
        # Written out, since this is done for every axis on every tick.
        tick, missed, lateness_us, state, measured, position, velocity, disturbance, effort, target, speed, error = (
            record
        )
        if measured is None:
            measured = math.nan
        self._ring.append(
            _LAYOUT.pack(
                tick, missed, lateness_us, _NUMBERS[state], measured, position, velocity, disturbance, effort, target,
                speed, error,
            )
        )  # fmt: skip

    def keep(self) -> Recording:
        """Set the present ring aside, as the recording of a trip, and return it."""
        self._kept = Recording(tuple(self._ring))
        return self._kept

    def discard(self) -> None:
        """Forget what was kept."""
        self._kept = None

    def records(self) -> Recording:
        """Return the recording of the trip, or the last ticks if there is none."""
        return Recording(tuple(self._ring)) if self._kept is None else self._kept
