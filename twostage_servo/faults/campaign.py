"""Runs the faults: each cell is one fault in one phase, on an axis of its own, in simulated time."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from random import Random
from typing import TYPE_CHECKING

from twostage_servo.axis.messages import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import Reaction
from twostage_servo.config import Config, LoadedConfig
from twostage_servo.control.two_stage import Stage
from twostage_servo.faults.budget import Budget, Reference
from twostage_servo.faults.plan import CRUISE_S, LONG_CRUISE_S, cruise_end, plan_target, settling_begin
from twostage_servo.faults.table import (
    DISABLED,
    HELD,
    QUICK,
    REFUSED,
    STOPPED,
    TABLE,
    TOLERATED,
    Fault,
    Phase,
)
from twostage_servo.faults.world import Sample, World, operate
from twostage_servo.service.assembly import compile_profile, design
from twostage_servo.simulation.virtual_clock import run

if TYPE_CHECKING:
    from twostage_servo.axis.design import AxisDesign

_LETTERS = {Reaction.CONTROLLED_STOP: STOPPED, Reaction.QUICK_STOP: QUICK, Reaction.DISABLE: DISABLED}
_READY_S = 3.0
_WAIT_S = 0.3
"""How long a fault has to show before the operator goes on, where the axis is at rest."""
_AFTER_S = 0.5


class NotOperableError(Exception):
    """The axis does not even carry out the campaign's move without a fault."""


@dataclass(frozen=True, slots=True)
class Cell:
    """What one fault in one phase came to; distances in axis unit.

    Attributes
    ----------
    fault, name, phase
        Which one, and what the axis did when it began.
    expected, observed
        Letters of the reactions, see :data:`~twostage_servo.faults.table.MEANINGS`.
    trip
        Code of the trip, or of the refusal; empty if there was none.
    travel
        How far the axis went after the fault: after a stop, from where it was when the fault or the last move began;
        where the fault is tolerated, the largest distance from where it would have been without it.
    bound
        How far it may.
    wrong
        What else is not as it should be; empty if nothing.
    """

    fault: int
    name: str
    phase: str
    expected: str
    observed: str
    trip: str
    travel: float
    bound: float
    wrong: str = ""

    @property
    def met(self) -> bool:
        """Whether reaction, travel and all else are as they should be."""
        return self.observed == self.expected and self.travel <= self.bound and not self.wrong


@dataclass(slots=True)
class _Outcome:
    """What a script saw: when and where the fault began and the last move after it, and all the rest."""

    fault_s: float
    begun_s: float
    place: float
    to_go: float
    samples: list[Sample]
    observed: str
    trip: str
    wrong: str


class Campaign:
    """The faults on one axis.

    Parameters
    ----------
    loaded
        The configuration; its bus is replaced by a simulated one.
    seed
        Of everything that is random: noise, sizes, moments.
    """

    def __init__(self, loaded: LoadedConfig[Config], seed: int) -> None:
        simulation = loaded.config.simulation.model_copy(update={"seed": seed, "frame_loss": 0.0})
        config = loaded.config.model_copy(update={"simulation": simulation})
        self.loaded = dataclasses.replace(loaded, config=config)
        self.seed = seed
        self.design: AxisDesign = design(self.loaded)
        self.profile = compile_profile(self.loaded)
        self._references: dict[tuple[Phase, bool, bool], _Outcome] = {}

    def cells(
        self, faults: Sequence[Fault] = TABLE, phases: Sequence[Phase] = tuple(Phase)
    ) -> Iterator[tuple[Fault, Phase]]:
        """Yield what there is to run on this axis."""
        for fault in faults:
            if fault.needs(self.profile, self.loaded.config.protocol):
                yield from ((fault, phase) for phase in fault.phases if phase in phases)

    def run(self, fault: Fault, phase: Phase) -> Cell:
        """Run one cell."""
        reference = self._reference(phase, fault)
        outcome = self._play(phase, fault, inject=True)
        expected = fault.expectation(phase, self.loaded.config.service.holder_lost)
        simulation = self.loaded.config.simulation
        budget = Budget(
            self.design,
            Reference(
                reference.samples, reference.fault_s, reference.to_go, phase in {Phase.CHANGEOVER, Phase.SETTLING}
            ),
            simulation.command_timeout_ms / 1e3,
            simulation.cycle_ms / 1e3,
        )
        stopped = outcome.observed in {STOPPED, QUICK, DISABLED, HELD} or (
            outcome.observed == REFUSED and fault.expected != REFUSED
        )
        travel = _travelled(outcome) if stopped else _deviation(outcome, reference)
        bound = fault.budget(phase, expected)(budget)
        return Cell(
            fault.number,
            fault.name,
            phase.value,
            expected,
            outcome.observed,
            outcome.trip,
            travel,
            bound,
            outcome.wrong,
        )

    def _reference(self, phase: Phase, fault: Fault) -> _Outcome:
        key = (phase, fault.velocity_limit, fault.again)
        if fault.prepare is not None:
            return self._play(phase, fault, inject=False)
        if key not in self._references:
            self._references[key] = self._play(phase, fault, inject=False)
        return self._references[key]

    def _play(self, phase: Phase, fault: Fault, *, inject: bool) -> _Outcome:
        return run(_Script(self, phase, fault, inject=inject).play())

    def velocity(self, fault: Fault) -> float:
        """Return the cruise velocity of the move, in axis unit/s."""
        axis = self.loaded.config.axis
        return axis.limits.velocity if fault.velocity_limit else axis.cruise_velocity


