"""The budget of connections: one for all of them, in whatever phase: it bounds descriptors, tasks and buffers."""

import itertools
from collections.abc import Iterator
from typing import Final

from twostage_servo.service.connection import Connection

MOST: Final = 64


class Connections:
    """All connections that are not closed, those that only have to be emptied among them."""

    def __init__(self) -> None:
        self._all: set[Connection] = set()
        self._moments = itertools.count(1)

    def __len__(self) -> int:
        """Return their number."""
        return len(self._all)

    def __iter__(self) -> Iterator[Connection]:
        """Iterate over those that are there now."""
        return iter(tuple(self._all))

    def __contains__(self, connection: object) -> bool:
        """Tell whether a connection is among them."""
        return connection in self._all

    @property
    def full(self) -> bool:
        """Whether one has to go before another comes."""
        return len(self._all) >= MOST

    def add(self, connection: Connection) -> None:
        """Count a connection."""
        self._all.add(connection)
        self.touch(connection)

    def discard(self, connection: Connection) -> None:
        """Count it no more."""
        self._all.discard(connection)

    def touch(self, connection: Connection) -> None:
        """Note that a connection is not idle."""
        connection.active = next(self._moments)

    def the_one_to_go(self, holder: str | None) -> Connection | None:
        """Return the one that makes room: who has hung up goes first, then who has been idle the longest.

        A watcher that takes its snapshots is not idle. One in the middle of a long answer goes late, one that has asked
        for a stop last, and the client that commands never.

        Parameters
        ----------
        holder
            The client that commands.
        """
        candidates = [connection for connection in self._all if connection.peer != holder]
        return min(candidates, key=_worth, default=None)


def _worth(connection: Connection) -> tuple[bool, bool, bool, int]:
    in_use = not connection.ended
    return connection.urgent is not None, in_use, in_use and connection.busy, connection.active
