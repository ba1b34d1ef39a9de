"""The whole service over CAN frames, in simulated time: random clients, faults of bus, drive and host by seed.

A soak is a row of lives: each is a service with a drive of its own, from its start to a signal, to an axis that only a
hand could bring back, or to the end of its time.
"""

import asyncio
import gc
import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from tools.soak.bad_clients import BadClients
from tools.soak.configurations import drawn_by
from tools.soak.encoder_watch import EncoderWatch
from tools.soak.invariants import BrokenInvariantError, Invariants
from tools.soak.service_mishaps import ServiceMishaps
from twostage_servo.api.request_reading import read_request
from twostage_servo.api.requests import BadRequestError
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import DRIVEN, ENABLED, State
from twostage_servo.faults.world import World, operate
from twostage_servo.service.ending_signals import EndingSignals
from twostage_servo.timing.virtual_clock import run

if TYPE_CHECKING:
    from twostage_servo.axis.axis import Axis

_CLIENTS = ("alice", "bob", "eve")
_LIFE_TICKS = 15_000
_MOST_ENCODER_EVENTS = 30
"""Events after which the operator mends an encoder that nobody has noticed, as one is that fails at standstill."""

_SHOWN_AFTER_TICKS = 4
"""Who mends an encoder says where the axis is when the drive has reported that, with all the delays of a bus: the count
must not change behind it. Up to a speed that a hand may have, nobody can see that it has."""


