"""Runs the faults: each cell is one fault in one phase, on an axis of its own, in simulated time."""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from twostage_servo.app.assembly import design
from twostage_servo.config.loader import Config, LoadedConfig
from twostage_servo.config.machine import Machine
from twostage_servo.control.laws.registry import PAPER
from twostage_servo.faults.budget import Budget, Reference
from twostage_servo.faults.cell import Cell, NotApplicable
from twostage_servo.faults.frames import compile_profile, protocol_of
from twostage_servo.faults.limits import Motion
from twostage_servo.faults.phase import SEARCHING, Phase
from twostage_servo.faults.script import Outcome, Script
from twostage_servo.faults.servo_gains import servo_gains_of
from twostage_servo.faults.table import (
    DISABLED,
    HELD,
    QUICK,
    REFUSED,
    STOPPED,
    TABLE,
    TOLERATED,
    Fault,
)
from twostage_servo.timing.virtual_clock import run

if TYPE_CHECKING:
    from twostage_servo.axis.design import AxisDesign

COMPARABLE_SHARE = 0.9
"""Share of a run's ticks whose place must have one to be compared with in the run without the fault."""


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
        try:
            servo_gains_of(self.design)
        except ValueError as error:
            text = (
                f"the campaign's bounds are those of the law {PAPER!r}, which cannot be designed for this axis: {error}"
            )
            raise self.loaded.problem(("axis", "law", "type"), text) from error
        self.profile = compile_profile(self.loaded)
        self._searching = machine.with_axis(self.axis, _with_a_search(self.loaded.config))
        self._references: dict[tuple[Phase, bool, bool], Outcome] = {}

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
        if not fault.needs(self.profile, protocol_of(self.loaded.config)):
            return fault.reason
        if reason := fault.why_not(self.loaded.config):
            return reason
        if phase is Phase.HOMING and not self.can_search:
            return "homing declares the present position, and the drive has no home switch"
        return ""

    @property
    def can_search(self) -> bool:
        """Whether the axis can look for a reference: a drive that is homed where it stands needs a home switch."""
        config = self.loaded.config
        return config.axis.homing.method != "set_here" or protocol_of(config).feedback.home_switch is not False

    def configuration(self, phase: Phase) -> Machine:
        """Return the configuration in which a phase is played."""
        return self._searching if phase is Phase.HOMING else self.machine

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
        limit = fault.limit(self._motion(reference)) if outcome.observed == TOLERATED != expected else ""
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

    def _motion(self, reference: Outcome) -> Motion:
        speed = max((abs(sample.velocity) for sample in reference.samples), default=0.0)
        return Motion(self.loaded.config, self.design, speed)

    def _reference(self, phase: Phase, fault: Fault) -> Outcome:
        key = (phase, fault.velocity_limit, fault.again and phase not in SEARCHING)
        if fault.prepare is not None:
            return self._play(phase, fault)
        if key not in self._references:
            self._references[key] = self._play(phase, fault)
        return self._references[key]

    def _play(self, phase: Phase, fault: Fault, reference: Outcome | None = None) -> Outcome:
        return run(Script(self.configuration(phase), self.design, self.seed, phase, fault, reference).play())


def _travelled(outcome: Outcome) -> float:
    """Return the largest distance from where the axis was when the fault, or the last move after it, began."""
    farthest = 0.0
    for sample in outcome.samples:
        if sample.time_s >= outcome.begun_s - 1e-9:
            farthest = max(farthest, abs(sample.position - outcome.place))
        elif sample.time_s >= outcome.fault_s - 1e-9:
            farthest = max(farthest, abs(sample.position - outcome.fault_place))
    return farthest


def _deviation(outcome: Outcome, reference: Outcome, period_s: float) -> tuple[float, str]:
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


def _since_the_move(outcome: Outcome) -> list[tuple[float, float]]:
    """Return time and place since the fault or the last move began, from (0, its place) on."""
    begun_s = outcome.begun_s
    return [
        (0.0, outcome.place),
        *((s.time_s - begun_s, s.position) for s in outcome.samples if s.time_s > begun_s + 1e-9),
    ]


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
