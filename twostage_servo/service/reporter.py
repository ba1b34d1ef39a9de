"""Tells the log what changes, and keeps the recording of a trip."""

from typing import TYPE_CHECKING

import structlog

from twostage_servo.service.recorder import Record
from twostage_servo.ticks import Tick

if TYPE_CHECKING:
    from twostage_servo.axis.trips import Trip
    from twostage_servo.service.loop import ServoService
    from twostage_servo.service.trip_files import TripFiles


class Reporter:
    """Looks at the service after each tick; call it with the tick.

    Parameters
    ----------
    service
        The service.

    Attributes
    ----------
    trip_files
        Where the recordings of trips go; None: they stay in memory only.
    """

    def __init__(self, service: "ServoService") -> None:
        self.trip_files: TripFiles | None = None
        self._service = service
        self._log = structlog.get_logger().bind(axis=service.axis.settings.name)
        self._state = service.axis.state
        self._trip: Trip | None = None
        self._told = 1  # trips since the last reset, the first one apart
        self._referenced = service.axis.referenced
        self._rejected = 0
        self._stale = True
        self._controller = "active"
        self._ticks_a_report = max(1, round(1.0 / service.ticks.period_s))

    def __call__(self, tick: Tick) -> None:
        """Report what has changed since the last tick."""
        self._report_trip(tick)
        service, axis = self._service, self._service.axis
        if axis.state is not self._state:
            self._log.info("state", tick=tick.index, before=self._state, now=axis.state)
            self._state = axis.state
        if axis.referenced is not self._referenced:
            self._referenced = axis.referenced
            text = "the position is known" if axis.referenced else "the position is no longer known: home the axis"
            self._log.warning(text, tick=tick.index)
        if axis.drive.is_stale is not self._stale:
            self._stale = axis.drive.is_stale
            self._log.warning("feedback stale" if self._stale else "feedback fresh", tick=tick.index)
        if service.link.controller_state != self._controller:
            self._controller = service.link.controller_state
            self._log.warning("bus controller", tick=tick.index, state=self._controller)
        rejected = service.link.counters.rejected
        if rejected != self._rejected and tick.index % self._ticks_a_report == 0:
            self._log.warning("frames rejected", tick=tick.index, new=rejected - self._rejected, total=rejected)
            self._rejected = rejected

    def _report_trip(self, tick: Tick) -> None:
        service, trip = self._service, self._service.axis.trip
        if trip is not None and trip is not self._trip:
            service.recorder.keep()
            self._log.error("trip", tick=tick.index, code=trip.code, cause=trip.cause, next_action=trip.next_action)
            if self.trip_files is not None:
                self.trip_files.write(
                    f"{service.axis.settings.name}-{trip.code}",
                    {"snapshot": service.snapshot(), "fields": Record._fields},
                    service.recorder.records(),
                )
        self._trip = trip
        axis = service.axis
        for later in list(axis.trips.values())[self._told :]:
            event = "trip, more severe" if later is axis.escalation else "trip, as well"
            self._log.error(event, tick=later.tick, code=later.code, cause=later.cause)
        self._told = max(1, len(axis.trips))