class ServiceSoak:
    """One service after another, each with its drive in random operation.

    Parameters
    ----------
    seed
        Of everything.
    without
        Kinds of faults that are left out; see :data:`run.FAULTS`.
    """

    def __init__(self, seed: int, without: frozenset[str] = frozenset()) -> None:
        self.configuration, self.random = drawn_by(seed)
        self.configuration.check()
        self.seed = seed
        self.without = without
        self.requests = self.refusals = self.trips = self.moves_reached = self.encoder_faults = 0
        self.ticks = 0
        self.closest = self.farthest = 0.0
        self._ticks_before = 0
        self._encoder_events = 0
        self._mended_at = 0
        self._was_homing = False
        self._reported_trip: object = None
        self._pace_s = 1.0

    def run(self, ticks: int) -> None:
        """Run for so many ticks."""
        run(self._run(ticks))

    async def _run(self, ticks: int) -> None:
        before = None
        while self.ticks < ticks:
            await self._live(min(self.ticks + _LIFE_TICKS, ticks))
            self._ticks_before = self.ticks
            gc.collect()
            left = len(asyncio.all_tasks()), open_descriptors()
            if before is not None and (left[0] > before[0] or left[1] > before[1]):
                raise BrokenInvariantError(
                    f"{left[0]} tasks and {left[1]} descriptors are left after a service's end; {before[0]} and "
                    f"{before[1]} were after the one before"
                )
            before = left

    async def _live(self, until: int) -> None:
        random = self.random
        noise = random.choice((0.0, 5.0)) * self.configuration.load().config.simulation.quantum
        overrides = [f"simulation.seed={self.seed}", f"simulation.noise_std={noise!r}"]
        with tempfile.TemporaryDirectory(prefix="soak-") as folder:
            async with operate(self.configuration.load(*overrides)) as world:
                world.keep_no_samples()
                control = world.loop.control_socket(Path(folder) / "control.sock")
                await control.start()
                clients = BadClients(control.path, random)
                try:
                    with EndingSignals() as signals:
                        signals.call(world.service.shut_down, asyncio.get_running_loop())
                        await self._operate(world, clients, until)
                finally:
                    await clients.end()
                    await control.stop()

    async def _operate(self, world: World, clients: BadClients, until: int) -> None:
        self.watch, self.invariants = EncoderWatch(world.axis), Invariants(world.axis)
        mishaps = ServiceMishaps(world, clients, self.watch, self.random, self.without)
        world.loop.listen(lambda _: self._check(world, mishaps))
        while self.ticks < until and not mishaps.has_ended:
            await asyncio.sleep(self.random.expovariate(1.0 / self._pace_s) * 100.0 * world.period_s)
            if world.serving.done() and not mishaps.has_ended:
                raise BrokenInvariantError(f"the service ended: {world.serving.exception()!r}")
            await self._something_happens(world, mishaps)
            if mishaps.broken is not None:
                raise BrokenInvariantError(mishaps.broken)
            limits = world.axis.settings.limits
            inside = limits.position_minimum <= world.drive.position <= limits.position_maximum
            if not inside and world.axis.state not in ENABLED:
                break  # only a hand could bring it back
        self.encoder_faults += mishaps.encoder_faults

    def _check(self, world: World, mishaps: ServiceMishaps) -> None:
        command, position = world.axis_loop.command, world.drive.position
        self.invariants.check(command, position, place_known=not (self.watch.in_doubt or mishaps.drive_disobeys))
        self.ticks = self._ticks_before + self.invariants.ticks
        self.farthest = max(self.farthest, self.invariants.farthest)
        wrong = self.watch.check(position, world.drive.velocity, command.effort)
        self.closest = max(self.closest, self.watch.closest)
        if wrong is not None:
            raise BrokenInvariantError(wrong)
        mishaps.check()
        is_homing = world.axis.state is State.HOMING
        if (
            self._was_homing
            and not is_homing
            and world.axis.move is not None
            and world.axis.move.outcome is MoveOutcome.REACHED
        ):
            self.watch.placed(world.drive.velocity)
        self._was_homing = is_homing
        if world.axis.trip is not self._reported_trip:
            self._reported_trip = world.axis.trip
            self.trips += world.axis.trip is not None

    async def _something_happens(self, world: World, mishaps: ServiceMishaps) -> None:
        random = self.random
        if random.random() < 0.03:
            self._pace_s = random.choice((0.1, 0.3, 1.0, 3.0))
        if self.watch.active:  # one fault at a time: beside this one there are the operators alone
            self._encoder_events += 1
            if self._encoder_events <= _MOST_ENCODER_EVENTS:
                self._ask_something(world, mishaps)
            elif world.axis.state in ENABLED:
                world.axis.disarm()
            else:
                self._mend_encoder(mishaps)
        elif random.random() < 0.75 or mishaps.drive_disobeys:
            self._encoder_events = 0
            self._ask_something(world, mishaps)
        else:
            await mishaps.happen()

    def _ask_something(self, world: World, mishaps: ServiceMishaps) -> None:
        """Let a client ask for something: mostly sensible, sometimes not, sometimes out of turn."""
        random, axis = self.random, world.axis
        client = _CLIENTS[0] if random.random() < 0.8 else random.choice(_CLIENTS)
        if random.random() < 0.02:
            world.requests.disconnect(client)
            return
        if axis.trip is not None:
            if self.watch.active and axis.state is State.TRIPPED and random.random() < 0.6:
                self._mend_encoder(mishaps)
            self._ask(world, {"op": "reset"}, client)
        elif axis.state is State.DISARMED:
            self._arm(world, client)
        else:
            at_rest, request = axis.state is State.HOLDING, self._command(axis)
            if self._ask(world, request, client) and axis.state in DRIVEN:
                velocity = request.get("velocity", axis.settings.homing.velocity)
                if request["op"] in {"move", "jog", "home"} and isinstance(velocity, float):
                    self.watch.move_asked(world.place(), abs(velocity), world.drive.velocity, at_rest=at_rest)

    def _mend_encoder(self, mishaps: ServiceMishaps) -> None:
        mishaps.mend_encoder()
        self._mended_at = self.ticks

    def _arm(self, world: World, client: str) -> None:
        axis = world.axis
        if self.ticks < self._mended_at + _SHOWN_AFTER_TICKS:
            return
        by_hand = axis.settings.homing.method == "set_here" or self.random.random() < 0.3
        if not axis.referenced and by_hand and self._ask(world, {"op": "home", "position": world.place()}, client):
            self.watch.placed(world.drive.velocity)
        self._ask(world, {"op": "arm"}, client)

    def _command(self, axis: "Axis") -> dict[str, object]:
        random, limits = self.random, axis.settings.limits
        velocity = random.uniform(0.1, 1.0) * limits.velocity
        target = random.uniform(limits.position_minimum, limits.position_maximum)
        near = 0.08 * limits.velocity
        move = axis.move
        self.moves_reached += move is not None and move.outcome is MoveOutcome.REACHED
        return dict(random.choice((
            {"op": "stop", "quick": random.random() < 0.5},
            {"op": "disarm"},
            {"op": "jog", "velocity": velocity},
            {"op": "jog", "velocity": -velocity},
            *[{"op": "home"}] * (0 if axis.settings.homing.method == "set_here" else 2 if axis.referenced else 20),
            {"op": "move", "position": random.choice((1e9, math.nan, -math.inf, 1e300))},
            {"op": random.choice((
                "status", "recording", "release", "acquire", "preempt", "reload", "arm", "reset", "forget",
            ))},
            *[{"op": "move", "by": random.uniform(-near, near), "velocity": velocity}] * 4,
            *[{"op": "move", "position": target, "velocity": velocity}] * 6,
        )))  # fmt: skip

    def _ask(self, world: World, request: dict[str, object], client: str) -> bool:
        """Ask for something, and return whether it was carried out; what is neither that nor refused ends the soak."""
        self.requests += 1
        try:
            answer = world.requests.handle(read_request(request), client)
        except (Refused, BadRequestError):
            self.refusals += 1
            return False
        if not answer:
            raise BrokenInvariantError(f"{request} was answered by nothing")
        return True


def open_descriptors() -> int:
    """Return how many descriptors this process has open."""
    return len(list(Path("/proc/self/fd").iterdir()))
