"""What goes wrong around a soaked service: its bus, its drive, its host, its clients."""

import asyncio
import errno
import os
import resource
import signal
from random import Random
from typing import TYPE_CHECKING

import can

from tools.soak.bad_clients import ANSWERED_WITHIN_S, BadClients
from tools.soak.drive_watch import DriveWatch
from tools.soak.encoder_watch import ENCODER_FACTORS, EncoderWatch
from twostage_servo.api.requests import StatusRequest, StopRequest
from twostage_servo.axis.state import COMMANDED, DRIVEN, ENABLED, State
from twostage_servo.faults import bus_faults, host_faults
from twostage_servo.faults.world import SERVICE, World

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

ENDING = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2)
"""Signals that end a process which does not catch them; SIGINT is kept by the loop that this runs in."""

_SETTLED_TICKS = 5
"""Ticks after which a request that was sent has been carried out, or never will be."""


class ServiceMishaps:
    """One mishap at a time.

    Parameters
    ----------
    world, clients, watch
        The service with its drive, who else is at its socket, and what watches its encoder.
    random
        Of everything.
    without
        Kinds of faults that are left out.

    Attributes
    ----------
    broken
        What did not hold, or None.
    has_ended
        Whether the service was told to end.
    encoder_faults
        Encoders that have failed so far.
    """

    def __init__(
        self, world: World, clients: BadClients, watch: EncoderWatch, random: Random, without: frozenset[str]
    ) -> None:
        self._world = world
        self._clients = clients
        self._watch = watch
        self._random = random
        self.broken: str | None = None
        self.has_ended = False
        self._drive_watch = DriveWatch(world.axis, world.drive)
        self.encoder_faults = 0
        self._backlog_until_s = 0.0
        of_kind: dict[str, tuple[Callable[[], Awaitable[None]], ...]] = {
            "bus": (self._disturb_bus,) * 12,
            "drive state": (self._disturb_drive,) * 7,
            "host": (self._disturb_host,) * 3,
            "encoder": (self._encoder_fails,) * 6,
            "drive": (self._stay_enabled, self._creep) * 2,
            "backlog": (self._backlog,) * 2,
            "clients": (self._hostile_client, self._hostile_client, self._gone_at_once, self._stop_by_a_fresh_client),
            "descriptors": (self._no_descriptor_left,),
            "socket": (self._socket_deleted,),
            "signals": (self._signal,),
        }
        self._mishaps = [act for kind, acts in of_kind.items() if kind not in without for act in acts]

    async def happen(self) -> None:
        """Let one of them happen."""
        await self._random.choice(self._mishaps)()

    def check(self) -> None:
        """Check a tick: a load acts while the drive is enabled, since an axis that can fall has a brake."""
        world = self._world
        if world.drive.faults.load and not world.drive.enabled:
            world.change(load=0.0)
        self.broken = self.broken or self._drive_watch.check(reported=world.axis.drive.enabled_report is not None)

    @property
    def drive_disobeys(self) -> bool:
        """Whether the drive has moved an axis that was disarmed, which may be anywhere until it is armed again."""
        return self._drive_watch.disobeyed

    # Bus, drive, host ------------------------------------------------------------------------------------------------

    async def _disturb_bus(self) -> None:
        random, world = self._random, self._world
        fault: Callable[[World, Random], None] = random.choice((
            bus_faults.lose(1), bus_faults.lose(2), bus_faults.lose(4), bus_faults.double, bus_faults.reorder,
            bus_faults.delay_within_a_tick, bus_faults.delay_beyond_a_tick, bus_faults.malformed,
            bus_faults.error_passive, bus_faults.bus_off, bus_faults.interface_down,
        ))  # fmt: skip
        fault(world, random)
        if random.random() < 0.2:
            node = world.wire.node(SERVICE)
            node.fail_to_send(can.CanOperationError("No buffer space available", errno.ENOBUFS))
            world.later(random.choice((1.1, 4.0)) * world.period_s, lambda: node.fail_to_send(None))

    async def _disturb_drive(self) -> None:
        random, world = self._random, self._world
        limits = world.axis.settings.limits
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
                world.change(load=random.uniform(-0.4, 0.4) * limits.effort)
            case 4:
                world.change(gain_factor=random.uniform(0.7, 1.3), pole_factor=random.uniform(0.7, 1.3))
            case _:
                ahead = random.random() < 0.5
                world.change(positive_limit=ahead, negative_limit=not ahead)
                world.later(for_s, lambda: world.change(positive_limit=None, negative_limit=None))

    async def _disturb_host(self) -> None:
        tick_s = self._world.period_s
        fault = self._random.choice(
            (host_faults.suspend(1.2 * tick_s), host_faults.suspend(5.0 * tick_s), host_faults.wall_clock_jumps)
        )
        fault(self._world, self._random)

    async def _backlog(self) -> None:
        """Let foreign frames arrive, more in a tick than it reads, for half a second."""
        if self._world.now_s > self._backlog_until_s:
            self._backlog_until_s = self._world.now_s + 1.0
            bus_faults.back_up(self._world, self._random)

    # A drive that does not obey --------------------------------------------------------------------------------------

    async def _stay_enabled(self) -> None:
        """Let the power stage stay on for a time, whatever it is told."""
        world = self._world
        world.change(stays_enabled=True)
        patience_s = world.axis.settings.arming_timeout_ms / 1e3
        world.later(self._random.uniform(0.0, 6.0 * patience_s), lambda: world.change(stays_enabled=False))

    async def _creep(self) -> None:
        """Let the drive of an axis that is disarmed and at rest move it, and say that it is disabled."""
        world, axis = self._world, self._world.axis
        if axis.state not in ENABLED and abs(world.drive.velocity) <= axis.design.rest_velocity:
            effort = self._random.choice((-1.0, 1.0)) * self._random.uniform(0.02, 0.5) * axis.settings.limits.effort
            world.change(effort_while_disabled=effort)
            world.later(self._random.uniform(0.05, 3.0), lambda: world.change(effort_while_disabled=0.0))

    # The encoder -----------------------------------------------------------------------------------------------------

    async def _encoder_fails(self) -> None:
        """Let the encoder count wrongly from here on, in whatever state the axis is driven."""
        world, axis = self._world, self._world.axis
        if world.drive.faults.load:  # one fault at a time: an estimate with a load that has just gone is wrong
            world.change(load=0.0)
            return
        if axis.state not in DRIVEN or self._watch.in_doubt or world.now_s < self._backlog_until_s:
            return
        world.wire.restore()
        factor, place = self._random.choice(list(ENCODER_FACTORS.values())), world.place()
        measure = world.drive.faults.measure or (lambda position: position)
        world.change(measure=lambda position: measure(place) + factor * (position - place))
        self.encoder_faults += 1
        self._watch.begin(factor, place, world.drive.velocity, world.drive.faults.gain_factor)

    def mend_encoder(self) -> None:
        """Mend the encoder of an axis that is disarmed; what it counts from then on may be off."""
        world, place = self._world, self._world.place()
        measure = world.drive.faults.measure
        if measure is not None:
            offset = 0.0 if self._random.random() < 0.5 else measure(place) - place
            world.change(measure=(lambda position: position + offset) if offset else None)
        self._watch.mended()

    # Clients ---------------------------------------------------------------------------------------------------------

    async def _hostile_client(self) -> None:
        self._clients.begin()

    async def _gone_at_once(self) -> None:
        """Let a client go whose request has not been read: nothing may come of it."""
        world, axis = self._world, self._world.axis
        state = axis.state
        if state not in {State.DISARMED, State.HOLDING}:
            return
        target = 0.5 * axis.settings.limits.position_maximum
        request: dict[str, object] = {"op": "arm"} if state is State.DISARMED else {"op": "move", "position": target}
        move = axis.move
        await self._clients.gone_at_once(request)
        await asyncio.sleep(_SETTLED_TICKS * world.period_s)
        if axis.state is State.ARMING or (axis.state in COMMANDED and axis.move is not move):
            self.broken = f"{request} was carried out, though who had asked for it was gone: the axis is {axis.state}"

    async def _stop_by_a_fresh_client(self) -> None:
        """Let a fresh client stop the axis, whoever else is at the socket: it has to be answered."""
        if not await self._clients.is_answered(StopRequest()) and not self._serving_has_ended():
            self.broken = f"a fresh client's stop was not answered within {ANSWERED_WITHIN_S:g} s"

    async def _no_descriptor_left(self) -> None:
        """Let the process have no more descriptors for a second; the service has to live on."""
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
        try:
            self._world.axis.stop() if self._world.axis.can_stop else None
            await asyncio.sleep(1.0)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))

    async def _socket_deleted(self) -> None:
        """Delete the control socket: it has to be there again."""
        self._clients.path.unlink(missing_ok=True)
        for _ in range(10):
            await asyncio.sleep(1.0)
            if await self._clients.is_answered(StatusRequest()) or self._serving_has_ended():
                return
        self.broken = "the control socket was deleted, and has not been made again for 10 s"

    async def _signal(self) -> None:
        """Let the process receive a signal that would end it: the axis comes to rest, and the drive is disabled."""
        world = self._world
        self.has_ended = True
        ending = [number for number in ENDING if signal.getsignal(number) is not signal.SIG_IGN]
        os.kill(os.getpid(), self._random.choice(ending))
        await asyncio.sleep(world.service.shutdown.settings.shutdown_timeout_ms / 1e3 + 20.0 * world.period_s)
        if not self._serving_has_ended():
            self.broken = f"the service has not ended; the axis is {world.axis.state}"
        elif world.drive.enabled and not world.drive.faults.stays_enabled:
            self.broken = "the service has ended, and the drive is enabled"

    def _serving_has_ended(self) -> bool:
        return self._world.serving.done()
