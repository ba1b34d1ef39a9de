"""One run of a fault: an operator brings the axis into a phase, the fault begins, and the operator goes on."""

from dataclasses import dataclass
from random import Random

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import COMMANDED, State
from twostage_servo.config.machine import Machine
from twostage_servo.faults.phase import BRAKED, SEARCHING, Phase
from twostage_servo.faults.simulated_approach import SimulatedApproach, arm
from twostage_servo.faults.table import HELD, LETTERS, REFUSED, TOLERATED, Fault
from twostage_servo.faults.world import Sample, World, operate

_WAIT_S = 0.3
"""How long the operator waits at least, where the axis is at rest."""
_AFTER_S = 0.5
_SEARCH_S = 1.0
"""How long an operator lets a search or a jog go on after the fault, before stopping it."""


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
        self._config = machine.axis(design.settings.name).config
        self._phase = phase
        self._fault = fault
        self._reference = reference
        self._inject = reference is not None
        # Two sequences, so that the run without the fault is the same up to it.
        random = Random(f"{seed} {phase}")  # noqa: S311 - moments and targets, no secrets
        self._approach = SimulatedApproach(self._config, design, phase, fault, random)
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
            await self._approach.make(world)
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

    @property
    def _wait_s(self) -> float:
        """How long a fault has to show before the operator goes on, where the axis is at rest, in s."""
        return max(_WAIT_S, self._config.axis.limits.heartbeat_ms / 1e3)

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
            await arm(world)
        except Refused as refused:
            self._observed, self._code = REFUSED, refused.code
            await world.seconds(_AFTER_S)
            return False
        return True

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
