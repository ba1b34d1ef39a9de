"""Control authority: one client commands, the rest watch."""

import contextlib
from collections.abc import Iterator

from twostage_servo.axis.refusals import RefusalCode, Refused


class Authority:
    """Who commands the axis.

    A client that commands acquires authority by it, if nobody holds it, and keeps it until it releases it or its
    connection ends. A command that is refused takes nothing. So two operators never pull at one axis, and no script
    has to ask for anything first.

    Attributes
    ----------
    holder
        Name of the client that commands, such as ``pid 812 uid 1000 #3``; None if nobody does.
    """

    def __init__(self) -> None:
        self.holder: str | None = None

    def acquire(self, client: str) -> None:
        """Give authority to a client, if it is free or already its own.

        Raises
        ------
        Refused
            If another client holds authority.
        """
        if self.holder not in {None, client}:
            raise Refused(
                RefusalCode.AUTHORITY_HELD,
                f"{self.holder} commands this axis: end it, let it `release`, or take authority from it with "
                "`release --force` (`preempt` on the socket) while the axis is at rest. `stop` and `disarm` are open "
                "to everybody.",
            )
        self.holder = client

    @contextlib.contextmanager
    def acquired(self, client: str) -> Iterator[None]:
        """Give authority to a client, and take it back if that is new and its command is refused.

        Raises
        ------
        Refused
            As in :meth:`acquire`.
        """
        held = self.holder == client
        self.acquire(client)
        try:
            yield
        except Refused:
            if not held:
                self.release(client)
            raise

    def preempt(self, client: str, *, at_rest: bool) -> None:
        """Give authority to a client, also in place of the holder.

        Raises
        ------
        Refused
            If another client holds authority and the axis is not at rest.
        """
        if self.holder not in {None, client} and not at_rest:
            raise Refused(RefusalCode.BUSY, f"the axis moves as {self.holder} has commanded: `stop` it first.")
        self.holder = client

    def release(self, client: str) -> bool:
        """Release a client's authority; return whether it held it."""
        if self.holder != client:
            return False
        self.holder = None
        return True
