"""The operator of a bench, who brings the axis into the phase in which a fault shall begin."""

import time
from collections.abc import Callable
from random import Random

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.state import State
from twostage_servo.faults.bench import Bench, BenchError
from twostage_servo.faults.listening import Snapshot
from twostage_servo.faults.phase import Phase
from twostage_servo.faults.plan import cruise_end, plan_target, settling_begin

_TRIES = 8
"""Moves until the phase is met: a busy machine may show it when it has passed already."""


class Approach:
    """One way into a phase.

    Parameters
    ----------
    bench
        Where the axis is.
    design
        The axis.
    phase
        Where to.
    random
        Of the length of the move, and of the moment between two ticks.
    """

    def __init__(self, bench: Bench, design: AxisDesign, phase: Phase, random: Random) -> None:
        self._bench = bench
        self._phase = phase
        self._random = random
        self._period_s = design.period_s
        self._velocity = bench.loaded.config.axis.cruise_velocity
        self._cruise_end = cruise_end(design, self._velocity)
        self._settling = settling_begin(design, self._velocity)
        self._design = design

    def make(self) -> Snapshot:
        """Return the axis as it is seen at last, in the phase.

        Raises
        ------
        BenchError
            If it never comes there.
        RefusalError
            If the service refuses to arm or to move.
        """
        bench = self._bench
        bench.watch(lambda now: now["axis"]["cia402"] == "ready to switch on", "an axis that can be armed")
        if self._phase is Phase.IDLE:
            self._wait_a_little()
            return bench.operator.latest
        ask = bench.operator.ask
        start = ask(op="arm")["axis"]["position"]
        bench.watch(_untripped(_holds), "the axis to be armed")
        if bench.loaded.config.axis.homing.required:
            ask(op="home", position=start)
        target = plan_target(self._design, start, self._velocity, self._random.random())
        for _ in range(_TRIES):
            ask(op="move", position=target, velocity=self._velocity)
            bench.operator.unread.clear()
            bench.watch(_untripped(self.has_begun), f"the axis to be {self._phase.value}")
            self._wait_a_little()
            bench.operator.read_snapshots()
            if not self.has_passed(bench.operator.latest):
                return bench.operator.latest
            bench.watch(_untripped(_holds), "the end of the move")
            start, target = target, start
        raise BenchError(f"the phase {self._phase.value} had always passed: the machine is too busy")

    def has_begun(self, now: Snapshot) -> bool:
        """Whether a snapshot of the move shows that the phase has begun."""
        match self._phase:
            case Phase.ACCELERATING:
                return _in_speed_stage(now) and _speed(now) >= 0.5 * self._velocity
            case Phase.CRUISING:
                return _in_speed_stage(now) and distance(now) <= self._cruise_end
            case Phase.CHANGEOVER:
                return _in_position_stage(now)
            case Phase.SETTLING:
                return _in_position_stage(now) and distance(now) <= self._settling
            case _:
                return _holds(now)

    def has_passed(self, now: Snapshot) -> bool:
        """Whether a later snapshot shows that it has ended."""
        match self._phase:
            case Phase.ACCELERATING:
                return not _in_speed_stage(now) or _speed(now) >= 0.98 * self._velocity
            case Phase.CRUISING:
                return not _in_speed_stage(now)
            case Phase.CHANGEOVER:
                return not _in_position_stage(now) or distance(now) <= self._settling
            case Phase.SETTLING:
                return not _in_position_stage(now)
            case _:
                return not _holds(now)

    def _wait_a_little(self) -> None:
        """Let the fault begin anywhere between two ticks."""
        time.sleep(self._random.uniform(0.0, self._period_s))


def distance(now: Snapshot) -> float:
    """Return how far the axis is from its set-point, in axis unit; infinity if that is not known."""
    position, target = now["axis"]["position"], now["axis"]["target"]
    return float("inf") if position is None or target is None else abs(float(target) - float(position))


def _untripped(condition: Callable[[Snapshot], bool]) -> Callable[[Snapshot], bool]:
    def check(now: Snapshot) -> bool:
        if now["trip"]:
            raise BenchError(f"the axis tripped before the fault: {now['trip']['cause']}")
        return condition(now)

    return check


def _speed(now: Snapshot) -> float:
    return abs(float(now["axis"]["velocity"] or 0.0))


def _holds(now: Snapshot) -> bool:
    return bool(now["axis"]["state"] == State.HOLDING)


def _in_speed_stage(now: Snapshot) -> bool:
    return bool(now["axis"]["state"] == State.SPEED_STAGE)


def _in_position_stage(now: Snapshot) -> bool:
    return bool(now["axis"]["state"] == State.POSITION_STAGE)
