"""What parties outside the service see of it: its drive's frames on the bus, and its snapshots."""

import contextlib
import itertools
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.request_reading import read_request
from twostage_servo.api.requests import ReleaseRequest
from twostage_servo.canbus.link import BusSettings, Link
from twostage_servo.client.connection import Connection
from twostage_servo.client.errors import Refused, ServoError
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.frame import FrameRejected

Snapshot = JsonObject

_LONGEST_ANSWER_S = 60.0
_PARTING_S = 1.0


class Report(NamedTuple):
    """One feedback of the drive: when the bus carried it (s), the position (axis unit), and whether it is enabled."""

    time_s: float
    position: float
    enabled: bool | None


class Order(NamedTuple):
    """One command to the drive: when the bus carried it (s), the effort (effort unit), and whether to enable."""

    time_s: float
    effort: float
    enable: bool | None


class Listener:
    """A node that only listens. The hub stamps the frames by the clock that all processes of a machine share.

    Parameters
    ----------
    bus
        The bus, as service and drive know it.
    profile
        How the drive's frames are packed.

    Attributes
    ----------
    reports, orders
        All frames so far, oldest first; positions are unwrapped.
    """

    def __init__(self, bus: BusSettings, profile: DriveProfile) -> None:
        self.reports: list[Report] = []
        self.orders: list[Order] = []
        self._profile = profile
        self._link = Link(bus, (profile.feedback_id, profile.command_id))
        self._link.open()

    def close(self) -> None:
        """Leave the bus."""
        self._link.close()

    def read_frames(self) -> None:
        """Read the frames that have arrived."""
        for message in self._link.drain():
            with contextlib.suppress(FrameRejected):
                if message.arbitration_id == self._profile.feedback_id.identifier:
                    feedback = self._profile.decode_feedback(message)
                    position = self._unwrap(feedback.position)
                    self.reports.append(Report(message.timestamp, position, feedback.enabled))
                else:
                    command = self._profile.decode_command(message)
                    self.orders.append(Order(message.timestamp, command.effort, command.enable))

    def place(self, time_s: float) -> float:
        """Return where the axis was, in axis unit, by the reports before and after a time."""
        before = [report for report in self.reports if report.time_s <= time_s]
        after = [report for report in self.reports if report.time_s > time_s]
        if not before or not after:
            return (before[-1] if before else after[0]).position
        first, second = before[-1], after[0]
        share = (time_s - first.time_s) / (second.time_s - first.time_s)
        return first.position + share * (second.position - first.position)

    def travel(self, begin_s: float) -> float:
        """Return the largest distance from where the axis was at a time, since then; in axis unit."""
        place = self.place(begin_s)
        return max((abs(report.position - place) for report in self.reports if report.time_s >= begin_s), default=0.0)

    def rests(self, since_s: float, duration_s: float, tolerance: float) -> bool:
        """Whether the axis has kept its place within a tolerance (axis unit), for a time in s after a moment."""
        newest_s = self.reports[-1].time_s
        if newest_s < since_s + duration_s:
            return False
        places = [report.position for report in self.reports if report.time_s >= newest_s - duration_s]
        return len(places) >= _FEWEST and max(places) - min(places) <= tolerance

    def longest_gap_s(self, begin_s: float, end_s: float, *, of_orders: bool = False) -> float:
        """Return the longest silence of the drive, or of the service, between two times."""
        frames = self.orders if of_orders else self.reports
        times = [frame.time_s for frame in frames if begin_s <= frame.time_s <= end_s]
        return max((later - earlier for earlier, later in itertools.pairwise(times)), default=0.0)

    def _unwrap(self, counted: float) -> float:
        period = self._profile.traits.position_period
        if not period or not self.reports:
            return counted
        return counted - period * round((counted - self.reports[-1].position) / period)


_FEWEST = 5
"""Reports that show a standstill, at the least."""


class RefusalError(Exception):
    """The service refused what the operator asked for."""


class Operator:
    """A client that commands, and watches every tick. It keeps its connection, as authority ends with that.

    Parameters
    ----------
    path
        Path of the control socket.

    Attributes
    ----------
    unread
        Snapshots that have come and were not looked at yet.
    latest
        The newest snapshot.

    Raises
    ------
    OSError
        If nobody answers there.
    """

    def __init__(self, path: Path) -> None:
        self.unread: deque[Snapshot] = deque()
        self.latest: Snapshot = {}
        with _as_os_error():
            self._connection = Connection(path, _LONGEST_ANSWER_S)
        try:
            self.ask(op="watch", every=1)
        except BaseException:
            self._connection.close()
            raise

    def fileno(self) -> int:
        """File descriptor of the connection, for ``select``."""
        return self._connection.fileno()

    def close(self) -> None:
        """Release authority, as everyone does who leaves on purpose, and leave."""
        with contextlib.suppress(OSError, RefusalError), _as_os_error():
            self._connection.ask(ReleaseRequest(), _PARTING_S)
        self._connection.close()

    def ask(self, **request: Any) -> Snapshot:
        """Send a request and return its answer.

        Raises
        ------
        RefusalError
            If it is refused.
        OSError
            If the service is gone.
        """
        with _as_os_error():
            try:
                return self._connection.ask(read_request(request))
            except Refused as error:
                raise RefusalError(f"{error.code}: {error}") from error
            finally:
                self._keep(self._connection.kept())

    def read_snapshots(self) -> bool:
        """Read the snapshots that have arrived, without waiting; return whether the service is still there."""
        try:
            self._keep(self._connection.drain())
        except ServoError:
            self._keep(self._connection.kept())
            return False
        return True

    def _keep(self, snapshots: list[Snapshot]) -> None:
        self.unread += snapshots
        self.latest = snapshots[-1] if snapshots else self.latest


@contextlib.contextmanager
def _as_os_error() -> Iterator[None]:
    """Let a service that is gone be the error of its connection."""
    try:
        yield
    except ServoError as error:
        raise ConnectionError(str(error)) from error
