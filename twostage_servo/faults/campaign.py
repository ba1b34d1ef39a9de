"""Runs the faults: each cell is one fault in one phase, on an axis of its own, in simulated time."""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from random import Random
from typing import TYPE_CHECKING

import numpy as np

from twostage_servo.axis.detection import slowest_certain_velocity
from twostage_servo.axis.messages import Refused
from twostage_servo.axis.state import COMMANDED, State
from twostage_servo.config import Config, LoadedConfig
from twostage_servo.control.two_stage import Stage
from twostage_servo.faults.budget import Budget, Reference
from twostage_servo.faults.plan import CRUISE_S, LONG_CRUISE_S, cruise_end, plan_target, settling_begin
from twostage_servo.faults.table import (
    BRAKED,
    DISABLED,
    HELD,
    LETTERS,
    QUICK,
    REFUSED,
    SEARCHING,
    STOPPED,
    TABLE,
    TOLERATED,
    Fault,
    Phase,
)
from twostage_servo.faults.world import Sample, World, operate
from twostage_servo.machine import Machine
from twostage_servo.service.assembly import compile_profile, design
from twostage_servo.simulation.virtual_clock import run
from twostage_servo.ticks import Tick

if TYPE_CHECKING:
    from twostage_servo.axis.design import AxisDesign

_READY_S = 3.0
_WAIT_S = 0.3
"""How long the operator waits at least, where the axis is at rest."""
_AFTER_S = 0.5
_SEARCH_S = 1.0
"""How long an operator lets a search or a jog go on after the fault, before stopping it."""

AFTER_THE_STOP_S = 0.02
"""How long after an operator's stop in a cruise a fault begins that comes while the axis brakes."""

COMPARABLE_SHARE = 0.9
"""Share of a run's ticks whose place must have one to be compared with in the run without the fault."""


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
        Letters of the reactions, see :data:`~twostage_servo.faults.table.MEANINGS`; of several trips, that of the most
        severe.
    trip
        Code of the trip, or of the refusal; empty if there was none. Where a later trip was more severe, both codes:
        ``missed_ticks+drive_dropped_out``.
    travel
        How far the axis went after the fault: after a stop, from where it was when the fault or the last move began;
        where the fault is tolerated, the largest distance from where it would have been without it.
    bound
        How far it may.
    wrong
        What else is not as it should be; empty if nothing.
    axis
        The axis that has the fault; empty where the fault is one of the whole service.
    limit
        What one encoder cannot tell in this phase, where that is why the reaction is another one; else empty.
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
    axis: str = ""
    limit: str = ""

    @property
    def met(self) -> bool:
        """Whether reaction, travel and all else are as they should be, or the limit of one encoder is stated."""
        as_expected = self.observed == self.expected or bool(self.limit)
        return as_expected and self.travel <= self.bound and not self.wrong


@dataclass(frozen=True, slots=True)
class NotApplicable:
    """A cell that there cannot be on an axis, and why."""

    fault: int
    name: str
    phase: str
    reason: str
    axis: str = ""


@dataclass(slots=True)
class _Outcome:
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


