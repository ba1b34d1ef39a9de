"""What is made of a run with real processes: the cell, and whether the machine has spoilt it."""

import signal
from dataclasses import dataclass, field

from twostage_servo.axis.design import AxisDesign
from twostage_servo.control.plant import MODEL_ERROR
from twostage_servo.faults.approach import distance
from twostage_servo.faults.bench import Bench
from twostage_servo.faults.budget import Budget, Reference
from twostage_servo.faults.cell import Cell
from twostage_servo.faults.listening import Snapshot
from twostage_servo.faults.phase import Phase
from twostage_servo.faults.table import DISABLED, HELD, TOLERATED
from twostage_servo.faults.world import Sample
from twostage_servo.simulation.settings import SimulationSettings

STOPPED, KILLED, ENDED, HUNG = 37, 38, 39, 42

NAMES = {
    STOPPED: "service stopped, then continued (SIGSTOP)",
    KILLED: "service killed, then started again",
    ENDED: "service ended (SIGTERM)",
    HUNG: "loop hangs: the service manager kills it",
}

_HELD_UP_TICKS = 1.5
"""Frames that are later than this show a machine that holds processes up."""
_FASTER = 1.1
"""An effort for a speed that is greater by this factor is meant to accelerate."""


def silence_s(simulation: SimulationSettings, period_s: float) -> float:
    """Return for how long there are no commands at the least, in s: so that the drive must have noticed."""
    return simulation.command_timeout_ms / 1e3 + 2.0 * period_s


def coast_s(simulation: SimulationSettings) -> float:
    """Return how long an axis without effort takes to come to rest, in s."""
    return 20.0 / simulation.pole


@dataclass(slots=True)
class Seen:
    """What came of a fault.

    Attributes
    ----------
    exit_code
        Of the service, if it has ended.
    trip
        Code of the trip that the service reports afterwards.
    time_outs
        How often the drive has stopped by itself for want of commands; None if it did not say.
    rested
        Whether the axis came to rest.
    enabled
        Whether the drive says that it is enabled, at the end.
    effort
        The last one that the drive was sent, in effort unit, before the service was back.
    wrong
        What else is not as it should be.
    """

    exit_code: int | None = None
    trip: str = ""
    time_outs: int | None = None
    rested: bool = False
    enabled: bool | None = None
    effort: float = 0.0
    wrong: list[str] = field(default_factory=list)


class HostedVerdict:
    """Judges a run when it is over.

    Parameters
    ----------
    fault, phase
        What began, and when.
    bench, design
        Where, and the axis.
    fault_s
        When the fault began, in s.
    seen
        What came of it.
    """

    def __init__(self, fault: int, phase: Phase, bench: Bench, design: AxisDesign, fault_s: float, seen: Seen) -> None:
        self._fault = fault
        self._phase = phase
        self._bench = bench
        self._design = design
        self._simulation = bench.loaded.config.simulation
        self._fault_s = fault_s
        self._seen = seen

    def cell(self, before: Snapshot) -> Cell:
        """Return the cell; `before` is the state of the axis as the fault began."""
        seen = self._seen
        expected = HELD if self._fault == ENDED else DISABLED
        expected = TOLERATED if self._phase is Phase.IDLE else expected
        how = {STOPPED: seen.trip, ENDED: f"exit {seen.exit_code}"}.get(self._fault, "")
        if not how and seen.exit_code is not None:
            how = signal.Signals(-seen.exit_code).name if seen.exit_code < 0 else f"exit {seen.exit_code}"
        travel = self._bench.listener.travel(self._fault_s)
        return Cell(
            self._fault, NAMES[self._fault], self._phase.value, expected, self._observed(), how, travel,
            self._bound(before), "; ".join(seen.wrong),
        )  # fmt: skip

    def was_held_up(self) -> bool:
        """Whether the machine has held up the drive after the fault, or the service before it and in its stop."""
        simulation, listener, period_s = self._simulation, self._bench.listener, self._design.period_s
        end_s = self._fault_s + silence_s(simulation, period_s) + coast_s(simulation)
        drive_s = listener.longest_gap_s(self._fault_s - 0.1, end_s)
        usual_s = max(period_s, simulation.feedback_period_ms / 1e3) + simulation.cycle_ms / 1e3
        until_s = listener.orders[-1].time_s if self._fault == ENDED else self._fault_s
        service_s = listener.longest_gap_s(self._fault_s - 0.5, until_s, of_orders=True)
        return max(drive_s - usual_s, service_s - period_s) > _HELD_UP_TICKS * period_s

    def _observed(self) -> str:
        """Tell by the drive what became of the motion: it has stopped by itself, or was told to, or neither."""
        seen = self._seen
        if not seen.rested or seen.enabled:
            return TOLERATED
        if seen.time_outs:
            return DISABLED
        return TOLERATED if self._phase is Phase.IDLE else HELD

    def _bound(self, before: Snapshot) -> float:
        """Return how far the axis may travel, in axis unit."""
        place = self._bench.listener.place(self._fault_s)
        sample = Sample(self._fault_s, place, self._peak_speed(before), self._seen.effort, before["axis"]["state"])
        reference = Reference(
            [sample],
            self._fault_s,
            0.0 if self._phase is Phase.IDLE else distance(before),
            self._phase in {Phase.CHANGEOVER, Phase.SETTLING},
        )
        timeout_s, cycle_s = self._simulation.command_timeout_ms / 1e3, self._simulation.cycle_ms / 1e3
        budget = Budget(self._design, reference, timeout_s, cycle_s)
        if self._phase is Phase.IDLE:
            return budget.unnoticed()
        if self._fault == ENDED:
            return budget.stopping(budget.detection_s(0), budget.limits.acceleration)
        return budget.coasting(budget.command_timeout_s + budget.detection_s(1))

    def _peak_speed(self, before: Snapshot) -> float:
        """Return the largest speed from the fault on, in axis unit/s.

        A drive whose controller falls silent goes on with its last effort until it notices. One that was to accelerate
        may bring the axis to more than the cruise velocity by then, and the plant may answer better than its model.
        """
        settings = self._design.settings
        floor = self._design.rest_velocity if self._phase is Phase.HOLDING else settings.cruise_velocity
        speed = max(abs(float(before["axis"]["velocity"] or 0.0)), floor)
        if self._fault == ENDED:
            return speed
        driven = abs(settings.plant.gain / settings.plant.pole * self._seen.effort)
        return speed if driven <= _FASTER * speed else driven * (1.0 + MODEL_ERROR) / (1.0 - MODEL_ERROR)
