"""Tells the log what changes on an axis."""

from typing import TYPE_CHECKING

import structlog

from twostage_servo.axis.reference import ReferenceSource
from twostage_servo.timing.ticks import Tick

if TYPE_CHECKING:
    from twostage_servo.axis.trips import Trip
    from twostage_servo.service.axis_loop import AxisLoop


class EventLog:
    """Looks at an axis after each tick.

    Parameters
    ----------
    axis_loop
        The axis with what belongs to it.
    """

    def __init__(self, axis_loop: "AxisLoop") -> None:
        self._axis_loop = axis_loop
        self._log = structlog.get_logger().bind(axis=axis_loop.name)
        self._state = axis_loop.axis.state
        self._trip: Trip | None = None
        self._told = 1  # trips since the last reset, the first one apart
        self._source: ReferenceSource | None = None
        self._lost_because: str | None = None
        self._stale = True
        self._was_fresh = False

    def publish(self, tick: Tick) -> None:
        """Report what has changed since the last tick."""
        axis = self._axis_loop.axis
        if axis.trips or self._trip is not None:
            self._report_trip(tick)
        if axis.state is not self._state:
            self._log.info("state", tick=tick.index, before=self._state, now=axis.state)
            self._state = axis.state
        self._report_reference(tick)
        if axis.drive.is_stale is not self._stale:
            self._stale = axis.drive.is_stale
            if self._stale:
                self._log.warning("feedback stale", tick=tick.index)
            else:  # whoever reads warnings alone is to see that one has passed; the first is what every start brings
                tell = self._log.warning if self._was_fresh else self._log.info
                tell("feedback fresh", tick=tick.index)
                self._was_fresh = True

    def _report_reference(self, tick: Tick) -> None:
        reference = self._axis_loop.axis.reference
        if reference.source is self._source and reference.lost_because == self._lost_because:
            return
        begins = self._lost_because is None
        self._source, self._lost_because = reference.source, reference.lost_because
        if reference.source is ReferenceSource.ENCODER:
            self._log.info(
                "positions are the encoder's own: a reference that was set before the service started is not known",
                tick=tick.index,
            )
        elif reference.source is ReferenceSource.HOMED:
            self._log.info("the position is known", tick=tick.index)
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
        self._trip = trip
        for later in list(axis.trips.values())[self._told :]:
            event = "more severe trip" if later is axis.escalation else "further trip"
            self._log.error(event, tick=later.tick, code=later.code, cause=later.cause)
        self._told = max(1, len(axis.trips))
