"""Snapshots for those who watch: made and sent between the ticks, within the time that all clients have together."""

import asyncio
from typing import TYPE_CHECKING, Final, NamedTuple

from twostage_servo.service.background_server import Priority

if TYPE_CHECKING:
    from collections.abc import Iterator

    from twostage_servo.service.axis_loop import AxisLoop
    from twostage_servo.service.background_server import BackgroundServer
    from twostage_servo.service.connection import Connection
    from twostage_servo.service.connections import Connections
    from twostage_servo.service.status_lines import StatusLines

_BEGIN: Final = b'{"event":"snapshot",'
_MOST_A_SLOT: Final = 16
"""Pieces made, or snapshots sent, however little time they seem to take."""


class _Begun(NamedTuple):
    """A line that is being made: since which tick, and its pieces, those to come and those that there are."""

    tick: int
    pieces: "Iterator[bytes]"
    made: list[bytes]


class _Watch(NamedTuple):
    """What a connection watches: a snapshot each `every` ticks of an axis, None for all; when the next one is due."""

    connection: "Connection"
    every: int
    axis: "AxisLoop | None"
    due: int


class Watchers:
    """Sends a snapshot to each connection for which one is due; where time is short it comes later.

    A snapshot is never older than the tick at which it fell due: whoever waits for what a command does must not be
    shown what was before it. A line that was begun for somebody who has gone meanwhile is for nobody who comes later.

    Parameters
    ----------
    connections
        Those that may watch.
    status
        Makes the lines.
    background
        Gives the time.
    """

    def __init__(self, connections: "Connections", status: "StatusLines", background: "BackgroundServer") -> None:
        self._connections = connections
        self._status = status
        self._background = background
        self._tick = 0
        self._due = asyncio.Event()
        self._watches: dict[Connection, _Watch] = {}
        self._begun: dict[AxisLoop | None, _Begun] = {}
        self._lines: dict[AxisLoop | None, tuple[int, bytes]] = {}  # with the tick since which each was made

    def begin(self, connection: "Connection", every: int, axis: "AxisLoop | None") -> None:
        """Let a connection have a snapshot each `every` ticks, from the next tick on."""
        self._watches[connection] = _Watch(connection, every, axis, self._tick + 1)

    def end(self, connection: "Connection") -> None:
        """Let a connection have no more snapshots."""
        self._watches.pop(connection, None)

    def publish(self, tick: int) -> None:
        """Mark the watchers for which a snapshot is due at this tick."""
        self._tick = tick
        self._lines.clear()
        if any(self._all_due()):
            self._due.set()

    async def run(self) -> None:
        """Send what is due, until cancelled.

        Raises
        ------
        Exception
            A defect of this program.
        """
        while True:
            await self._due.wait()
            self._due.clear()
            while due := sorted(self._all_due(), key=lambda watch: watch.due):
                async with self._background.slot(Priority.WATCHING):
                    self._work(due)
                await asyncio.sleep(0)

    def _all_due(self) -> "Iterator[_Watch]":
        for connection in self._connections:
            watch = self._watches.get(connection)
            if watch is not None and self._tick >= watch.due and not connection.busy:
                yield watch

    def _work(self, due: "list[_Watch]") -> None:
        """Go on with what is due the longest, for as long as a slot should take."""
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._background.slice_s
        axis, since = due[0].axis, due[0].due
        if axis not in self._lines or self._lines[axis][0] < since:
            self._make(axis, since, until_s)
        if axis not in self._lines or self._lines[axis][0] < since:
            return
        tick, line = self._lines[axis]
        # One may have ended, or begun anew, while this waited for its time.
        shown = [
            one for one in due if one is self._watches.get(one.connection) and one.axis is axis and one.due <= tick
        ]
        for watch in shown[:_MOST_A_SLOT]:
            connection = watch.connection
            self._watches[connection] = watch._replace(due=self._tick + watch.every)
            if connection.send_snapshot(line):
                self._connections.touch(connection)
            if clock() >= until_s:
                return

    def _make(self, axis: "AxisLoop | None", since: int, until_s: float) -> None:
        """Go on with a line that was not begun before a tick, or begin one."""
        clock = asyncio.get_running_loop().time
        begun = self._begun.get(axis)
        if begun is None or begun.tick < since:
            begun = self._begun[axis] = _Begun(self._tick, self._status.line(axis, _BEGIN), [])
        for _ in range(_MOST_A_SLOT):
            piece = next(begun.pieces, None)
            if piece is None:
                del self._begun[axis]
                self._lines[axis] = begun.tick, b"".join(begun.made)
                return
            begun.made.append(piece)
            if clock() >= until_s:
                return
