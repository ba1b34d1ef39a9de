"""The service: on each tick read the buses, update the axes, write the commands, publish what happened."""

import asyncio
from collections.abc import Callable, Sequence

from twostage_servo.service.axis_group import AxisGroup
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.bus_connection import BusConnection
from twostage_servo.service.runtime import Runtime
from twostage_servo.service.shutdown import Shutdown
from twostage_servo.service.statistics import TickStatistics
from twostage_servo.timing.ticks import Tick, busy_wait

Publisher = Callable[[Tick], None]
"""Called at the end of each tick, in no particular order; it must not wait."""


class ServoService:
    """Axes on their buses, on one tick.

    Parameters
    ----------
    buses, axis_loops
        The buses, and the axes on them.
    group
        Lets the other axes react when one trips.
    shutdown
        Ends the service.
    statistics
        Takes note of what the ticks were like.
    runtime
        What surrounds the service.
    publishers
        Are told of each tick.

    Attributes
    ----------
    buses, axis_loops, shutdown, statistics, ticks
        As given.
    """

    def __init__(
        self,
        buses: Sequence[BusConnection],
        axis_loops: Sequence[AxisLoop],
        group: AxisGroup,
        shutdown: Shutdown,
        statistics: TickStatistics,
        runtime: Runtime,
        publishers: Sequence[Publisher] = (),
    ) -> None:
        self.buses = buses
        self.axis_loops = axis_loops
        self.shutdown = shutdown
        self.statistics = statistics
        self.ticks = runtime.ticks
        self._group = group
        self._runtime = runtime
        self._publishers = tuple(publishers)

    async def run(self) -> None:
        """Run until :meth:`shut_down` has brought the axes to rest; the drives are disabled on every way out.

        Raises
        ------
        Exception
            A defect of this program. If the tick still works, a quick stop has brought the axes to rest before.
        """
        for bus in self.buses:
            bus.start()
        loop, tick_index = asyncio.get_running_loop(), 0
        try:
            async for tick in self.ticks:
                tick_index = tick.index
                self._serve(loop, tick)
        finally:
            for idle in self._runtime.idle:
                idle.end()
            try:
                self.shutdown.disable_drives(tick_index)
            finally:
                await asyncio.gather(*(bus.close() for bus in self.buses))
        if self.shutdown.failure is not None:
            raise self.shutdown.failure

    def shut_down(self) -> None:
        """Bring the axes to rest, disable the drives, and end the loop; see :meth:`Shutdown.begin`."""
        self.shutdown.begin()

    # The tick --------------------------------------------------------------------------------------------------------

    def _serve(self, loop: asyncio.AbstractEventLoop, tick: Tick) -> None:
        """Serve a tick: read, update, write, publish. Only one that is completed gives a sign of life."""
        now_s, completed = loop.time, True
        begun_s = read_s = updated_s = held_s = written_s = self.ticks.begin(tick)
        self.statistics.begin(tick.index * self.ticks.period_s, tick.lateness_s, tick.missed)
        try:
            self.read(tick)
            read_s = now_s()
            self.update(tick)
            updated_s = now_s()
            held_s = self._hold(loop, tick, updated_s)
            self.write(tick)
            written_s = now_s()
        except Exception as error:  # noqa: BLE001 - raised again when the axes are at rest, or at once
            completed = False
            self.shutdown.fail(error, in_control=True)
        try:
            self.publish(tick)
        except Exception as error:  # noqa: BLE001 - likewise
            completed = False
            self.shutdown.fail(error)
        ended_s = now_s()
        self.statistics.end(begun_s, read_s, updated_s, held_s, written_s, ended_s)
        if completed and self._runtime.sign_of_life is not None:
            self._runtime.sign_of_life(ended_s)
        if self.shutdown.is_over():
            self.ticks.stop()
        self._give_idle_time(tick)

    def read(self, tick: Tick) -> None:
        """Drain every bus; the newest feedback of each drive goes to its axis."""
        for axis_loop in self.axis_loops:
            axis_loop.begin_tick(tick)
        for bus in self.buses:
            bus.read(tick)

    def update(self, _: Tick) -> None:
        """Let each axis decide on its effort, and all of them react if one has tripped; make the commands ready."""
        self.shutdown.brake()
        for axis_loop in self.axis_loops:
            axis_loop.update()
        self._group.react(self.axis_loops)
        for axis_loop in self.axis_loops:
            axis_loop.make_ready()

    def write(self, tick: Tick) -> None:
        """Send the newest commands; one that its bus cannot take now is dropped, never kept."""
        for axis_loop in self.axis_loops:
            axis_loop.write(tick)

    def publish(self, tick: Tick) -> None:
        """Record the tick and tell whoever listens; none of it waits."""
        for axis_loop in self.axis_loops:
            axis_loop.record(tick)
        for publish in self._publishers:
            publish(tick)
        for bus in self.buses:
            bus.look_after(tick)

    # Its ends --------------------------------------------------------------------------------------------------------

    def _hold(self, loop: asyncio.AbstractEventLoop, tick: Tick, ready_s: float) -> float:
        """Let the time at which the commands shall leave come; return the loop's time then."""
        offset = self._runtime.output_offset
        if offset is None:
            return ready_s
        send_s = tick.deadline_s + offset.offset_s
        offset.learn(ready_s - tick.deadline_s)
        return ready_s if ready_s >= send_s else busy_wait(loop, send_s)

    def _give_idle_time(self, tick: Tick) -> None:
        until_s = tick.deadline_s + self.ticks.period_s - self.ticks.margin_s
        try:
            for idle in self._runtime.idle:
                idle.open(until_s)
        except Exception as error:  # noqa: BLE001 - raised again when the axes are at rest
            self.shutdown.fail(error)