class Campaign:
    """The faults on one axis.

    Parameters
    ----------
    machine
        The configuration, of a machine or of one axis; its buses are replaced by a simulated one.
    seed
        Of everything that is random: noise, sizes, moments.
    axis
        Name of the axis that has the faults; None for the only one, or the first.
    """

    def __init__(self, machine: Machine | LoadedConfig[Config], seed: int, axis: str | None = None) -> None:
        if isinstance(machine, LoadedConfig):
            machine = Machine.of(machine)
        for loaded in machine.axes:
            simulation = loaded.config.simulation.model_copy(update={"seed": seed, "frame_loss": 0.0})
            config = loaded.config.model_copy(update={"simulation": simulation, "service": machine.service})
            machine = machine.with_axis(config.axis.name, config)
        self.machine = machine
        self.axis = axis or machine.axes[0].config.axis.name
        self.loaded = machine.axis(self.axis)
        self.seed = seed
        self.design: AxisDesign = design(self.loaded)
        self.profile = compile_profile(self.loaded)
        self._searching = machine.with_axis(self.axis, _with_a_search(self.loaded.config))
        self._certain: float | None = None  # speed from which on `check` says that a change of the encoder shows
        self._references: dict[tuple[Phase, bool, bool], _Outcome] = {}

    def cells(
        self, faults: Sequence[Fault] = TABLE, phases: Sequence[Phase] = tuple(Phase)
    ) -> Iterator[tuple[Fault, Phase]]:
        """Yield what there is to run on this axis."""
        for fault in faults:
            yield from ((fault, phase) for phase in fault.phases if phase in phases and not self._why_not(fault, phase))

    def not_applicable(
        self, faults: Sequence[Fault] = TABLE, phases: Sequence[Phase] = tuple(Phase)
    ) -> Iterator[NotApplicable]:
        """Yield what there is not, with the reason."""
        for fault in faults:
            for phase in fault.phases:
                if phase in phases and (reason := self._why_not(fault, phase)):
                    yield NotApplicable(fault.number, fault.name, phase.value, reason, self.axis)

    def _why_not(self, fault: Fault, phase: Phase) -> str:
        if not fault.needs(self.profile, self.loaded.config.protocol):
            return fault.reason
        if reason := fault.why_not(self.loaded.config):
            return reason
        if phase is Phase.HOMING and not self.can_search:
            return "the axis is homed where it stands, and its drive has no home switch to look for"
        return ""

    @property
    def can_search(self) -> bool:
        """Whether the axis can look for a reference: a drive that is homed where it stands needs a home switch."""
        config = self.loaded.config
        return config.axis.homing.method != "set_here" or config.protocol.feedback.home_switch is not False

    def configuration(self, phase: Phase) -> Machine:
        """Return the configuration in which a phase is played."""
        return self._searching if phase is Phase.HOMING else self.machine

    def _limit(self, fault: Fault, reference: _Outcome) -> str:
        """Return why one encoder cannot tell, after a motion without the fault; empty if it can."""
        fastest = max((abs(sample.velocity) for sample in reference.samples), default=0.0)
        if fault.takes_speed and fastest < (certain := self._certain_velocity()):
            unit = self.design.settings.unit
            return (
                f"the axis goes {fastest:.3g} {unit}/s at most, and a change of its encoder shows from {certain:.3g} "
                f"{unit}/s on (`check`, certain_from_velocity)"
            )
        return fault.limit(self.loaded.config)

    def _certain_velocity(self) -> float:
        if self._certain is None:
            self._certain = slowest_certain_velocity(self.design)
        return self._certain

    def run(self, fault: Fault, phase: Phase) -> Cell:
        """Run one cell."""
        reference = self._reference(phase, fault)
        outcome = self._play(phase, fault, reference)
        expected = fault.expectation(phase, self.loaded.config)
        if outcome.observed == fault.instead:
            expected = outcome.observed
        simulation = self.loaded.config.simulation
        budget = Budget(
            self.design,
            Reference(
                reference.samples,
                reference.fault_s,
                reference.to_go,
                phase in {Phase.CHANGEOVER, Phase.SETTLING},
                max(0.02, 2.0 * self.design.period_s),
            ),
            simulation.command_timeout_ms / 1e3,
            simulation.cycle_ms / 1e3,
        )
        stopped = outcome.observed in {STOPPED, QUICK, DISABLED, HELD} or (
            outcome.observed == REFUSED and fault.expected != REFUSED
        )
        wrong = outcome.wrong
        if stopped:
            travel = _travelled(outcome)
        else:
            travel, incomparable = _deviation(outcome, reference, self.design.period_s)
            wrong = "; ".join(filter(None, (incomparable, wrong)))
        limit = self._limit(fault, reference) if outcome.observed == TOLERATED != expected else ""
        bound = (fault.limit_bound if limit and fault.limit_bound else fault.budget(phase, expected))(budget)
        return Cell(
            fault.number,
            fault.name,
            phase.value,
            expected,
            outcome.observed,
            outcome.trip,
            travel,
            bound,
            wrong,
            self.axis,
            limit,
        )

    def _reference(self, phase: Phase, fault: Fault) -> _Outcome:
        key = (phase, fault.velocity_limit, fault.again and phase not in SEARCHING)
        if fault.prepare is not None:
            return self._play(phase, fault)
        if key not in self._references:
            self._references[key] = self._play(phase, fault)
        return self._references[key]

    def _play(self, phase: Phase, fault: Fault, reference: _Outcome | None = None) -> _Outcome:
        return run(_Script(self, phase, fault, reference).play())

    def velocity(self, fault: Fault) -> float:
        """Return the cruise velocity of the move, in axis unit/s."""
        axis = self.loaded.config.axis
        return axis.limits.velocity if fault.velocity_limit else axis.cruise_velocity


