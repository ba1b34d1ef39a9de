"""The operator in simulated time, who brings the axis into the phase in which a fault shall begin."""

import contextlib
from random import Random
from typing import TYPE_CHECKING

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import State
from twostage_servo.config.loader import Config
from twostage_servo.control.laws.law import Stage
from twostage_servo.faults.phase import BRAKED, Phase
from twostage_servo.faults.plan import CRUISE_S, LONG_CRUISE_S, cruise_end, plan_target, settling_begin
from twostage_servo.faults.table import Fault
from twostage_servo.faults.world import World
from twostage_servo.timing.ticks import Tick

if TYPE_CHECKING:
    from collections.abc import Callable

_READY_S = 3.0
"""How long an axis may take to be ready to be armed, or to be armed, in s."""

_AFTER_THE_STOP_S = 0.02
"""How long after an operator's stop in a cruise a fault begins that comes while the axis brakes."""


class NotOperableError(Exception):
    """The axis does not even carry out the campaign's move without a fault."""


async def _declare_position(world: World) -> None:
    """Say where the axis is, again and again like an operator: with a noisy encoder it seems to move now and then.

    Raises
    ------
    NotOperableError
        If that is refused for long.
    """
    refusal = ""

    def is_declared() -> bool:
        nonlocal refusal
        try:
            world.axis.set_position(world.drive.position)
        except Refused as refused:
            refusal = str(refused)
            return False
        return True

    if not await world.until(is_declared, _READY_S):
        raise NotOperableError(f"the axis could not be told its position before the fault: {refusal}")


class SimulatedApproach:
    """One way into a phase.

    Parameters
    ----------
    config
        The configuration of the axis.
    design
        The axis.
    phase, fault
        Where to, and what begins there.
    random
        Of the length of the move, and of the moment between two ticks.
    """

    def __init__(self, config: Config, design: AxisDesign, phase: Phase, fault: Fault, random: Random) -> None:
        self._config = config
        self._design = design
        self._phase = phase
        self._fault = fault
        self._random = random

    async def make(self, world: World) -> None:
        """Bring the axis into the phase.

        Raises
        ------
        NotOperableError
            If it does not come there.
        """
        self._plan(world)
        if self._fault.prepare is not None:
            await self._prepare(world)
        if not await world.until(lambda: world.axis.ready_to_arm, _READY_S):
            obstacle = world.axis.obstacle_to_arming()
            raise NotOperableError(f"the axis could not be armed before the fault: {obstacle and obstacle[1]}")
        if not world.axis.referenced:
            await _declare_position(world)
        await world.companions.start(_READY_S)
        await self._reach_the_phase(world)
        await world.seconds(self._random.uniform(0.0, world.period_s))
        if self._phase in BRAKED:
            world.axis.stop(quick=self._phase is Phase.QUICK_STOPPING)
            await world.seconds(_AFTER_THE_STOP_S)
        if self._phase is Phase.HOLDING:
            world.turn_back()  # with the next move

    def _plan(self, world: World) -> None:
        cruise_s = LONG_CRUISE_S if self._fault.velocity_limit else CRUISE_S
        axis = self._config.axis
        velocity = axis.limits.velocity if self._fault.velocity_limit else axis.cruise_velocity
        start, share = world.drive.position, self._random.random()
        target = plan_target(self._design, start, velocity, share, cruise_s)
        if self._phase is Phase.HOMING:
            homing = world.axis.settings.homing
            velocity = homing.velocity if homing.method == "switch" else homing.slow_velocity
            target = start + (homing.travel if homing.direction == "positive" else -homing.travel)
        world.plan(start, target, velocity)

    async def _prepare(self, world: World) -> None:
        ahead = {Phase.IDLE: 0.5, Phase.ACCELERATING: 0.02, Phase.CRUISING: 0.5, Phase.CHANGEOVER: 0.9}
        share = ahead.get(self._phase, 0.99)
        world.plan_wrap(share * (world.target - world.start))
        assert self._fault.prepare is not None  # noqa: S101 - the caller has looked
        self._fault.prepare(world)
        await world.until(lambda: not world.axis.drive.is_stale, _READY_S)
        await world.seconds(5.0 * world.period_s)
        await _declare_position(world)
        await world.seconds(2.0 * world.period_s)

    async def _reach_the_phase(self, world: World) -> None:
        if self._phase is Phase.IDLE:
            return
        await arm(world)
        if self._phase is Phase.HOMING:
            world.axis.home()
        elif self._phase is Phase.JOGGING:
            _keep_jogging(world)
        else:
            world.axis.move_to(world.target, world.velocity)
        reached: Callable[[], bool] = {
            Phase.ACCELERATING: lambda: abs(_nominal_velocity(world)) >= 0.5 * world.velocity,
            **dict.fromkeys((Phase.CRUISING, *BRAKED), lambda: self._cruises(world)),
            Phase.CHANGEOVER: lambda: world.axis.stage is Stage.POSITION,
            Phase.SETTLING: lambda: (
                world.axis.stage is Stage.POSITION
                and world.axis.distance_to_go <= settling_begin(self._design, world.velocity)
            ),
            Phase.HOLDING: lambda: world.axis.state is State.HOLDING,
            Phase.HOMING: lambda: world.axis.state is State.HOMING and _is_up_to_speed(world),
            Phase.JOGGING: lambda: world.axis.state is State.JOGGING and _is_up_to_speed(world),
        }[self._phase]
        if not await world.until(reached, 60.0):
            trip = world.axis.trip
            raise NotOperableError(
                f"the axis did not reach {self._phase.value} in a move by {abs(world.target - world.start):.4g} at "
                f"{world.velocity:g} without a fault: {trip.cause if trip else 'it took too long'}"
            )

    def _cruises(self, world: World) -> bool:
        """Whether the speed has settled; near the end of the cruise, or at its beginning where it has to be long."""
        velocity = world.velocity
        if self._fault.velocity_limit:
            return _is_up_to_speed(world)
        near = cruise_end(self._design, velocity)
        return abs(world.axis.speed_reference) >= 0.999 * velocity and world.axis.distance_to_go <= near


async def arm(world: World) -> None:
    """Arm the axis, and wait until it holds or trips.

    Raises
    ------
    Refused
        If it cannot be armed.
    """
    shutdown = world.service.shutdown
    if shutdown.is_ending:
        raise Refused(RefusalCode.ENDING, "the service is ending")
    await world.until(lambda: world.axis.ready_to_arm or shutdown.is_ending, max(0.2, 5.0 * world.period_s))
    world.axis.arm()
    await world.until(lambda: world.axis.state is State.HOLDING or world.axis.trip is not None, _READY_S)


def _nominal_velocity(world: World) -> float:
    return world.axis.nominal.velocity


def _is_up_to_speed(world: World) -> bool:
    return abs(_nominal_velocity(world)) >= 0.97 * world.velocity


def _keep_jogging(world: World) -> None:
    """Jog, and renew it as an operator does, twice in each time-out, for as long as the axis jogs."""
    axis, velocity = world.axis, world.heading * world.velocity
    every = max(1, int(axis.settings.jog_timeout_ms / (2e3 * world.period_s)))
    axis.jog(velocity)
    due = 0

    def renew(tick: Tick) -> None:
        nonlocal due
        if tick.index >= due and axis.state is State.JOGGING:  # a remainder of the index could be one that is missed
            due = tick.index + every
            with contextlib.suppress(Refused):
                axis.jog(velocity)

    world.loop.listen(renew)
