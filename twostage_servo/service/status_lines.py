"""The state of service and axes as JSON lines: each part is made once a tick, and shared by all who ask."""

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING

from twostage_servo.api.records import JsonRecord
from twostage_servo.service.answers import encode
from twostage_servo.service.snapshot import StatusReport, report_axis

if TYPE_CHECKING:
    from twostage_servo.service.axis_loop import AxisLoop


class StatusLines:
    """Makes the answers to `status` and to commands, and the snapshots of watchers.

    The report of one axis is one piece of work. A line of many axes whose making the next tick interrupts goes on with
    what they report then: each axis' report is of one tick, and those of a line are of one tick or of two in a row.

    Parameters
    ----------
    report
        Tells what is reported.

    Attributes
    ----------
    report
        As given.
    made
        Reports of axes that were made, rather than taken from what there was.
    """

    def __init__(self, report: StatusReport) -> None:
        self.report = report
        self._common: bytes | None = None
        self._axes: dict[str, bytes] = {}
        self.made = 0

    def forget(self) -> None:
        """Make everything anew: a tick has passed, or a request has changed something."""
        self._common = None
        self._axes.clear()

    def line(self, only: "AxisLoop | None", before: bytes) -> Iterator[bytes]:
        """Yield a line in pieces.

        Parameters
        ----------
        only
            The axis; None for the only one, or for all.
        before
            What the object begins with, up to a comma.
        """
        axis_loops = self.report.axis_loops
        if only is None and len(axis_loops) > 1:
            yield before + self._of_service() + b',"axes":{'
            comma = b""
            for axis_loop in axis_loops:
                yield comma + json.dumps(axis_loop.name).encode() + b":{" + self._of_axis(axis_loop) + b"}"
                comma = b","
            yield b"}}\n"
        else:
            yield before + self._of_service() + b"," + self._of_axis(only or axis_loops[0]) + b"}\n"

    def _of_service(self) -> bytes:
        if self._common is None:
            self._common = _inside(self.report.common())
        return self._common

    def _of_axis(self, axis_loop: "AxisLoop") -> bytes:
        part = self._axes.get(axis_loop.name)
        if part is None:
            self.made += 1
            part = self._axes[axis_loop.name] = _inside(report_axis(axis_loop))
        return part


def _inside(report: JsonRecord) -> bytes:
    """Return the fields of an object without its braces."""
    return encode(report)[1:-2]
