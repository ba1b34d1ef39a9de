"""The operator's lease: one client commands, the rest watch."""

import contextlib
from collections.abc import Iterator

from twostage_servo.axis.refusals import RefusalCode, Refused


class Authority:
    """Who commands the axis.

    A client that commands takes the lease by it, if nobody holds it, and keeps it until it gives it back or its
    connection ends. A command that is refused takes nothing. So two operators never pull at one axis, and no script
    has to ask for anything first.

    Attributes
    ----------
    holder
        Name of the client that commands, such as ``pid 812 uid 1000 #3``; None if nobody does.
    """

    def __init__(self) -> None:
        self.holder: str | None = None

    def demand(self, client: str) -> None:
        """Let a client command.

        Raises
        ------
        Refused
            If another client holds the lease.
        """
        if self.holder not in {None, client}:
            raise Refused(
                RefusalCode.LEASE_HELD,
                f"{self.holder} commands this axis: end it, let it `release`, or take authority from it with "
                "`release --force` (`preempt` on the socket) while the axis is at rest. `stop` and `disarm` are open "
                "to everybody.",
            )
        self.holder = client

    @contextlib.contextmanager
    def demanded(self, client: str) -> Iterator[None]:
        """Let a client command, and take back what it got by that if its command is refused.

        Raises
        ------
        Refused
            As in :meth:`demand`.
        """
        held = self.holder == client
        self.demand(client)
        try:
            yield
        except Refused:
            if not held:
                self.release(client)
            raise

    def take(self, client: str, *, at_rest: bool) -> None:
        """Let a client command in place of the holder.

        Raises
        ------
        Refused
            If another client holds the lease and the axis is not at rest.
        """
        if self.holder not in {None, client} and not at_rest:
            raise Refused(RefusalCode.BUSY, f"the axis moves as {self.holder} has commanded: `stop` it first.")
        self.holder = client

    def release(self, client: str) -> bool:
        """Take a client's lease back; return whether it held one."""
        if self.holder != client:
            return False
        self.holder = None
        return True
