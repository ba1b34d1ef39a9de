"""The faults that need real processes: a service that is stopped, killed, ended or hangs, and a power cut.

The rest of the campaign is in simulated time; these run on the machine's clock. A machine that is busy holds processes
up, which travels as well. So a cell that is not met while frames came late is run again; the verdict is that of a run
in which they did not.
"""

import functools
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import NamedTuple

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.state import State
from twostage_servo.faults.bench import LONGEST_S, Bench, BenchError, Child
from twostage_servo.faults.budget import Budget, Reference
from twostage_servo.faults.campaign import Cell, NotOperableError
from twostage_servo.faults.listening import Refusal, Snapshot
from twostage_servo.faults.plan import cruise_end, plan_target, settling_begin
from twostage_servo.faults.power_cut import damaged
from twostage_servo.faults.table import DISABLED, HELD, TOLERATED, Phase
from twostage_servo.faults.watchdog import Watchdog
from twostage_servo.faults.world import Sample
from twostage_servo.service.assembly import design

STOPPED, KILLED, ENDED, HUNG, POWER_CUT = 37, 38, 39, 42, 54

NAMES = {
    STOPPED: "service stopped, then continued (SIGSTOP)",
    KILLED: "service killed, then started again",
    ENDED: "service ended (SIGTERM)",
    HUNG: "loop hangs: the service manager kills it",
    POWER_CUT: "power cut while a trip file is written",
}

WATCHDOG_S = 0.5
POWER_CUTS = 20

_ATTEMPTS = 6
_TRIES = 8
"""Moves until the phase is met that the fault is to begin in: a busy machine may show it when it has passed."""
_LATER_TICKS = 20
"""How long the service is watched after it is back."""
_HELD_UP_TICKS = 1.5
"""Frames that are later than this show a machine that holds processes up."""


class HostedFault(NamedTuple):
    """A fault by its number, and the phase in which it begins."""

    fault: int
    phase: Phase


def hosted_cells(phases: Iterable[Phase]) -> list[HostedFault]:
    """Return what there is to run in some phases."""
    wanted = list(phases)
    cells = [HostedFault(fault, phase) for fault in (STOPPED, KILLED, ENDED, HUNG) for phase in wanted]
    return cells + [HostedFault(POWER_CUT, Phase.IDLE)] * (Phase.IDLE in wanted)


def run_hosted(fault: int, phase: Phase, config: Path | None, overrides: Sequence[str], seed: int) -> Cell:
    """Run one cell. It takes seconds; several may run at the same time, in threads as in processes.

    Parameters
    ----------
    fault, phase
        One of :func:`hosted_cells`.
    config
        Path of the configuration; None for the embedded one.
    overrides
        ``KEY=VALUE`` arguments that belong to it.
    seed
        Of the length of the move, and of the moment of the fault in it.

    Raises
    ------
    ConfigError
        If the configuration cannot be used.
    NotOperableError
        If the axis does not even come so far that the fault could begin.
    """
    if fault == POWER_CUT:
        return _cut_power(seed)
    trouble = ""
    for attempt in range(_ATTEMPTS):
        try:
            cell, held_up = _Run(fault, phase, Random(f"{seed} {phase}")).play(config, overrides)  # noqa: S311
        except (BenchError, Refusal, OSError) as error:
            trouble = str(error)
            continue
        if cell.met or not held_up or attempt == _ATTEMPTS - 1:
            return cell
    raise NotOperableError(f"fault {fault}, {phase.value}: {trouble}")


@dataclass(slots=True)
class _Seen:
    """What came of a fault.

    Attributes
    ----------
    exit_code
        Of the service, if it has ended.
    trip
        Code of the trip that the service reports afterwards.
    alone
        How often the drive has stopped by itself for want of commands.
    rested
        Whether the axis came to rest.
    enabled
        Whether the drive says that it is enabled, at the end.
    wrong
        What else is not as it should be.
    """

    exit_code: int | None = None
    trip: str = ""
    alone: int = 0
    rested: bool = False
    enabled: bool | None = None
    wrong: list[str] = field(default_factory=list)


