"""Snapshots for those who watch: made and sent between the ticks, within the time that all clients have together."""

import asyncio
from typing import TYPE_CHECKING, Final

from twostage_servo.service.turns import Rank

if TYPE_CHECKING:
    from collections.abc import Iterator

    from twostage_servo.service.connection import Connection
    from twostage_servo.service.connections import Connections
    from twostage_servo.service.status_lines import StatusLines
    from twostage_servo.service.turns import Turns

_BEGIN: Final = b'{"event":"snapshot",'
_MOST_A_TURN: Final = 16
"""Pieces made, or snapshots sent, however little time they seem to take."""


class Watchers:
    """Sends a snapshot to each connection for which one is due; where time is short it comes later.

    Parameters
    ----------
    connections
        Those that may watch.
    status
        Makes the lines.
    turns
        Gives the time.
    """

    def __init__(self, connections: "Connections", status: "StatusLines", turns: "Turns") -> None:
        self._connections = connections
        self._status = status
        self._turns = turns
        self._tick = 0
        self._due = asyncio.Event()
        self._begun: dict[str | None, tuple[Iterator[bytes], list[bytes]]] = {}
        self._lines: dict[str | None, bytes] = {}

    def publish(self, tick: int) -> None:
        """Take notice of a tick; only here is a snapshot found to be due."""
        self._tick = tick
        self._lines.clear()
        if any(self._is_due(connection) for connection in self._connections):
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
            while due := sorted(filter(self._is_due, self._connections), key=lambda one: one.due):
                async with self._turns.turn(Rank.WATCHING):
                    self._work(due)
                await asyncio.sleep(0)

    def _is_due(self, connection: "Connection") -> bool:
        return bool(connection.every) and self._tick >= connection.due and not connection.busy

    def _work(self, due: "list[Connection]") -> None:
        """Go on with what is due the longest, for as long as a turn should take."""
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._turns.slice_s
        name = due[0].axis
        if name not in self._lines:
            self._make(name, until_s)
        if name not in self._lines:
            return
        line = self._lines[name]
        for connection in [one for one in due if one.axis == name and self._is_due(one)][:_MOST_A_TURN]:
            connection.due = self._tick + connection.every
            if connection.send_snapshot(line):
                self._connections.touch(connection)
            if clock() >= until_s:
                return

    def _make(self, name: str | None, until_s: float) -> None:
        clock = asyncio.get_running_loop().time
        pieces, made = self._begun.setdefault(name, (self._status.line(name, _BEGIN), []))
        for _ in range(_MOST_A_TURN):
            piece = next(pieces, None)
            if piece is None:
                del self._begun[name]
                self._lines[name] = b"".join(made)
                return
            made.append(piece)
            if clock() >= until_s:
                return