class _Script:
    """One run: bring the axis into the phase, let the fault begin, and go on as an operator would.

    Parameters
    ----------
    campaign
        The axis.
    phase, fault
        What begins, and when.
    reference
        The same run without the fault; None to make it.
    """

    def __init__(self, campaign: Campaign, phase: Phase, fault: Fault, reference: _Outcome | None = None) -> None:
        self._campaign = campaign
        self._phase = phase
        self._fault = fault
        self._reference = reference
        self._inject = reference is not None
        # Two sequences, so that the run without the fault is the same up to it.
        self._random = Random(f"{campaign.seed} {phase}")  # noqa: S311 - moments and targets, no secrets
        self._sizes = Random(f"{campaign.seed} {phase} {fault.number} {fault.name}")  # noqa: S311 - likewise
        self._observed = TOLERATED
        self._code = ""
        self._states_before = 0
        self._states_end: int | None = None
        self._begun_s = self._place = self._fault_place = self._to_go = 0.0

    async def play(self) -> _Outcome:
        async with operate(self._campaign.configuration(self._phase), self._campaign.axis) as world:
            self._plan(world)
            if self._fault.prepare is not None:
                await self._prepare(world)
            if not await world.until(lambda: world.axis.ready_to_arm, _READY_S):
                obstacle = world.axis.obstacle_to_arming()
                raise NotOperableError(f"the axis could not be armed before the fault: {obstacle and obstacle[1]}")
            if not world.axis.referenced:
                world.axis.set_position(world.drive.position)
            await world.start_companions(_READY_S)
            await self._reach_the_phase(world)
            await world.seconds(self._random.uniform(0.0, world.period_s))
            if self._phase in BRAKED:
                world.axis.stop(quick=self._phase is Phase.QUICK_STOPPING)
                await world.seconds(AFTER_THE_STOP_S)
            if self._phase is Phase.HOLDING:
                world.start, world.target = world.target, world.start  # the next move goes back
            fault_s, self._states_before = world.now_s, len(world.samples)
            world.forget_companions()
            self._begun_s, self._place = fault_s, world.place()
            self._fault_place = self._place
            world.fault_s = world.begun_s = fault_s
            world.fault_place = self._place
            self._to_go = abs(world.target - self._place)
            if self._reference is not None:
                world.undisturbed = self._reference.samples
                self._fault.inject(world, self._sizes)
            await self._go_on(world)
            await world.seconds(self._fault.shows_s(self._campaign.loaded.config))
            world.take_sample()  # a service that has ended makes no ticks, and its axis may go on
            observed, code = self._observe(world)
            # What a check does to the axis is no travel any more.
            samples, ended_s = list(world.samples), world.now_s
            at_rest = abs(world.drive.velocity) <= world.axis.design.rest_velocity
            wrong = await world.companions_complaint(shared=self._fault.shared) if self._inject else ""
            if self._fault.check is not None and self._inject:
                wrong = "; ".join(filter(None, (wrong, await self._fault.check(world))))
            return _Outcome(
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
        world.velocity = self._campaign.velocity(self._fault)
        world.start = world.drive.position
        share = self._random.random()
        world.target = plan_target(self._campaign.design, world.start, world.velocity, share, cruise_s)
        if self._phase is Phase.HOMING:
            homing = world.axis.settings.homing
            world.velocity = homing.velocity if homing.method == "switch" else homing.slow_velocity
            world.target = world.start + (homing.travel if homing.direction == "positive" else -homing.travel)

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
        if self._phase is Phase.HOMING:
            world.axis.home()
        elif self._phase is Phase.JOGGING:
            _keep_jogging(world)
        else:
            world.axis.move_to(world.target, world.velocity)
        reached: Callable[[], bool] = {
            Phase.ACCELERATING: lambda: abs(_nominal_velocity(world)) >= 0.5 * world.velocity,
            **dict.fromkeys((Phase.CRUISING, *BRAKED), lambda: self._cruises(world)),
            Phase.CHANGEOVER: lambda: world.axis.law.stage is Stage.POSITION,
            Phase.SETTLING: lambda: (
                world.axis.law.stage is Stage.POSITION
                and world.axis.law.distance <= settling_begin(self._campaign.design, world.velocity)
            ),
            Phase.HOLDING: lambda: world.axis.state is State.HOLDING,
            Phase.HOMING: lambda: world.axis.state is State.HOMING and _is_up_to_speed(world),
            Phase.JOGGING: lambda: world.axis.state is State.JOGGING and _is_up_to_speed(world),
        }[self._phase]
        if not await world.until(reached, 60.0):
            trip = world.axis.trip
            raise NotOperableError(
                f"the axis did not come to {self._phase.value} in a move by {abs(world.target - world.start):.4g} at "
                f"{world.velocity:g} without a fault: {trip.cause if trip else 'it took too long'}"
            )

    @property
    def _wait_s(self) -> float:
        """How long a fault has to show before the operator goes on, where the axis is at rest, in s."""
        return max(_WAIT_S, self._campaign.loaded.config.axis.limits.heartbeat_ms / 1e3)

    def _cruises(self, world: World) -> bool:
        """Whether the speed has settled; near the end of the cruise, or at its beginning where it has to be long."""
        law, velocity = world.axis.law, world.velocity
        if self._fault.velocity_limit:
            return _is_up_to_speed(world)
        near = cruise_end(self._campaign.design, velocity)
        return abs(law.speed_reference) >= 0.999 * velocity and law.distance <= near

    async def _go_on(self, world: World) -> None:
        """Do what an operator would do next, until the axis is at rest."""
        if self._phase is Phase.IDLE:
            await world.seconds(self._wait_s)
            if not await self._try_to_arm(world):
                return
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
        await world.until(lambda: world.axis.ready_to_arm or world.service.is_ending, max(0.2, 5.0 * world.period_s))
        world.axis.arm()
        await world.until(lambda: world.axis.state is State.HOLDING or world.axis.trip is not None, _READY_S)

    async def _move(self, world: World) -> None:
        """Move, if the axis can; from here on the travel counts."""
        if world.axis.trip is None and not world.service.is_ending:
            self._begun_s, self._place = world.now_s, world.place()
            world.begun_s, world.fault_place = self._begun_s, self._place
            try:
                world.axis.move_to(world.target, world.velocity)
            except Refused as refused:
                self._observed, self._code = REFUSED, refused.code
        elif world.axis.trip is None:
            self._observed, self._code = REFUSED, "ending"
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
    return world.axis.motion.nominal.observer.velocity


def _travelled(outcome: _Outcome) -> float:
    """Return the largest distance from where the axis was when the fault, or the last move after it, began."""
    farthest = 0.0
    for sample in outcome.samples:
        if sample.time_s >= outcome.begun_s - 1e-9:
            farthest = max(farthest, abs(sample.position - outcome.place))
        elif sample.time_s >= outcome.fault_s - 1e-9:
            farthest = max(farthest, abs(sample.position - outcome.fault_place))
    return farthest


def _deviation(outcome: _Outcome, reference: _Outcome, period_s: float) -> tuple[float, str]:
    """Return the largest distance from where the axis would have been, and what is wrong with that comparison.

    Both runs are taken since their last move began. The ticks of a busy host fall between those of the run without the
    fault, whose place is interpolated there: on a straight line, so it is off by an eighth of the acceleration times
    the square of the tick at most. An axis that was at rest at the end of its run would have stayed there; if it was
    not, what comes later cannot be compared.
    """
    run = _since_the_move(outcome)
    designed = _since_the_move(reference)
    last_s = math.inf if reference.at_rest else designed[-1][0]
    comparable = [(time_s, place) for time_s, place in run[1:] if time_s <= last_s + 1e-9]
    ticks = max(1.0, (outcome.ended_s - outcome.begun_s) / period_s)
    if len(comparable) < COMPARABLE_SHARE * ticks:
        wrong = f"only {len(comparable)} of {ticks:.0f} ticks can be compared with the run without the fault"
    else:
        wrong = ""
    if not comparable:
        return 0.0, wrong
    times, places = np.array(comparable).T
    return float(np.max(np.abs(places - np.interp(times, *np.array(designed).T)))), wrong


def _since_the_move(outcome: _Outcome) -> list[tuple[float, float]]:
    """Return time and place since the fault or the last move began, from (0, its place) on."""
    begun_s = outcome.begun_s
    return [
        (0.0, outcome.place),
        *((s.time_s - begun_s, s.position) for s in outcome.samples if s.time_s > begun_s + 1e-9),
    ]


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

    world.service.publishers.append(renew)


def _with_a_search(config: Config) -> Config:
    """Return a configuration whose axis looks for its reference.

    One that is homed where it stands looks for a home switch, with the speeds and the travel that its settings give for
    a search: what the axis does about a fault while it searches depends on its state, not on what it searches for.
    """
    axis = config.axis
    if axis.homing.method != "set_here":
        return config
    homing = axis.homing.model_copy(update={"method": "switch"})
    axis = axis.model_copy(update={"homing": homing})
    return config.model_copy(update={"axis": axis})
