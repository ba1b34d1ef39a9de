"""One run of a fault: an operator brings the axis into a phase, the fault begins, and the operator goes on."""

import contextlib
from dataclasses import dataclass
from random import Random
from typing import TYPE_CHECKING

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import COMMANDED, State
from twostage_servo.config.machine import Machine
from twostage_servo.control.laws.law import Stage
from twostage_servo.faults.phase import BRAKED, SEARCHING, Phase
from twostage_servo.faults.plan import CRUISE_S, LONG_CRUISE_S, cruise_end, plan_target, settling_begin
from twostage_servo.faults.table import (
    HELD,
    LETTERS,
    REFUSED,
    TOLERATED,
    Fault,
)
from twostage_servo.faults.world import Sample, World, operate
from twostage_servo.timing.ticks import Tick

if TYPE_CHECKING:
    from collections.abc import Callable

_READY_S = 3.0
_WAIT_S = 0.3
"""How long the operator waits at least, where the axis is at rest."""
_AFTER_S = 0.5
_SEARCH_S = 1.0
"""How long an operator lets a search or a jog go on after the fault, before stopping it."""

AFTER_THE_STOP_S = 0.02
"""How long after an operator's stop in a cruise a fault begins that comes while the axis brakes."""


class NotOperableError(Exception):
    """The axis does not even carry out the campaign's move without a fault."""


@dataclass(slots=True)
class Outcome:
    """What a script saw: when and where the fault began and the last move after it, and all the rest."""

    fault_s: float
    begun_s: float
    ended_s: float
    at_rest: bool
    place: float
    fault_place: float
    to_go: float
    samples: list[Sample]
    observed: str
    trip: str
    wrong: str


