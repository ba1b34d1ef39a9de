"""`reload`: what takes longer than a tick is done ahead, outside the loop; then the change, between two ticks."""

from collections.abc import Awaitable, Callable, Sequence

from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import State
from twostage_servo.service.axis_loop import AxisLoop

Change = Callable[[], None]
"""Puts the axes of a configuration that was read again in force."""


class Reload:
    """Reads the configuration again for one client at a time.

    Parameters
    ----------
    axis_loops
        The axes of the service, which have to be disarmed.
    prepare
        Reads the configuration outside the loop; None where there is none to read.
    """

    def __init__(self, axis_loops: Sequence[AxisLoop], prepare: Callable[[], Awaitable[Change]] | None) -> None:
        self._axis_loops = axis_loops
        self._prepare = prepare
        self._preparing: str | None = None  # the client for whom a configuration is being read
        self._prepared: tuple[str, Change] | None = None

    async def prepare(self, client: str) -> None:
        """Read the configuration ahead of a client's request, which is to follow.

        Raises
        ------
        Refused
            If the request would be refused, another one is under way, or the configuration cannot be used.
        """
        if self._prepare is None:
            return
        self._check_disarmed()
        if self._preparing is not None:
            raise Refused(
                RefusalCode.BUSY, f"{self._preparing} is reloading the configuration: wait until that has ended."
            )
        self._preparing, self._prepared = client, None
        try:
            self._prepared = client, await self._prepare()
        finally:
            self._preparing = None

    def is_prepared(self, client: str) -> bool:
        """Whether what was prepared for a client's request waits for it."""
        return self._prepared is not None and self._prepared[0] == client

    def carry_out(self, client: str) -> None:
        """Put what was prepared for a client in force.

        Raises
        ------
        Refused
            If nothing was prepared, or an axis is armed.
        """
        prepared, self._prepared = self._prepared, None
        if prepared is None or prepared[0] != client:
            raise Refused(
                RefusalCode.NO_CONFIGURATION,
                "this service runs on settings that are in no file: there is nothing to reload.",
            )
        self._check_disarmed()
        prepared[1]()

    def _check_disarmed(self) -> None:
        for axis_loop in self._axis_loops:
            if axis_loop.axis.state is not State.DISARMED:
                raise Refused(
                    RefusalCode.ARMED,
                    f"axis {axis_loop.name} is {axis_loop.axis.state}: settings are read again only while disarmed.",
                )