class _Script:
    """One run: bring the axis into the phase, let the fault begin, and go on as an operator would."""

    def __init__(self, campaign: Campaign, phase: Phase, fault: Fault, *, inject: bool) -> None:
        self._campaign = campaign
        self._phase = phase
        self._fault = fault
        self._inject = inject
        # Two sequences, so that the run without the fault is the same up to it.
        self._random = Random(f"{campaign.seed} {phase}")  # noqa: S311 - moments and targets, no secrets
        self._sizes = Random(f"{campaign.seed} {phase} {fault.number} {fault.name}")  # noqa: S311 - likewise
        self._observed = TOLERATED
        self._code = ""
        self._states_before = 0
        self._begun_s = self._place = self._to_go = 0.0

    async def play(self) -> _Outcome:
        async with operate(self._campaign.loaded) as world:
            self._plan(world)
            if self._fault.prepare is not None:
                await self._prepare(world)
            if not await world.until(lambda: world.axis.ready_to_arm, _READY_S):
                obstacle = world.axis.obstacle_to_arming()
                raise NotOperableError(f"the axis could not be armed before the fault: {obstacle and obstacle[1]}")
            if not world.axis.referenced:
                world.axis.set_position(world.drive.position)
            await self._reach_the_phase(world)
            await world.seconds(self._random.uniform(0.0, world.period_s))
            if self._phase is Phase.HOLDING:
                world.start, world.target = world.target, world.start  # the next move goes back
            fault_s, self._states_before = world.now_s, len(world.samples)
            self._begun_s, self._place = fault_s, world.place()
            world.fault_place = self._place
            self._to_go = abs(world.target - self._place)
            if self._inject:
                self._fault.inject(world, self._sizes)
            await self._go_on(world)
            observed, code = self._observe(world)
            wrong = self._fault.check(world) if self._fault.check is not None and self._inject else None
            return _Outcome(
                fault_s, self._begun_s, self._place, self._to_go, world.samples, observed, code, wrong or ""
            )

    def _plan(self, world: World) -> None:
        cruise_s = LONG_CRUISE_S if self._fault.velocity_limit else CRUISE_S
        world.velocity = self._campaign.velocity(self._fault)
        world.start = world.drive.position
        share = self._random.random()
        world.target = plan_target(self._campaign.design, world.start, world.velocity, share, cruise_s)

    async def _prepare(self, world: World) -> None:
        ahead = {Phase.IDLE: 0.5, Phase.ACCELERATING: 0.02, Phase.CRUISING: 0.5, Phase.CHANGEOVER: 0.9}
        share = ahead.get(self._phase, 0.99)
        world.roll_over_in = share * (world.target - world.start)
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
        world.axis.move_to(world.target, world.velocity)
        reached: Callable[[], bool] = {
            Phase.ACCELERATING: lambda: abs(_nominal_velocity(world)) >= 0.5 * world.velocity,
            Phase.CRUISING: lambda: self._cruises(world),
            Phase.CHANGEOVER: lambda: world.axis.law.stage is Stage.POSITION,
            Phase.SETTLING: lambda: (
                world.axis.law.stage is Stage.POSITION
                and world.axis.law.distance <= settling_begin(self._campaign.design, world.velocity)
            ),
            Phase.HOLDING: lambda: world.axis.state is State.HOLDING,
        }[self._phase]
        if not await world.until(reached, 60.0):
            trip = world.axis.trip
            raise NotOperableError(
                f"the axis did not come to {self._phase.value} in a move by {abs(world.target - world.start):.4g} at "
                f"{world.velocity:g} without a fault: {trip.cause if trip else 'it took too long'}"
            )

    def _cruises(self, world: World) -> bool:
        """Whether the speed has settled; near the end of the cruise, or at its beginning where it has to be long."""
        law, velocity = world.axis.law, world.velocity
        if self._fault.velocity_limit:
            return abs(_nominal_velocity(world)) >= 0.97 * velocity
        near = cruise_end(self._campaign.design, velocity)
        return abs(law.speed_reference) >= 0.999 * velocity and law.distance <= near

    async def _go_on(self, world: World) -> None:
        """Do what an operator would do next, until the axis is at rest."""
        if self._phase is Phase.IDLE:
            await world.seconds(_WAIT_S)
            if not await self._try_to_arm(world):
                return
            await self._move(world)
        elif self._phase is Phase.HOLDING:
            await world.seconds(_WAIT_S)
            await self._move(world)
        else:
            await self._follow(world)
        if self._fault.again and world.axis.trip is None:
            world.start, world.target = world.target, world.start
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
        if world.service.is_ending:
            raise Refused("ending", "the service is ending")
        await world.until(lambda: world.axis.ready_to_arm or world.service.is_ending, 0.2)
        world.axis.arm()
        await world.until(lambda: world.axis.state is State.HOLDING or world.axis.trip is not None, _READY_S)

    async def _move(self, world: World) -> None:
        """Move, if the axis can; from here on the travel counts."""
        if world.axis.trip is None and not world.service.is_ending:
            self._begun_s, self._place = world.now_s, world.place()
            world.fault_place = self._place
            try:
                world.axis.move_to(world.target, world.velocity)
            except Refused as refused:
                self._observed, self._code = REFUSED, refused.code
        await self._follow(world)

    async def _follow(self, world: World) -> None:
        axis, serving = world.axis, world.serving
        longest_s = abs(world.target - world.start) / world.velocity + 30.0
        await world.until(
            lambda: axis.state in {State.HOLDING, State.TRIPPED, State.DISARMED} or serving is None or serving.done(),
            longest_s,
        )
        at_rest = 1e-3 * world.velocity
        await world.seconds(_AFTER_S)
        await world.until(lambda: abs(world.drive.velocity) <= at_rest, 10.0)

    def _observe(self, world: World) -> tuple[str, str]:
        trip = world.axis.trip
        if trip is not None:
            return _LETTERS[trip.reaction], trip.code.value
        if self._observed != TOLERATED:
            return self._observed, self._code
        if self._fault.expected == REFUSED and self._inject:
            return (REFUSED if all(world.refusals) else TOLERATED), next(filter(None, world.refusals), "")
        after = {sample.state for sample in world.samples[self._states_before :]}
        if after & {State.STOPPING.value, State.QUICK_STOPPING.value, State.DISARMING.value}:
            return HELD, ""
        return TOLERATED, ""


def _nominal_velocity(world: World) -> float:
    return world.axis.motion.nominal.observer.velocity


def _travelled(outcome: _Outcome) -> float:
    """Return the largest distance from where the axis was when the fault, or the last move after it, began."""
    after = (sample.position for sample in outcome.samples if sample.time_s >= outcome.begun_s - 1e-9)
    return max((abs(position - outcome.place) for position in after), default=0.0)


def _deviation(outcome: _Outcome, reference: _Outcome) -> float:
    """Return the largest distance from where the axis would have been, tick by tick since the last move began."""
    after, designed = (
        [sample for sample in one.samples if sample.time_s >= one.begun_s - 1e-9] for one in (outcome, reference)
    )
    if not after or not designed:
        return 0.0
    places = {round((sample.time_s - designed[0].time_s) * 1e4): sample.position for sample in designed}
    first_s = after[0].time_s
    return max(
        (
            abs(sample.position - places[moment])
            for sample in after
            if (moment := round((sample.time_s - first_s) * 1e4)) in places
        ),
        default=0.0,
    )