class _Run:
    """One run of one cell, on a bench of its own."""

    def __init__(self, fault: int, phase: Phase, random: Random) -> None:
        self._fault = fault
        self._phase = phase
        self._random = random
        self._watchdog: Watchdog | None = None
        self._bench: Bench
        self._design: AxisDesign
        self._seen = _Seen()
        self._fault_s = 0.0
        self._effort = 0.0

    def play(self, config: Path | None, overrides: Sequence[str]) -> tuple[Cell, bool]:
        """Return the cell, and whether the machine has held processes up meanwhile."""
        with ExitStack() as stack:

            def environment(folder: Path) -> dict[str, str]:
                if self._fault != HUNG:
                    return {}
                self._watchdog = stack.enter_context(Watchdog(folder / "notify", WATCHDOG_S))
                return self._watchdog.environment

            self._bench = bench = stack.enter_context(Bench(config, overrides, environment))
            self._design = design(bench.loaded)
            self._reach_the_phase()
            before = bench.operator.latest
            self._fault_s = time.monotonic()
            {STOPPED: self._stop, KILLED: self._kill, ENDED: self._end, HUNG: self._hang}[self._fault]()
            self._look_at_the_drive()
            return self._judge(before), self._held_up()

    # Up to the fault -------------------------------------------------------------------------------------------------

    def _reach_the_phase(self) -> None:
        bench, config = self._bench, self._bench.loaded.config
        bench.watch(lambda now: now["axis"]["cia402"] == "ready to switch on", "an axis that can be armed")
        if self._phase is Phase.IDLE:
            self._wait_a_little()
            return
        ask = bench.operator.ask
        velocity = config.axis.cruise_velocity
        start = ask(op="arm")["axis"]["position"]
        bench.watch(_untripped(lambda now: now["axis"]["state"] == State.HOLDING), "the axis to be armed")
        if config.axis.homing.required:
            ask(op="home", position=start)
        target = plan_target(self._design, start, velocity, self._random.random())
        for _ in range(_TRIES):
            ask(op="move", position=target, velocity=velocity)
            bench.operator.unread.clear()
            bench.watch(_untripped(self._has_begun), f"the axis to be {self._phase.value}")
            self._wait_a_little()
            bench.operator.take()
            if not self._has_passed(bench.operator.latest):
                return
            bench.watch(_untripped(lambda now: now["axis"]["state"] == State.HOLDING), "the end of the move")
            start, target = target, start
        raise BenchError(f"the phase {self._phase.value} has always passed already: the machine is too busy")

    def _wait_a_little(self) -> None:
        """Let the fault begin anywhere between two ticks."""
        time.sleep(self._random.uniform(0.0, self._design.period_s))

    def _has_begun(self, now: Snapshot) -> bool:
        state, velocity = now["axis"]["state"], self._bench.loaded.config.axis.cruise_velocity
        match self._phase:
            case Phase.ACCELERATING:
                return state == State.SPEED_STAGE and abs(now["axis"]["velocity"]) >= 0.5 * velocity
            case Phase.CRUISING:
                return state == State.SPEED_STAGE and _to_go(now) <= cruise_end(self._design, velocity)
            case Phase.CHANGEOVER:
                return bool(state == State.POSITION_STAGE)
            case Phase.SETTLING:
                return state == State.POSITION_STAGE and _to_go(now) <= settling_begin(self._design, velocity)
            case _:
                return bool(state == State.HOLDING)

    def _has_passed(self, now: Snapshot) -> bool:
        state, velocity = now["axis"]["state"], self._bench.loaded.config.axis.cruise_velocity
        match self._phase:
            case Phase.ACCELERATING:
                return state != State.SPEED_STAGE or abs(now["axis"]["velocity"]) >= 0.98 * velocity
            case Phase.CRUISING:
                return bool(state != State.SPEED_STAGE)
            case Phase.CHANGEOVER:
                return state != State.POSITION_STAGE or _to_go(now) <= settling_begin(self._design, velocity)
            case Phase.SETTLING:
                return bool(state != State.POSITION_STAGE)
            case _:
                return bool(state != State.HOLDING)

    # The faults ------------------------------------------------------------------------------------------------------

    def _stop(self) -> None:
        bench, seen = self._bench, self._seen
        stopped_at = bench.operator.latest["uptime_s"]
        bench.service.send(signal.SIGSTOP)
        self._come_to_rest()
        continued_s = time.monotonic()
        bench.service.send(signal.SIGCONT)
        bench.watch(lambda now: now["uptime_s"] > stopped_at + 0.5 * self._silence_s, "the service to be back")
        # A command that was about to leave when the service was stopped leaves now; the drive takes it for no edge.
        self._watch_what_follows(continued_s, spared=1)
        axis, trip = bench.operator.latest["axis"], bench.operator.latest["trip"]
        seen.trip = trip["code"] if trip else ""
        if axis["state"] not in {State.TRIPPED, State.DISARMED}:
            seen.wrong.append(f"the axis is {axis['state']} after SIGCONT")

    def _kill(self) -> None:
        bench, seen = self._bench, self._seen
        seen.exit_code = bench.service.end(signal.SIGKILL)
        self._come_to_rest()
        again_s = time.monotonic()
        bench.start_service()
        self._watch_what_follows(again_s)
        axis, trip = bench.operator.latest["axis"], bench.operator.latest["trip"]
        if axis["state"] != State.DISARMED or trip:
            seen.wrong.append(f"the axis is {axis['state']} after the start")

    def _end(self) -> None:
        bench, seen = self._bench, self._seen
        bench.service.send(signal.SIGTERM)
        bench.wait(lambda: bench.service.ended, "the service to end")
        seen.exit_code = bench.service.process.returncode
        self._come_to_rest()
        if seen.exit_code != 0:
            seen.wrong.append(f"exit code {seen.exit_code}")
        last = bench.listener.orders[-1]
        if last.effort or last.enable:
            seen.wrong.append(f"the last command has effort {last.effort:g}, enable {last.enable}")

    def _hang(self) -> None:
        bench, seen, watchdog = self._bench, self._seen, self._watchdog
        assert watchdog is not None  # noqa: S101 - made with the environment
        heard = watchdog.heard()
        if not {"READY=1", "WATCHDOG=1"} <= heard:
            seen.wrong.append(f"the service manager had heard {sorted(heard)} only")
        bench.service.send(signal.SIGUSR1)
        if not watchdog.wait_for_silence(LONGEST_S, bench.take):
            seen.wrong.append("the signs of life did not cease")
        seen.exit_code = bench.service.end(signal.SIGABRT)
        if seen.exit_code != -signal.SIGABRT:
            seen.wrong.append(f"exit code {seen.exit_code} after SIGABRT")
        self._come_to_rest()

    @property
    def _silence_s(self) -> float:
        """For how long there are no commands at the least, in s: the drive must have noticed."""
        return self._timeout_s + 2.0 * self._design.period_s

    @property
    def _timeout_s(self) -> float:
        return self._bench.loaded.config.simulation.command_timeout_ms / 1e3

    def _come_to_rest(self) -> None:
        bench = self._bench
        coast_s = 20.0 / bench.loaded.config.simulation.pole
        self._seen.rested = bench.wait_for_rest(self._fault_s + self._silence_s, coast_s + 5.0)
        self._effort = bench.listener.orders[-1].effort

    def _watch_what_follows(self, since_s: float, spared: int = 0) -> None:
        """Watch a service that is back: no effort, no drive enabled, no motion."""
        bench, seen = self._bench, self._seen
        first = bench.operator.latest["ticks"]["count"]
        bench.watch(lambda now: now["ticks"]["count"] >= first + _LATER_TICKS, "the service to go on")
        bench.take()
        orders = [order for order in bench.listener.orders if order.time_s >= since_s][spared:]
        if any(order.effort or order.enable for order in orders):
            seen.wrong.append("the service commands an effort, or enables the drive, without being asked to")
        if not orders:
            seen.wrong.append("the service sends no commands")
        if effort := bench.operator.latest["axis"]["effort"]:
            seen.wrong.append(f"the effort is {effort:g}")
        if seen.rested and (moved := bench.listener.travel(since_s)) > bench.tolerance:
            seen.wrong.append(f"the axis has moved by {moved:.3g} after it had come to rest")

    def _look_at_the_drive(self) -> None:
        bench, seen = self._bench, self._seen
        bench.take()
        seen.enabled = bench.listener.reports[-1].enabled
        bench.drive.end(signal.SIGTERM)
        seen.alone = int(bench.drive.printed().get("counters", {}).get("command_timeouts", -1))

    # The verdict -----------------------------------------------------------------------------------------------------

    def _judge(self, before: Snapshot) -> Cell:
        seen, idle = self._seen, self._phase is Phase.IDLE
        if idle:
            expected = TOLERATED
        else:
            expected = HELD if self._fault == ENDED else DISABLED
        if not seen.rested or seen.enabled:
            seen.wrong.append("the axis goes on" if not seen.rested else "the drive is enabled")
        reason = {
            STOPPED: seen.trip,
            KILLED: "SIGKILL",
            ENDED: f"exit {seen.exit_code}",
            HUNG: "SIGABRT" if seen.exit_code == -signal.SIGABRT else f"exit {seen.exit_code}",
        }[self._fault]
        return Cell(
            self._fault,
            NAMES[self._fault],
            self._phase.value,
            expected,
            self._observed(),
            reason,
            self._bench.listener.travel(self._fault_s),
            self._bound(before),
            "; ".join(seen.wrong),
        )

    def _observed(self) -> str:
        """Tell by the drive what became of the motion: it has stopped by itself, or was told to, or neither."""
        seen = self._seen
        if not seen.rested or seen.enabled:
            return TOLERATED
        if seen.alone > 0:
            return DISABLED
        return TOLERATED if self._phase is Phase.IDLE else HELD

    def _bound(self, before: Snapshot) -> float:
        """Return how far the axis may travel, in axis unit.

        A drive whose controller falls silent applies its last effort until it notices: while the axis accelerates, that
        is more than a cruise takes.
        """
        config, plant = self._bench.loaded.config, self._design.settings.plant
        floor = self._design.rest_velocity if self._phase is Phase.HOLDING else config.axis.cruise_velocity
        speed = max(abs(before["axis"]["velocity"] or 0.0), floor)
        if self._fault != ENDED:
            speed = max(speed, abs(plant.gain / plant.pole * self._effort))
        place = self._bench.listener.place(self._fault_s)
        samples = [Sample(self._fault_s, place, speed, self._effort, before["axis"]["state"])]
        to_go = 0.0 if self._phase is Phase.IDLE else _to_go(before)
        closing = self._phase in {Phase.CHANGEOVER, Phase.SETTLING}
        reference = Reference(samples, self._fault_s, to_go, closing)
        budget = Budget(self._design, reference, self._timeout_s, config.simulation.cycle_ms / 1e3)
        if self._phase is Phase.IDLE:
            return budget.unnoticed()
        if self._fault == ENDED:
            return budget.stopping(budget.noticing_s(0), budget.limits.acceleration)
        return budget.coasting(budget.command_timeout_s + budget.noticing_s(1))

    def _held_up(self) -> bool:
        """Whether the machine has held up the drive after the fault, or the service before and in its stop."""
        config, listener, period_s = self._bench.loaded.config, self._bench.listener, self._design.period_s
        end_s = self._fault_s + self._silence_s + 20.0 / config.simulation.pole
        drive_s = listener.longest_gap_s(self._fault_s - 0.1, end_s)
        usual_s = max(period_s, config.simulation.feedback_period_ms / 1e3) + config.simulation.cycle_ms / 1e3
        until_s = listener.orders[-1].time_s if self._fault == ENDED else self._fault_s
        service_s = listener.longest_gap_s(self._fault_s - 0.5, until_s, of_orders=True)
        return max(drive_s - usual_s, service_s - period_s) > _HELD_UP_TICKS * period_s


def _untripped(condition: Callable[[Snapshot], bool]) -> Callable[[Snapshot], bool]:
    def check(now: Snapshot) -> bool:
        if now["trip"]:
            raise BenchError(f"the axis tripped before the fault: {now['trip']['cause']}")
        return condition(now)

    return check


def _to_go(now: Snapshot) -> float:
    axis = now["axis"]
    if axis["position"] is None or axis["target"] is None:
        return float("inf")
    return abs(float(axis["target"]) - float(axis["position"]))


def _cut_power(seed: int) -> Cell:
    import tempfile  # noqa: PLC0415

    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="twostage-servo-")))
        trips = folder / "trips"
        child = Child(folder, "power_cut", ["power_cut", str(trips), str(seed), str(POWER_CUTS)])
        stack.callback(child.kill)
        exit_code = child.process.wait(POWER_CUTS * LONGEST_S)
        wrong = damaged(trips)
        if exit_code != 0:
            wrong.append(f"the writing ended by itself: {child.log()[-1000:]}")
    return Cell(
        POWER_CUT, NAMES[POWER_CUT], Phase.IDLE.value, TOLERATED, TOLERATED, "", 0.0, 0.0, "; ".join(wrong)
    )
