"""The budget of connections: one for all of them, in whatever phase: it bounds descriptors, tasks and buffers."""

from collections.abc import Iterator
from typing import Final

from twostage_servo.service.connection import Connection

MOST: Final = 64
_NEVER: Final = 4


class Connections:
    """All connections that are not closed, those that only have to be emptied among them."""

    def __init__(self) -> None:
        self._all: dict[Connection, None] = {}  # who has been idle the longest stands first

    def __len__(self) -> int:
        """Return their number."""
        return len(self._all)

    def __iter__(self) -> Iterator[Connection]:
        """Iterate over those that are there now, from the one that has been idle the longest."""
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
        self._all[connection] = None

    def discard(self, connection: Connection) -> None:
        """Count it no more."""
        self._all.pop(connection, None)

    def touch(self, connection: Connection) -> None:
        """Record that a connection is not idle."""
        if connection in self._all:
            del self._all[connection]
            self._all[connection] = None

    def to_evict(self, holder: str | None) -> Connection | None:
        """Return the one to evict: first one that has hung up, then the one idle for longest.

        A watcher that takes its snapshots is not idle. One in the middle of a long answer goes late, one that has asked
        for a stop last, and the client that commands never.

        Parameters
        ----------
        holder
            The client that commands.
        """
        best: Connection | None = None
        least = _NEVER
        for connection in self._all:
            worth = _NEVER if connection.peer == holder else _worth(connection)
            if worth < least:
                best, least = connection, worth
                if worth == 0:
                    break
        return best


def _worth(connection: Connection) -> int:
    if connection.urgent is not None:
        return 3
    if connection.ended:
        return 0
    return 2 if connection.busy else 1
