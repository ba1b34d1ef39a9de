"""Keeps the recording of each trip of an axis, in memory and as a file; the trip tells where that is."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

import structlog

from twostage_servo.api.fields import JsonObject
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.telemetry.sample import FIELDS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from twostage_servo.axis.trips import Trip, TripFile
    from twostage_servo.timing.ticks import Tick


class TripWriter(Protocol):
    """Writes trip files, and tells what becomes of each; never waits."""

    def write(
        self, axis: str, code: str, document: JsonObject, records: "Sequence[Sequence[Any]]", file: "TripFile"
    ) -> object:
        """Begin to write the file of an axis that has tripped."""

    def fail(self, axis: str, code: str, error: BaseException, file: "TripFile") -> None:
        """Tell that it could not be written, and why."""


class TripRecorder:
    """Looks at an axis after each tick, which has been recorded.

    Parameters
    ----------
    axis_loop
        The axis with its recorder.
    snapshot
        Makes what a trip's file says beside the recording.
    files
        Writes it; None: recordings stay in memory only.
    """

    def __init__(
        self, axis_loop: AxisLoop, snapshot: Callable[[AxisLoop], JsonObject], files: TripWriter | None
    ) -> None:
        self._axis_loop = axis_loop
        self._snapshot = snapshot
        self._files = files
        self._trip: Trip | None = None

    def publish(self, _: "Tick") -> None:
        """Keep the recording if the axis has tripped in this tick."""
        trip = self._axis_loop.axis.trip
        if trip is not None and trip is not self._trip:
            self._keep(trip)
        self._trip = trip

    def _document(self) -> JsonObject:
        return {"snapshot": self._snapshot(self._axis_loop), "fields": FIELDS}

    def _keep(self, trip: "Trip") -> None:
        """Keep the last ticks; for want of memory without them, since the axis has to go on."""
        name = self._axis_loop.name
        try:
            records = self._axis_loop.recorder.keep()
            if self._files is not None:
                self._files.write(name, trip.code, self._document(), records, trip.file)
        except MemoryError as error:
            if self._files is not None:
                self._files.fail(name, trip.code, error, trip.file)
            else:
                text = "no recording of the trip: out of memory"
                structlog.get_logger().error(text, axis=name, code=trip.code)
