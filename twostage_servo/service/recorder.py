"""The recording: the last ticks in memory, kept when the axis trips."""

from collections import deque
from typing import NamedTuple


class Record(NamedTuple):
    """One tick as the loop saw it; units are the axis' own, times in s and µs."""

    tick: int
    missed: int
    lateness_us: float
    state: str
    measured_position: float | None
    position: float
    velocity: float
    disturbance: float
    effort: float
    target: float
    speed_reference: float
    following_error: float


class Recorder:
    """A ring of the last `capacity` ticks. :meth:`keep` sets the ring of this moment aside."""

    __slots__ = ("_kept", "_ring")

    def __init__(self, capacity: int) -> None:
        self._ring: deque[Record] = deque(maxlen=capacity)
        self._kept: tuple[Record, ...] | None = None

    def add(self, record: Record) -> None:
        """Append a tick; the oldest goes."""
        self._ring.append(record)

    def keep(self) -> None:
        """Set the present ring aside, as the recording of a trip."""
        self._kept = tuple(self._ring)

    def discard(self) -> None:
        """Forget what was kept."""
        self._kept = None

    def records(self) -> tuple[Record, ...]:
        """Return the recording of the trip, or the last ticks if there is none."""
        return tuple(self._ring) if self._kept is None else self._kept
