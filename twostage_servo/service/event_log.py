"""Tells the log what changes on an axis, and keeps the recording of a trip."""

from typing import TYPE_CHECKING, Any

import structlog

from twostage_servo.axis.reference import ReferenceSource
from twostage_servo.service.disabled_report import DisabledReport
from twostage_servo.telemetry.recorder import Record
from twostage_servo.telemetry.trip_files import TripFile
from twostage_servo.timing.ticks import Tick

if TYPE_CHECKING:
    from collections.abc import Callable

    from twostage_servo.axis.trips import Trip
    from twostage_servo.service.axis_loop import AxisLoop
    from twostage_servo.telemetry.trip_files import Document, TripFiles


class EventLog:
    """Looks at an axis after each tick.

    Parameters
    ----------
    axis_loop
        The axis with what belongs to it.

    Attributes
    ----------
    trip_files
        Where the recordings of trips go; None: they stay in memory only.
    trip_file
        What becomes of the file of the latest trip of this axis.
    snapshot
        Makes what a trip's file says beside the recording.
    """

    def __init__(self, axis_loop: "AxisLoop") -> None:
        self.trip_files: TripFiles | None = None
        self.trip_file = TripFile()
        self.snapshot: Callable[[], dict[str, Any]] = lambda: axis_loop.report().to_json()
        self._axis_loop = axis_loop
        self._log = structlog.get_logger().bind(axis=axis_loop.name)
        self._state = axis_loop.axis.state
        self._trip: Trip | None = None
        self._told = 1  # trips since the last reset, the first one apart
        self._source: ReferenceSource | None = None
        self._lost_because: str | None = None
        self._stale = True
        self._disabled = DisabledReport(axis_loop.name, axis_loop.axis.design.period_s)

    def report(self, tick: Tick) -> None:
        """Report what has changed since the last tick."""
        self._report_trip(tick)
        axis = self._axis_loop.axis
        if axis.state is not self._state:
            self._log.info("state", tick=tick.index, before=self._state, now=axis.state)
            self._state = axis.state
        self._report_reference(tick)
        if axis.drive.is_stale is not self._stale:
            self._stale = axis.drive.is_stale
            self._log.warning("feedback stale" if self._stale else "feedback fresh", tick=tick.index)
        self._disabled.report(tick.index, axis)

    def _report_reference(self, tick: Tick) -> None:
        reference = self._axis_loop.axis.reference
        if (reference.source, reference.lost_because) == (self._source, self._lost_because):
            return
        begins = self._lost_because is None
        self._source, self._lost_because = reference.source, reference.lost_because
        if reference.source is ReferenceSource.ENCODER:
            self._log.info(
                "positions are those that the encoder counts: a place that was set before the service started is not "
                "known",
                tick=tick.index,
            )
        elif reference.source is ReferenceSource.HOMED:
            self._log.warning("the position is known", tick=tick.index)
        elif begins:
            self._log.info("the position is not known: home the axis", tick=tick.index, reason=reference.lost_because)
        else:
            text = "the position is no longer known: home the axis"
            self._log.warning(text, tick=tick.index, reason=reference.lost_because)

    def _report_trip(self, tick: Tick) -> None:
        axis = self._axis_loop.axis
        trip = axis.trip
        if trip is not None and trip is not self._trip:
            self._log.error("trip", tick=tick.index, code=trip.code, cause=trip.cause, next_action=trip.next_action)
            self._keep_recording(trip)
        self._trip = trip
        for later in list(axis.trips.values())[self._told :]:
            event = "trip, more severe" if later is axis.escalation else "trip, as well"
            self._log.error(event, tick=later.tick, code=later.code, cause=later.cause)
        self._told = max(1, len(axis.trips))

    def _document(self) -> "Document":
        return {"snapshot": self.snapshot(), "fields": Record._fields}

    def _keep_recording(self, trip: "Trip") -> None:
        """Keep the last ticks, in memory and on disk; for want of memory without them, since the axis has to go on."""
        axis_loop = self._axis_loop
        self.trip_file = TripFile()
        try:
            axis_loop.recorder.keep()
            if self.trip_files is not None:
                name, records = f"{axis_loop.name}-{trip.code}", axis_loop.recorder.records()
                self.trip_file = self.trip_files.write(name, self._document(), records)
        except MemoryError as error:
            if self.trip_files is not None:
                self.trip_files.fail(error, self.trip_file)
            else:
                self._log.error("no recording of the trip: no memory is left")
