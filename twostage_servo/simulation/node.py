"""The simulated drive as a node on a bus: an asyncio task that runs the firmware cycle over its own link."""

import asyncio
import functools
import logging
from collections.abc import Callable

from twostage_servo.canbus.link import Link, LinkError
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.simulation.sparse_ticks import SparseTicks
from twostage_servo.timing.ticks import Ticks

_log = logging.getLogger(__name__)


class DriveNode:
    """Runs a drive: at each firmware cycle reads its link, feeds the drive and sends what the drive has to say.

    A link that fails is closed and opened again at the reopen interval, for as long as the node runs; the axis
    meanwhile moves on, and the drive's command time-out stops it.

    Parameters
    ----------
    drive : SimulatedDrive
        The drive, on the clock of the running loop.
    link : Link
        A link of its own, for the command identifier. The node opens and closes it.
    cycle_s : float
        Period of the firmware cycle, s.
    observer : callable, optional
        Called with the time (s) and the drive whenever the drive has sampled its position, to record the true state.
    arrival_s : callable, optional
        Gives the time (s) at which the next frame arrives, or infinity. With it, cycles in which nothing is due are
        left out, which is most of them; :meth:`wake` then has to be called for each frame that is sent.
    axis : str
        Name of its axis, for the log: several drives may run in one process.
    """

    def __init__(
        self,
        drive: SimulatedDrive,
        link: Link,
        cycle_s: float,
        observer: Callable[[float, SimulatedDrive], None] | None = None,
        *,
        arrival_s: Callable[[], float] | None = None,
        axis: str = "",
    ) -> None:
        self._name = f"simulated drive of axis {axis}" if axis else "simulated drive"
        self._drive = drive
        self._link = link
        self._observer = observer
        self._timeouts_reported = 0
        self._error_reported: str | None = None
        self._reopen_s = link.settings.reopen_interval_ms / 1e3
        self._reopen_at_s = 0.0
        self._opening: asyncio.Task[None] | None = None
        self._is_stopped = False
        self._ticks = (
            Ticks(cycle_s) if arrival_s is None else SparseTicks(cycle_s, functools.partial(self._due_s, arrival_s))
        )

    async def run(self) -> None:
        """Run until :meth:`stop`."""
        loop = asyncio.get_running_loop()
        self._reopen_at_s = loop.time()
        try:
            async for _ in self._ticks:
                if self._link.is_open:
                    self._cycle(loop.time())
                elif loop.time() >= self._reopen_at_s:
                    await self._open(loop)
        finally:
            self._link.close()

    def wake(self) -> None:
        """Look again what is due next: a frame arrives, or the drive has been changed from outside."""
        if isinstance(self._ticks, SparseTicks):
            self._ticks.wake()

    def stop(self) -> None:
        """Let :meth:`run` end before the next cycle. Call it from the loop's thread."""
        self._is_stopped = True
        self._ticks.stop()
        if self._opening is not None:
            self._opening.cancel()

    def _due_s(self, arrival_s: Callable[[], float]) -> float:
        """Return when something is due next, on the loop's clock in s."""
        return min(self._drive.due_s, arrival_s()) if self._link.is_open else self._reopen_at_s

    def _cycle(self, now_s: float) -> None:
        drive, link = self._drive, self._link
        samples = drive.counters.samples
        try:
            for message in link.drain():
                drive.receive(message, now_s)
            for identifier, data in drive.cycle(now_s):
                link.send(link.prepare(identifier, data))
        except LinkError as error:
            self._lose(error, now_s)
        if drive.counters.command_timeouts != self._timeouts_reported:
            self._timeouts_reported = drive.counters.command_timeouts
            _log.warning(
                "%s: no command in time, disabled at %.3f, coasting at %.1f per second",
                self._name,
                drive.position,
                drive.velocity,
            )
        if self._observer is not None and drive.counters.samples != samples:
            self._observer(now_s, drive)

    async def _open(self, loop: asyncio.AbstractEventLoop) -> None:
        self._opening = asyncio.ensure_future(self._link.open_in_thread())
        try:  # the hub that it connects to may be served by this very loop
            await self._opening
        except asyncio.CancelledError:
            if not self._is_stopped:
                raise
        except LinkError as error:
            self._lose(error, loop.time())
        else:
            self._error_reported = None
            _log.info("%s: on the bus", self._name)

    def _lose(self, error: LinkError, now_s: float) -> None:
        self._link.close()
        self._reopen_at_s = now_s + self._reopen_s
        if str(error) != self._error_reported:
            self._error_reported = str(error)
            _log.warning("%s: %s Trying again every %g s", self._name, error, self._reopen_s)
