"""Tells the log of a disabled axis what must not go unseen, again and again for as long as it lasts."""

from typing import TYPE_CHECKING

import structlog

from twostage_servo.timing.ticks import Tick

if TYPE_CHECKING:
    from twostage_servo.axis.axis import Axis
    from twostage_servo.axis.trips import TripCode
    from twostage_servo.service.axis_loop import AxisLoop

REPEATED_AFTER_S = 10.0
"""Time between two lines about the same, in s."""


class DisabledReport:
    """Looks, after each tick, at what lasts on the drive of an axis, and at motion while it is disabled.

    Parameters
    ----------
    axis_loop
        The axis with what belongs to it.
    """

    def __init__(self, axis_loop: "AxisLoop") -> None:
        self._axis_loop = axis_loop
        self._log = structlog.get_logger().bind(axis=axis_loop.name)
        self._every = round(REPEATED_AFTER_S / axis_loop.axis.design.period_s)
        self._next: dict[TripCode, int] = {}
        self._moved: float | None = None
        self._next_motion = 0

    def publish(self, tick: Tick) -> None:
        """Report what is so in this tick, unless it has been told of late."""
        axis = self._axis_loop.axis
        self._report_what_lasts(tick.index, axis)
        self._report_motion(tick.index, axis)

    def _report_what_lasts(self, tick_index: int, axis: "Axis") -> None:
        lasting = axis.lasting
        if not (lasting or self._next):
            return
        # Of what has tripped the first line is that of the trip.
        first = {one.code: tick_index + (self._every if one.code in axis.trips else 0) for one in lasting}
        self._next = {code: self._next.get(code, first[code]) for code in first}
        for one in lasting:
            if tick_index >= self._next[one.code]:
                self._next[one.code] = tick_index + self._every
                text = (
                    "the cause of the trip lasts"
                    if one.code in axis.trips
                    else "a condition lasts that has not tripped the axis"
                )
                self._log.error(text, tick=tick_index, code=one.code, cause=one.cause, next_action=one.next_action)

    def _report_motion(self, tick_index: int, axis: "Axis") -> None:
        moved = axis.disabled.moved
        if moved is None:
            self._moved = None
            return
        limit = axis.settings.limits.innovation_gate
        if self._moved is None or (tick_index >= self._next_motion and abs(moved - self._moved) > limit):
            self._moved, self._next_motion = moved, tick_index + self._every
            text = "the axis moves although its drive was told to disable"
            self._log.warning(text, tick=tick_index, moved=round(moved, 6), unit=axis.settings.unit)