class Script:
    """One run: bring the axis into the phase, let the fault begin, and go on as an operator would.

    Parameters
    ----------
    machine
        The configuration in which it is played.
    design
        The axis that has the fault.
    seed
        Of everything that is random.
    phase, fault
        What begins, and when.
    reference
        The same run without the fault; None to make it.
    """

    def __init__(
        self, machine: Machine, design: AxisDesign, seed: int, phase: Phase, fault: Fault, reference: Outcome | None
    ) -> None:
        self._machine = machine
        self._design = design
        self._config = machine.axis(design.settings.name).config
        self._phase = phase
        self._fault = fault
        self._reference = reference
        self._inject = reference is not None
        # Two sequences, so that the run without the fault is the same up to it.
        self._random = Random(f"{seed} {phase}")  # noqa: S311 - moments and targets, no secrets
        self._sizes = Random(f"{seed} {phase} {fault.number} {fault.name}")  # noqa: S311 - likewise
        self._observed = TOLERATED
        self._code = ""
        self._states_before = 0
        self._states_end: int | None = None
        self._begun_s = self._place = self._fault_place = self._to_go = 0.0

    async def play(self) -> Outcome:
        """Play it, and return what was seen.

        Raises
        ------
        NotOperableError
            If the axis does not even carry out what comes before the fault.
        """
        async with operate(self._machine, self._config.axis.name) as world:
            self._plan(world)
            if self._fault.prepare is not None:
                await self._prepare(world)
            if not await world.until(lambda: world.axis.ready_to_arm, _READY_S):
                obstacle = world.axis.obstacle_to_arming()
                raise NotOperableError(f"the axis could not be armed before the fault: {obstacle and obstacle[1]}")
            if not world.axis.referenced:
                world.axis.set_position(world.drive.position)
            await world.companions.start(_READY_S)
            await self._reach_the_phase(world)
            await world.seconds(self._random.uniform(0.0, world.period_s))
            if self._phase in BRAKED:
                world.axis.stop(quick=self._phase is Phase.QUICK_STOPPING)
                await world.seconds(AFTER_THE_STOP_S)
            if self._phase is Phase.HOLDING:
                world.turn_back()  # with the next move
            fault_s, self._states_before = world.now_s, len(world.samples)
            world.companions.forget()
            self._begun_s, self._place = fault_s, world.place()
            self._fault_place = self._place
            world.begin_fault(fault_s, self._place, () if self._reference is None else self._reference.samples)
            self._to_go = abs(world.target - self._place)
            if self._reference is not None:
                self._fault.inject(world, self._sizes)
            await self._go_on(world)
            await world.seconds(self._fault.shows_s(self._config))
            world.record_sample()  # a service that has ended makes no ticks, and its axis may go on
            observed, code = self._observe(world)
            # What a check does to the axis is no travel any more.
            samples, ended_s = list(world.samples), world.now_s
            at_rest = abs(world.drive.velocity) <= world.axis.design.rest_velocity
            wrong = await world.companions.complaint(shared=self._fault.shared) if self._inject else ""
            if self._fault.check is not None and self._inject:
                wrong = "; ".join(filter(None, (wrong, await self._fault.check(world))))
            return Outcome(
                fault_s,
                self._begun_s,
                ended_s,
                at_rest,
                self._place,
                self._fault_place,
                self._to_go,
                samples,
                observed,
                code,
                wrong,
            )

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
        world.axis.set_position(world.drive.position)
        await world.seconds(2.0 * world.period_s)

    async def _reach_the_phase(self, world: World) -> None:
        if self._phase is Phase.IDLE:
            return
        await self._arm(world)
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

    @property
    def _wait_s(self) -> float:
        """How long a fault has to show before the operator goes on, where the axis is at rest, in s."""
        return max(_WAIT_S, self._config.axis.limits.heartbeat_ms / 1e3)

    def _cruises(self, world: World) -> bool:
        """Whether the speed has settled; near the end of the cruise, or at its beginning where it has to be long."""
        velocity = world.velocity
        if self._fault.velocity_limit:
            return _is_up_to_speed(world)
        near = cruise_end(self._design, velocity)
        return abs(world.axis.speed_reference) >= 0.999 * velocity and world.axis.distance_to_go <= near

    async def _go_on(self, world: World) -> None:
        """Do what an operator would do next, until the axis is at rest."""
        if self._phase is Phase.IDLE:
            await world.seconds(self._wait_s)
            if not await self._try_to_arm(world):
                return
            if world.axis.state is State.HOLDING:
                # Arming catches an axis that seems to move by the noise of two samples, as after a suspension: no
                # reaction.
                self._states_before = len(world.samples)
            await self._move(world)
        elif self._phase is Phase.HOLDING:
            await world.seconds(self._wait_s)
            await self._move(world)
        elif self._phase in BRAKED:
            self._states_end = self._states_before  # the operator's own stop is no reaction
            await self._follow(world)
        elif self._phase in SEARCHING:
            await world.seconds(_SEARCH_S)
            self._states_end = len(world.samples)  # the operator's own stop is no reaction
            if world.axis.state in COMMANDED:
                world.axis.stop()
            await self._follow(world)
            return
        else:
            await self._follow(world)
        if self._fault.again and world.axis.trip is None:
            world.turn_back()
            await self._move(world)

    async def _try_to_arm(self, world: World) -> bool:
        try:
            await self._arm(world)
        except Refused as refused:
            self._observed, self._code = REFUSED, refused.code
            await world.seconds(_AFTER_S)
            return False
        return True

    async def _arm(self, world: World) -> None:
        shutdown = world.service.shutdown
        if shutdown.is_ending:
            raise Refused(RefusalCode.ENDING, "the service is ending")
        await world.until(lambda: world.axis.ready_to_arm or shutdown.is_ending, max(0.2, 5.0 * world.period_s))
        world.axis.arm()
        await world.until(lambda: world.axis.state is State.HOLDING or world.axis.trip is not None, _READY_S)

    async def _move(self, world: World) -> None:
        """Move, if the axis can; from here on the travel counts."""
        if world.axis.trip is None and not world.service.shutdown.is_ending:
            self._begun_s, self._place = world.now_s, world.place()
            world.begin_travel(self._begun_s, self._place)
            try:
                world.axis.move_to(world.target, world.velocity)
            except Refused as refused:
                self._observed, self._code = REFUSED, refused.code
        elif world.axis.trip is None:
            self._observed, self._code = REFUSED, RefusalCode.ENDING
        await self._follow(world)

    async def _follow(self, world: World) -> None:
        axis, serving = world.axis, world.serving
        longest_s = abs(world.target - world.start) / world.velocity + 30.0
        await world.until(
            lambda: axis.state in {State.HOLDING, State.TRIPPED, State.DISARMED} or serving.done(),
            longest_s,
        )
        at_rest = 1e-3 * world.velocity
        await world.seconds(_AFTER_S)
        await world.until(lambda: abs(world.drive.velocity) <= at_rest, 10.0)

    def _observe(self, world: World) -> tuple[str, str]:
        trip, worse = world.axis.trip, world.axis.escalation
        if trip is not None:
            codes = [one.code.value for one in (trip, worse) if one is not None]
            return LETTERS[max(one.reaction for one in (trip, worse) if one is not None)], "+".join(codes)
        if self._observed != TOLERATED:
            return self._observed, self._code
        if self._fault.expected == REFUSED and self._inject:
            return (REFUSED if all(world.refusals) else TOLERATED), next(filter(None, world.refusals), "")
        after = {sample.state for sample in world.samples[self._states_before : self._states_end]}
        if after & {State.STOPPING.value, State.QUICK_STOPPING.value, State.DISARMING.value}:
            return HELD, ""
        return TOLERATED, ""


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
