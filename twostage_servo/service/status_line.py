"""The line that `systemctl status` shows: how each axis is, and what to do about one that is not well."""

from typing import TYPE_CHECKING, Final

from twostage_servo.axis.moves import USUAL_OVERRIDE
from twostage_servo.axis.state import State
from twostage_servo.printable import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from twostage_servo.axis.trips import Trip
    from twostage_servo.service.axis_loop import AxisLoop
    from twostage_servo.service.shutdown import Shutdown
    from twostage_servo.service.statistics import TickStatistics
    from twostage_servo.timing.ticks import Tick

WORDS: Final = {
    State.DISARMED: "disarmed",
    State.ARMING: "arming",
    State.HOLDING: "holding",
    State.SPEED_STAGE: "moving",
    State.POSITION_STAGE: "moving",
    State.JOGGING: "jogging",
    State.HOMING: "homing",
    State.STOPPING: "stopping",
    State.QUICK_STOPPING: "stopping quickly",
    State.DISARMING: "stopping, to be disarmed",
    State.TRIPPED_STOPPING: "tripped",
    State.TRIPPED_QUICK_STOP: "tripped",
    State.TRIPPED: "tripped",
}
"""What an axis does, in one or two words."""
_LONGEST: Final = 2000
"""Bytes; the manager takes 4096 at most."""


class StatusLine:
    """Tells the service manager what has changed, ten times a second at most.

    Parameters
    ----------
    axis_loops, statistics, shutdown
        What it is about.
    period_s
        Length of a tick in s.
    show
        Called with each new line, returns whether it could be told; must not wait.
    """

    def __init__(
        self,
        axis_loops: "Sequence[AxisLoop]",
        statistics: "TickStatistics",
        shutdown: "Shutdown",
        period_s: float,
        show: "Callable[[str], bool]",
    ) -> None:
        self._axis_loops = axis_loops
        self._statistics = statistics
        self._shutdown = shutdown
        self._show = show
        self._shown = ""
        self._missed = 0
        self._missed_lately = 0
        self._ticks_a_second = round(1.0 / period_s)
        self._next_count = self._next_look = 0

    def publish(self, tick: "Tick") -> None:
        """Look at the service, if it is time to, and show the line if it has changed."""
        if tick.index >= self._next_count:
            self._next_count = tick.index + self._ticks_a_second
            missed = self._statistics.missed
            self._missed_lately, self._missed = missed - self._missed, missed
        if tick.index >= self._next_look:
            self._next_look = tick.index + max(1, self._ticks_a_second // 10)
            line = status_line(self._axis_loops, self._missed_lately, is_ending=self._shutdown.is_ending)
            if line != self._shown and self._show(line):
                self._shown = line


def status_line(axis_loops: "Sequence[AxisLoop]", missed_lately: int, *, is_ending: bool) -> str:
    """Return the line.

    Parameters
    ----------
    axis_loops
        What it is about.
    missed_lately
        Ticks that were missed in the last second.
    is_ending
        Whether the service is ending.
    """
    parts = ["ending"] if is_ending else []
    parts += [_of(axis_loop) for axis_loop in axis_loops]
    if missed_lately:
        parts.append(f"late, {missed_lately} ticks missed in the last second")
    line = " | ".join(printable(" ".join(part.split())) for part in parts)
    return line.encode()[:_LONGEST].decode(errors="ignore")


def _of(axis_loop: "AxisLoop") -> str:
    axis, bus = axis_loop.axis, axis_loop.bus
    words = f"{axis_loop.name} {WORDS[axis.state]}"
    if axis.override_percent != USUAL_OVERRIDE:
        words = f"{words}, override {axis.override_percent:g} %"
    if axis.disabled.moved is not None:
        words = f"{words}, moved by {axis.disabled.moved:+.3g} {axis.settings.unit} while disabled"
    if axis.trip is not None:
        words = f"{words}{_of_trip(axis_loop, axis.trip)}"
    elif axis.lasting:
        for one in axis.lasting:
            words = f"{words} ({one.code}): {one.cause.rstrip('.')}. {one.next_action}"
    elif bus.error is not None:
        words = f"{words}, no bus: {bus.error}"
    elif axis.drive.is_stale:
        words = f"{words}, the drive is silent"
    elif bus.link.controller_state != "active":
        words = f"{words}, bus {bus.link.settings.channel} error-{bus.link.controller_state}"
    return words


def _of_trip(axis_loop: "AxisLoop", trip: "Trip") -> str:
    words = f" ({trip.code}): {trip.cause.rstrip('.')}. {trip.next_action}"
    if (error := trip.file.error) is not None:
        words = f"{words} Besides: {error}."
    for one in axis_loop.axis.lasting:
        if one.code is not trip.code:
            words = f"{words} Besides ({one.code}): {one.cause.rstrip('.')}. {one.next_action}"
    return words
