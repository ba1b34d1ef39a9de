"""The whole service over CAN frames, in simulated time: random clients, faults of bus, drive and host by seed."""

import asyncio
import errno
import math
from random import Random
from typing import TYPE_CHECKING

import can
from invariants import BrokenInvariantError, Invariants
from pydantic import ValidationError

from twostage_servo.axis.messages import Refused
from twostage_servo.axis.state import State
from twostage_servo.config import load
from twostage_servo.faults import bus_faults, host_faults
from twostage_servo.faults.world import SERVICE, World, operate
from twostage_servo.service.requests import REQUESTS
from twostage_servo.simulation.virtual_clock import run

if TYPE_CHECKING:
    from collections.abc import Callable

_CLIENTS = ("alice", "bob", "eve")
_READING = frozenset({"status", "recording"})


class ServiceSoak:
    """One service with its drive in random operation.

    Parameters
    ----------
    seed
        Of everything.
    """

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)  # noqa: S311 - a soak, no secret
        self.seed = seed
        self.requests = self.refusals = self.trips = self.moves_reached = 0
        self.ticks = 0
        self._reported_trip: object = None
        self._pace_s = 1.0

    def run(self, simulated_s: float) -> None:
        """Run for a simulated time in s."""
        run(self._run(simulated_s))

    async def _run(self, simulated_s: float) -> None:
        overrides = [f"simulation.seed={self.seed}", "simulation.noise_std=0.005", "simulation.cycle_ms=5"]
        async with operate(load(None, overrides)) as world:
            world.keeps_samples = False
            self.invariants = Invariants(world.axis)
            world.service.publishers.append(lambda _: self._look(world))
            while world.now_s < simulated_s:
                await asyncio.sleep(self.random.expovariate(1.0 / self._pace_s))
                if world.serving is not None and world.serving.done():
                    raise BrokenInvariantError(f"the service ended: {world.serving.exception()!r}")
                self._something_happens(world)
            self.ticks = world.service.statistics.count

    def _look(self, world: World) -> None:
        self.invariants.look(world.station.command, world.drive.position)
        if world.drive.faults.load and not world.drive.enabled:
            world.change(load=0.0)  # an axis that can fall has a brake
        if world.axis.trip is not self._reported_trip:
            self._reported_trip = world.axis.trip
            self.trips += world.axis.trip is not None

    def _something_happens(self, world: World) -> None:
        random = self.random
        choice = random.random()
        if choice < 0.03:
            self._pace_s = random.choice((0.1, 1.0, 3.0, 10.0))
        if choice < 0.75:
            self._operate(world)
        elif choice < 0.90:
            self._disturb_bus(world)
        elif choice < 0.97:
            self._disturb_drive(world)
        else:
            random.choice((host_faults.stall(0.012), host_faults.stall(0.05), host_faults.wall_clock_jumps))(
                world, random
            )

    def _disturb_bus(self, world: World) -> None:
        random = self.random
        fault: Callable[[World, Random], None] = random.choice((
            bus_faults.lose(1), bus_faults.lose(2), bus_faults.lose(4), bus_faults.double, bus_faults.reorder,
            bus_faults.delay_within_a_tick, bus_faults.delay_beyond_a_tick, bus_faults.malformed,
            bus_faults.error_passive, bus_faults.bus_off, bus_faults.interface_down,
        ))  # fmt: skip
        fault(world, random)
        if random.random() < 0.2:
            node = world.wire.node(SERVICE)
            node.send_error = can.CanOperationError("No buffer space available", errno.ENOBUFS)
            world.later(random.choice((0.011, 0.04)), lambda: setattr(node, "send_error", None))

    def _disturb_drive(self, world: World) -> None:
        random = self.random
        for_s = random.uniform(0.01, 1.0)
        match random.randrange(6):
            case 0:
                world.change(safe_torque_off=True)
                world.later(for_s, lambda: world.change(safe_torque_off=False))
            case 1:
                world.change(fault_code=random.randint(2, 9))
                world.later(for_s, lambda: world.change(fault_code=0))
            case 2:
                world.change(heartbeat_silent=True)
                world.later(for_s, lambda: world.change(heartbeat_silent=False))
            case 3:
                world.change(load=random.uniform(-10.0, 10.0))
            case 4:
                world.change(gain_factor=random.uniform(0.7, 1.3), pole_factor=random.uniform(0.7, 1.3))
            case _:
                ahead = random.random() < 0.5
                world.change(positive_limit=ahead, negative_limit=not ahead)
                world.later(for_s, lambda: world.change(positive_limit=None, negative_limit=None))

    def _operate(self, world: World) -> None:
        """Let a client ask for something: mostly sensible, sometimes not, sometimes out of turn."""
        random, axis = self.random, world.axis
        client = _CLIENTS[0] if random.random() < 0.8 else random.choice(_CLIENTS)
        if random.random() < 0.02:
            world.service.desk.leave(client)
            return
        if axis.trip is not None:
            self._ask(world, {"op": "reset"}, client)
        elif axis.state is State.DISARMED:
            if not axis.referenced:
                self._ask(world, {"op": "home", "position": round(world.drive.position, 3)}, client)
            self._ask(world, {"op": "arm"}, client)
        else:
            self._ask(world, self._command(world), client)

    def _command(self, world: World) -> dict[str, object]:
        random, limits = self.random, world.axis.settings.limits
        velocity = random.uniform(0.1, 1.0) * limits.velocity
        target = random.uniform(limits.position_minimum, limits.position_maximum)
        move = world.axis.move
        self.moves_reached += move is not None and move.outcome == "reached"
        return dict(random.choice((
            {"op": "stop", "quick": random.random() < 0.5},
            {"op": "disarm"},
            {"op": "jog", "velocity": velocity},
            {"op": "jog", "velocity": -velocity},
            {"op": "move", "position": random.choice((1e9, math.nan, -math.inf, 1e300))},
            {"op": random.choice(("status", "recording", "release", "take", "reload", "arm", "reset"))},
            *[{"op": "move", "by": random.uniform(-20.0, 20.0), "velocity": velocity}] * 4,
            *[{"op": "move", "position": target, "velocity": velocity}] * 6,
        )))  # fmt: skip

    def _ask(self, world: World, request: dict[str, object], client: str) -> None:
        """Ask for something: it is answered or refused; anything else ends the soak."""
        self.requests += 1
        try:
            answer = world.service.handle(REQUESTS.validate_python(request), client)
        except (Refused, ValidationError):
            self.refusals += 1
        else:
            if not answer:
                raise BrokenInvariantError(f"{request} was answered by nothing")
