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
    "positions are the encoder's own: a reference that was set before the service started is not known": ("axis tick"),
    "the position is known": "axis tick",
    "the position is not known: home the axis": "axis tick reason",
    "the position is no longer known: home the axis": "axis tick reason",
    "trip": "axis tick code cause next_action",
    "more severe trip": "axis tick code cause",
    "further trip": "axis tick code cause",
    "no recording of the trip: out of memory": "axis code",
    "the cause of the trip lasts": "axis tick code cause next_action",
    "a condition lasts that has not tripped the axis": "axis tick code cause next_action",
    "the axis moves although its drive was told to disable": "axis tick moved unit",
    "another axis has tripped": "room axis tripped now",
    "the holder of control authority has disconnected": "axis client policy",
    # A bus
    "the bus is open": "bus interface",
    "the bus failed": "bus error",
    "the bus does not open, trying again": "bus error",
    "the bus does not close": "bus waited_s",
    "bus controller": "bus tick state error_counters",
    "frames rejected": "bus tick new total",
    "frames were lost in the kernel before they were read": "bus tick new total",
    "more frames arrive than a tick reads: those that have to wait do not count as fresh": (
        "bus tick new total frames_a_tick"
    ),
    "frame rejected": "room axis reason text",
    # Clients
    "request": "room peer op",
    "refused": "room peer op code reason",
    "request dropped: its client has disconnected": "room peer op",
    "client lost": "room peer error",
    "a client could not be served": "room peer exc_info",
    "a client was disconnected to make room": "room peer clients",
    "connections were refused: all places are taken": "room newest number",
    "connections cannot be accepted": "room error retry_s",
    "the control socket was removed, and has been created again": "room socket",
    "the control socket was removed and cannot be created again: no new client can connect": "room socket error",
    # The service
    "configuration read again": "config",
    "granted": "room what granted",
    "ending": "states",
    "the loop failed, the axes are being stopped": "exc_info",
    "the drive could not be told to disable; only its own command time-out stops it": "axis error",
    "the drive did not report that it is disabled; only its own command time-out stops it": ("axis code told_ms moved"),
    "not suspended: a suspended service cannot control its drives; end it with SIGTERM or Ctrl-C": "signal",
    "trip file": "room axis code path",
    "no trip file": "room axis code error",
    "a trip file is not written: its disk does not respond": "room folder",
    "log lines were lost: the reader of the log does not keep up": "lines",
}

_WITHOUT_VALUE: Final = {"moved", "error_counters"}
"""May be None: nothing has shown motion, or the interface does not tell."""

_OF_REQUESTS: Final = {"request", "refused", "request dropped: its client has disconnected"}
"""They name the axis where the request is for one alone."""

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
            if event in _OF_REQUESTS and "axis" in fields:
                wanted.add("axis")
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
