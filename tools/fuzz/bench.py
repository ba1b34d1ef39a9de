"""The bench: the real service with its real link on a bus that is made up here, in ticks that cost no time.

Nothing of the service is replaced but the bus behind its link and the clock before its loop; what is checked is checked
on its public counters and state.
"""

import asyncio
import math
import random
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any

import can

from tools.fuzz.drives import Drive
from tools.fuzz.frame_check import FrameCheck
from tools.fuzz.made_up_bus import MadeUpBus
from tools.fuzz.outcome import Failed
from twostage_servo.api.request_reading import read_request
from twostage_servo.app.build import build_parts
from twostage_servo.app.service_harness import ServiceHarness
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import DRIVEN, ENABLED, State
from twostage_servo.canbus.link import BusSettings
from twostage_servo.control.plant import Plant
from twostage_servo.faults.frames import protocol_of
from twostage_servo.service.runtime import Runtime
from twostage_servo.timing.ticks import Tick, Ticks
from twostage_servo.timing.virtual_clock import VirtualClockLoop

_IN_DRIVE = frozenset(DRIVEN)
_IN_ENABLED = frozenset(ENABLED)


class BenchLoop(VirtualClockLoop):
    """Simulated time that can be moved on without a pass of the loop.

    Attributes
    ----------
    moved_to_s
        The time that it is at least, s.
    """

    moved_to_s = 0.0

    def time(self) -> float:
        """Give the simulated time, s."""
        return max(super().time(), self.moved_to_s)


class ScriptedTicks(Ticks):
    """Ticks that are due as soon as the last one is done, with a script between them.

    Parameters
    ----------
    bench
        What is looked at after each tick, and prepared before the next.
    """

    def __init__(self, bench: "Bench") -> None:
        super().__init__(bench.period_s)
        self._bench = bench
        self._at = 0
        self._ended = False
        self._start_at_s: float | None = None

    async def __anext__(self) -> Tick:
        """Check the tick before, and prepare the next."""
        bench, loop = self._bench, asyncio.get_running_loop()
        assert isinstance(loop, BenchLoop)  # noqa: S101 - the only one that it is made for
        if self._start_at_s is None:
            self._start_at_s = loop.time()
        else:
            bench.check_tick()
        if self._ended:
            raise StopAsyncIteration
        if bench.axis_loop.bus.error is not None:
            await asyncio.sleep(self.period_s)
        await bench.prepare()
        missed, bench.missed_next = bench.missed_next, 0
        bench.periods_ahead = 1 + missed
        self._at += 1 + missed
        deadline_s = self._start_at_s + self._at * self.period_s
        deadline_s = max(deadline_s, loop.time())  # a pass of the loop for somebody else may have taken a period
        bench.bus.now_s = loop.moved_to_s = deadline_s + bench.lateness_next_s
        return Tick(self._at, deadline_s, bench.lateness_next_s, missed)

    def stop(self) -> None:
        """End."""
        self._ended = True


