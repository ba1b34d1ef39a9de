"""The recording: the last ticks in memory, kept when the axis trips."""

import math
import struct
from collections import deque
from collections.abc import Sequence
from typing import Final, overload

from twostage_servo.axis.state import State
from twostage_servo.telemetry.sample import FIELDS, TYPES, Sample

_FORMATS: Final = {int: "q", float: "d", float | None: "d", State: "B"}
_PACKED: Final = FIELDS[:-1]
"""All columns but the time, which follows from the tick."""
_LAYOUT: Final = struct.Struct("=" + "".join(_FORMATS[TYPES[name]] for name in _PACKED))
_STATES: Final = tuple(State)
_NUMBERS: Final = {state: number for number, state in enumerate(_STATES)}


class Recording(Sequence[Sample]):
    """Some ticks, oldest first; each is unpacked when it is asked for, so that a long recording costs nothing to keep.

    Parameters
    ----------
    packed
        The samples, packed by a :class:`Recorder`.
    period_s
        Length of a tick in s.
    """

    __slots__ = ("_packed", "_period_s")

    def __init__(self, packed: tuple[bytes, ...], period_s: float) -> None:
        self._packed = packed
        self._period_s = period_s

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self._packed)

    @overload
    def __getitem__(self, index: int) -> Sample: ...

    @overload
    def __getitem__(self, index: slice) -> "Recording": ...

    def __getitem__(self, index: int | slice) -> "Sample | Recording":
        """Return a tick, or the recording of a part of them."""
        if isinstance(index, slice):
            return Recording(self._packed[index], self._period_s)
        tick, missed, lateness_us, state, measured_position, *rest = _LAYOUT.unpack(self._packed[index])
        measured = None if math.isnan(measured_position) else measured_position
        return Sample._make((tick, missed, lateness_us, _STATES[state], measured, *rest, tick * self._period_s))


class Recorder:
    """A ring of the last `capacity` ticks. :meth:`keep` sets the ring of this moment aside.

    The ticks are packed: the collector of cyclic garbage looks at each tuple there is, which takes it 5 ms where a
    recording has 100 000 of them. At bytes it does not look.
    """

    __slots__ = ("_kept", "_period_s", "_ring")

    def __init__(self, capacity: int, period_s: float) -> None:
        self._period_s = period_s
        self._ring: deque[bytes] = deque(maxlen=capacity)
        self._kept: Recording | None = None

    def add(self, sample: Sample) -> None:
        """Append a tick; the oldest goes. A measured position that is no number is kept as none."""
        # Written out, since this is done for every axis on every tick.
        tick, missed, late_us, state, measured, position, velocity, disturbance, effort, target, speed, error, _ = (
            sample
        )
        if measured is None:
            measured = math.nan
        self._ring.append(
            _LAYOUT.pack(
                tick, missed, late_us, _NUMBERS[state], measured, position, velocity, disturbance, effort, target,
                speed, error,
            )
        )  # fmt: skip

    def keep(self) -> Recording:
        """Set the present ring aside, as the recording of a trip, and return it."""
        self._kept = Recording(tuple(self._ring), self._period_s)
        return self._kept

    def discard(self) -> None:
        """Forget what was kept."""
        self._kept = None

    def records(self) -> Recording:
        """Return the recording of the trip, or the last ticks if there is none."""
        return Recording(tuple(self._ring), self._period_s) if self._kept is None else self._kept
