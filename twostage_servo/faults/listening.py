"""What parties outside the service see of it: its drive's frames on the bus, and its snapshots."""

import contextlib
import itertools
import json
import socket
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

from twostage_servo.canbus.link import BusSettings, Link
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.frame import FrameRejected

Snapshot = dict[str, Any]

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
        All frames so far, oldest first; positions are rolled out.
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

    def take(self) -> None:
        """Take what has arrived."""
        for message in self._link.drain():
            with contextlib.suppress(FrameRejected):
                if message.arbitration_id == self._profile.feedback_id.identifier:
                    feedback = self._profile.decode_feedback(message)
                    position = self._roll_out(feedback.position)
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

    def _roll_out(self, counted: float) -> float:
        period = self._profile.traits.position_period
        if not period or not self.reports:
            return counted
        return counted - period * round((counted - self.reports[-1].position) / period)


_FEWEST = 5
"""Reports that show a standstill, at the least."""


class RefusalError(Exception):
    """The service refused what the operator asked for."""


class Operator:
    """A client that commands, and watches every tick. It keeps its connection, as the lease goes with that.

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
        self._received = b""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.settimeout(_LONGEST_ANSWER_S)
            self._socket.connect(str(path))
            self.ask(op="watch", every=1)
        except BaseException:
            self._socket.close()
            raise

    def fileno(self) -> int:
        """File descriptor of the connection, for ``select``."""
        return self._socket.fileno()

    def close(self) -> None:
        """Give the lease back, as everyone does who leaves on purpose, and leave."""
        with contextlib.suppress(OSError, RefusalError):
            self._socket.settimeout(_PARTING_S)
            self.ask(op="release")
        self._socket.close()

    def ask(self, **request: Any) -> Snapshot:
        """Send a request and return its answer.

        Raises
        ------
        RefusalError
            If it is refused.
        OSError
            If the service is gone.
        """
        self._socket.sendall(json.dumps(request).encode() + b"\n")
        answer = None
        while answer is None:
            for line in self._lines(self._read()):
                if line.get("event"):
                    self._keep(line)
                else:
                    answer = line
        if not answer["ok"]:
            raise RefusalError(f"{answer['error']['code']}: {answer['error']['message']}")
        return answer

    def take(self) -> bool:
        """Take the snapshots that have come, without waiting; return whether the service is still there."""
        self._socket.settimeout(0.0)
        try:
            while data := self._socket.recv(1 << 16):
                for line in self._lines(data):
                    self._keep(line)
        except BlockingIOError:
            return True
        except OSError:
            return False
        finally:
            self._socket.settimeout(_LONGEST_ANSWER_S)
        return False

    def _read(self) -> bytes:
        data = self._socket.recv(1 << 16)
        if not data:
            raise ConnectionResetError("the service has closed the connection")
        return data

    def _lines(self, data: bytes) -> list[Snapshot]:
        *lines, self._received = (self._received + data).split(b"\n")
        return [json.loads(line) for line in lines]

    def _keep(self, snapshot: Snapshot) -> None:
        self.unread.append(snapshot)
        self.latest = snapshot