class Bench:
    """A service on the made-up bus, with a drive that answers as an honest one does.

    Parameters
    ----------
    drive
        The configuration.
    rng
        Where everything random comes from.
    prepare
        What is done before each tick; :meth:`idle` by default.

    Attributes
    ----------
    states, trips
        How many ticks each state had, and which trips there were.
    frame_check
        Checks what becomes of each frame, and counts those that were used.
    missed_next, lateness_next_s
        What the next tick comes with.
    periods_ahead
        How many periods the latest command acts.
    """

    def __init__(self, drive: Drive, rng: random.Random, prepare: Callable[[], Awaitable[None]] | None = None) -> None:
        self.drive, self.rng = drive, rng
        self.bus = MadeUpBus(stamps=rng.random() < 0.5)
        interface = "socketcand" if rng.random() < 0.3 else "virtual"  # whose error frames mean something, or do not
        settings = BusSettings(
            interface=interface, channel="made up", max_frames_per_tick=4096, reopen_interval_ms=20.0
        )
        settings = settings.with_frames_of(drive.loaded.config.bus)
        parts = build_parts(drive.loaded, settings, lambda _: self.bus.reopen(), (self._observe,))
        self.axis_loop = axis_loop = parts.axis_loop()
        self.period_s = parts.period_s
        self.harness = ServiceHarness(parts, Runtime(ScriptedTicks(self)))
        self.service = self.harness.service
        self.kinds = drive.kinds
        self.frame_check = FrameCheck(self.bus, axis_loop, self.kinds, parts.period_s)
        self.commands = drive.kinds["command"]
        config = drive.loaded.config
        self.plant = Plant(config.axis.plant.gain, config.axis.plant.pole).discretise(self.period_s)
        self.scale = -1.0 if protocol_of(config).feedback.position_scale < 0.0 else 1.0
        self.limit = min(config.axis.limits.effort, axis_loop.drive.traits.effort_limit) + 1e-9
        self.command_number = axis_loop.drive.command_id.identifier
        self.prepare = prepare or self.idle
        self.position = self.sample = self.velocity = 0.0
        self.counter = self.boots = 0
        self.missed_next, self.lateness_next_s, self.periods_ahead = 0, 0.0, 1
        self.states: Counter[str] = Counter()
        self.trips: Counter[str] = Counter()
        self.refusals: Counter[str] = Counter()
        self.refused = ""
        self.frames = 0
        self.frames_while_driven = 0
        self._trip: object = None
        self._dropped = 0
        self._sends_seen = 0
        self._acting = 0.0
        self._enabled = False

    # What happens --------------------------------------------------------------------------------------------------

    async def idle(self) -> None:
        """Prepare a tick in which the drive answers, and nothing else happens."""
        self.answer_as_drive()

    def answer_as_drive(self, *, heartbeat: bool = True) -> None:
        """Let the drive take the last command and answer it."""
        self._take_command()
        queue = self.bus.queue
        queue.append(self.feedback())
        if heartbeat and "heartbeat" in self.kinds and self.rng.random() < 0.2:
            queue.append(self._message("heartbeat", state=2, boot_counter=self.boots))

    def place_within_limits(self) -> None:
        """Let somebody push an axis that stands beyond its limits, or was shot there, back between them."""
        limits = self.drive.loaded.config.axis.limits
        if not limits.position_minimum <= self.position <= limits.position_maximum:
            self.position = self.rng.uniform(0.9 * limits.position_minimum, 0.9 * limits.position_maximum)
            self.velocity = 0.0

    def feedback(self) -> can.Message:
        """Return the drive's next feedback."""
        self.counter += 1
        values = {"counter": self.counter, "enabled": self._enabled}
        try:
            return self._message("feedback", position=self.sample, **values)
        except ValueError:  # a position that is not finite, where the signal cannot say so
            return self._message("feedback", position=0.0, **values)

    def message(self, name: str, data: bytes | bytearray) -> can.Message:
        """Return a frame of a kind, with these data."""
        kind = self.kinds[name]
        number, extended = kind.identifier
        return can.Message(self.bus.now_s, number, extended, is_fd=kind.fd, data=data)

    def _message(self, name: str, **values: Any) -> can.Message:
        return self.message(name, self.kinds[name].of(**values))

    def _take_command(self) -> None:
        bus, plant = self.bus, self.plant
        if bus.sends != self._sends_seen and bus.sent is not None:
            self._sends_seen = bus.sends
            command = self.commands.decode(bus.sent)
            enable = command.enable is not False and self.axis_loop.command.enable is True
            if (
                not math.isfinite(command.effort)
                or abs(command.effort) > self.limit + self.axis_loop.drive.traits.effort_quantum
            ):
                raise Failed(f"the command on the bus has effort {command.effort}, the limit is {self.limit}")
            self._enabled = enable
            self._acting = command.effort if enable else 0.0
        effort = self._acting
        self.sample = self.position  # as the command arrives: what is read at the next tick
        for _ in range(self.periods_ahead):
            self.position += plant.a12 * self.velocity + plant.b1 * effort
            self.velocity = plant.a22 * self.velocity + plant.b2 * effort

    def ask(self, **request: Any) -> None:
        """Ask the service for something; a refusal is an answer as well."""
        self.refused = ""
        try:
            self.harness.requests.handle(read_request(request))
        except Refused as refusal:
            self.refused = refusal.code
            self.refusals[refusal.code] += 1

    # What is checked -----------------------------------------------------------------------------------------------

    def _observe(self, tick: int, direction: str, number: int, data: bytes) -> None:
        self.frame_check.observe(tick, direction, number, data)

    def check_tick(self) -> None:
        """Check what holds after every tick."""
        service = self.service
        if service.shutdown.failure is not None:
            raise service.shutdown.failure
        axis_loop = self.axis_loop
        axis = axis_loop.axis
        self.states[axis.state.value] += 1
        self._check_command()
        self.frame_check.end_tick()
        if axis.trip is not self._trip:
            self._trip = axis.trip
            if axis.trip is not None:
                self.trips[axis.trip.code.value] += 1
        taken = self.bus.taken
        self._dropped = axis_loop.bus.link.counters.dropped
        self.frames += len(taken)
        if axis.state in _IN_DRIVE:
            self.frames_while_driven += len(taken)
        taken.clear()

    def _check_command(self) -> None:
        """Check that the effort is finite, within its limit, and none on an axis that is not driven."""
        axis_loop, axis = self.axis_loop, self.axis_loop.axis
        state, (effort, enable, _) = axis.state, axis_loop.command
        if not math.isfinite(effort) or abs(effort) > self.limit:
            raise Failed(f"the effort is {effort}, the limit {self.limit}")
        # A command that did not leave may have tripped the axis after it was made.
        written = axis_loop.bus.error is None and axis_loop.bus.link.counters.dropped == self._dropped
        if effort != 0.0 and state not in _IN_DRIVE and written:
            raise Failed(f"the effort is {effort} in state {state}")
        if enable and state not in _IN_ENABLED and written:
            raise Failed(f"the drive is enabled in state {state}")
        if state in _IN_DRIVE and not axis.is_finite:
            raise Failed("the estimate is not finite while the axis is driven")

    def check_end(self) -> None:
        """Check the sums, and that the last command has disabled the drive."""
        sent = self.bus.sent
        if sent is not None and self.axis_loop.bus.error is None and self.bus.trouble is None:
            command = self.commands.decode(sent)
            if command.effort != 0.0 or command.enable:
                raise Failed(f"the last command is {command}, {self.axis_loop.drive.command_id}")
        if self.axis_loop.axis.state in {*DRIVEN, State.ARMING}:
            raise Failed(f"the service has ended in state {self.axis_loop.axis.state}")

    def run(self, prepare: Callable[[], Awaitable[None]]) -> None:
        """Run the service until it is shut down by the script."""
        self.prepare = prepare
        unheard: list[str] = []

        async def main() -> None:
            asyncio.get_running_loop().set_exception_handler(lambda _, context: unheard.append(repr(context)))
            try:
                await self.service.run()
            finally:
                self.bus.shutdown()

        with asyncio.Runner(loop_factory=BenchLoop) as runner:
            runner.run(main())
        if unheard:
            raise Failed(f"unhandled in the loop: {unheard[0]}")
        self.check_end()
