"""What each line of the service's log has to say: its fields, all of them with a value.

Whoever reads the journal, and whatever counts its entries, goes by these names. :func:`defects` looks at every line
that the tests of this folder bring about, whatever a test is about.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, Final

_TICK = "tick"

FIELDS: Final[dict[str, str]] = {
    # An axis
    "state": "axis tick before now",
    "feedback stale": "axis tick",
    "feedback fresh": "axis tick",
    "positions are those that the encoder counts: a place that was set before the service started is not known": (
        "axis tick"
    ),
    "the position is known": "axis tick",
    "the position is not known: home the axis": "axis tick reason",
    "the position is no longer known: home the axis": "axis tick reason",
    "trip": "axis tick code cause next_action",
    "trip, more severe": "axis tick code cause",
    "trip, as well": "axis tick code cause",
    "no recording of the trip: no memory is left": "axis",
    "the trip lasts": "axis tick code cause next_action",
    "this lasts, and has not tripped the axis": "axis tick code cause next_action",
    "the axis moves while its drive is told to be disabled": "axis tick moved unit",
    "another axis has tripped": "room axis tripped now",
    "the holder of control authority has gone": "axis client policy",
    # A bus
    "the bus is open": "bus interface",
    "the bus failed": "bus error",
    "the bus does not open, trying again": "bus error",
    "the bus does not close": "bus waited_s",
    "bus controller": "bus tick state error_counters",
    "frames rejected": "bus tick new total",
    "frames lost in the kernel, unread": "bus tick new total",
    "the bus brings more frames than a tick reads: what comes behind them does not count as fresh": (
        "bus tick new total frames_a_tick"
    ),
    "frame rejected": "room reason text",
    # Clients
    "request": "room peer op",
    "refused": "room peer op code reason",
    "request dropped, its client has gone": "room peer op",
    "client lost": "room peer error",
    "a client could not be served": "room peer exc_info",
    "a client had to make room": "room peer clients",
    "newcomers were turned away: all places are taken": "room newest number",
    "no client can be let in": "room error retry_s",
    "the control socket was gone, and has been made again": "room socket",
    "the control socket is gone and cannot be made again: no new client can connect": "room socket error",
    # The service
    "configuration read again": "config",
    "granted": "room what granted",
    "ending": "states",
    "the loop failed, the axes are being stopped": "exc_info",
    "the drive could not be told to disable; its own time-out has to stop it": "axis error",
    "the drive has not been seen to be disabled before the service ends; its own time-out has to stop it": (
        "axis code told_ms moved"
    ),
    "not suspended: a controller that stands still is dead to its drive; SIGTERM or Ctrl-C ends it": "signal",
    "trip file": "room trip path",
    "no trip file": "room trip error",
    "a trip file is not written, its disk hangs": "room folder",
    "log lines were lost: whoever reads the log does not keep up": "lines",
}

_WITHOUT_VALUE: Final = {"moved", "error_counters"}
"""May be None: nothing has shown motion, or the interface does not tell."""

_BESIDES: Final = {"event", "log_level", "level", "timestamp", "left_out"}


def defects(lines: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return what is wrong with lines of the log; of those that are none of the service's, whether they have a text."""
    found = []
    for line in lines:
        event = line.get("event")
        if not isinstance(event, str) or not event:
            found.append(f"a line without a text: {dict(line)}")
        elif event in FIELDS:
            wanted, fields = set(FIELDS[event].split()), set(line) - _BESIDES
            if not (wanted <= fields if event == "request" else wanted == fields):
                found.append(f"{event!r} has {sorted(fields)} in place of {sorted(wanted)}")
            found += [f"{event!r} has {name} = {line[name]!r}" for name in fields if _says_nothing(name, line[name])]
    return found


def _says_nothing(name: str, value: object) -> bool:
    if name in _WITHOUT_VALUE:
        return False
    if isinstance(value, float) and not math.isfinite(value):
        return True
    return value is None or value == "None" or (name == _TICK and not isinstance(value, int))
