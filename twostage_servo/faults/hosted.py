"""One run of a fault that needs real processes: what is done to the service, and what its drive makes of it."""

import signal
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from twostage_servo.app.assembly import design
from twostage_servo.axis.design import AxisDesign  # noqa: TC001 - the class of an attribute
from twostage_servo.axis.state import State
from twostage_servo.control.plant import MODEL_ERROR
from twostage_servo.faults.approach import Approach, distance
from twostage_servo.faults.bench import Bench
from twostage_servo.faults.budget import Budget, Reference
from twostage_servo.faults.cell import Cell
from twostage_servo.faults.launch import LONGEST_S
from twostage_servo.faults.listening import Order, Snapshot
from twostage_servo.faults.phase import Phase
from twostage_servo.faults.table import DISABLED, HELD, TOLERATED
from twostage_servo.faults.watchdog import Watchdog
from twostage_servo.faults.world import Sample

STOPPED, KILLED, ENDED, HUNG = 37, 38, 39, 42

NAMES = {
    STOPPED: "service stopped, then continued (SIGSTOP)",
    KILLED: "service killed, then started again",
    ENDED: "service ended (SIGTERM)",
    HUNG: "loop hangs: the service manager kills it",
}

WATCHDOG_S = 0.5

_LATER_TICKS = 20
"""For how long a service that is back is watched."""
_SILENT_TICKS = 500
"""For how long one that seems to send nothing is watched."""
_HELD_UP_TICKS = 1.5
"""Frames that are later than this show a machine that holds processes up."""
_FASTER = 1.1
"""An effort for a speed that is greater by this factor is meant to accelerate."""


@dataclass(slots=True)
class _Seen:
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


class HostedRun:
    """One run, on a bench of its own.

    Parameters
    ----------
    fault, phase
        What begins, and when.
    random
        Of the length of the move, and of the moment of the fault.
    """

    def __init__(self, fault: int, phase: Phase, random: Random) -> None:
        self._fault = fault
        self._phase = phase
        self._random = random
        self._bench: Bench
        self._watchdog: Watchdog
        self._design: AxisDesign
        self._seen = _Seen()
        self._fault_s = 0.0

    def play(self, config: Path | None, overrides: Sequence[str]) -> tuple[Cell, bool]:
        """Return the cell, and whether the machine has held processes up meanwhile.

        Parameters
        ----------
        config
            Path of the configuration; None for the embedded one.
        overrides
            ``KEY=VALUE`` arguments that belong to it.

        Raises
        ------
        ConfigError
            If the configuration cannot be used.
        BenchError, RefusalError, OSError
            If the axis did not come so far that the fault could begin, or all came to a standstill after it.
        """
        with ExitStack() as stack:

            def environment(folder: Path) -> dict[str, str]:
                if self._fault != HUNG:
                    return {}
                self._watchdog = stack.enter_context(Watchdog(folder / "notify", WATCHDOG_S))
                return self._watchdog.environment

            self._bench = bench = stack.enter_context(Bench(config, overrides, environment))
            self._design = design(bench.loaded)
            before = Approach(bench, self._design, self._phase, self._random).make()
            self._fault_s = time.monotonic()
            {STOPPED: self._stop, KILLED: self._kill, ENDED: self._end, HUNG: self._hang}[self._fault](before)
            self._look_at_the_drive()
            return self._judge(before), self._was_held_up()

    # The faults ------------------------------------------------------------------------------------------------------

    def _stop(self, before: Snapshot) -> None:
        bench, seen = self._bench, self._seen
        bench.service.send_signal(signal.SIGSTOP)
        self._come_to_rest()
        continued_s = time.monotonic()
        bench.service.send_signal(signal.SIGCONT)
        later_s = before["uptime_s"] + 0.5 * self._silence_s
        bench.watch(lambda now: now["uptime_s"] > later_s, "the service to be back")
        # A command that was about to leave when the service was stopped leaves now; the drive takes it for no edge.
        self._watch_what_follows(continued_s, spared=1)
        axis, trip = bench.operator.latest["axis"], bench.operator.latest["trip"]
        seen.trip = trip["code"] if trip else ""
        allowed = {State.DISARMED} if self._phase is Phase.IDLE else {State.TRIPPED, State.DISARMED}
        if axis["state"] not in allowed:
            seen.wrong.append(f"the axis is {axis['state']} after SIGCONT")

    def _kill(self, _: Snapshot) -> None:
        bench, seen = self._bench, self._seen
        seen.exit_code = bench.service.end(signal.SIGKILL)
        self._come_to_rest()
        again_s = time.monotonic()
        bench.start_service()
        self._watch_what_follows(again_s)
        axis, trip = bench.operator.latest["axis"], bench.operator.latest["trip"]
        if axis["state"] != State.DISARMED or trip:
            seen.wrong.append(f"the axis is {axis['state']} after the start")

    def _end(self, _: Snapshot) -> None:
        bench, seen = self._bench, self._seen
        bench.service.send_signal(signal.SIGTERM)
        bench.wait(lambda: bench.service.has_ended, "the service to end")
        seen.exit_code = bench.service.returncode
        self._come_to_rest()
        if seen.exit_code != 0:
            seen.wrong.append(f"exit code {seen.exit_code}")
        last = bench.listener.orders[-1]
        if last.effort or last.enable:
            seen.wrong.append(f"the last command has effort {last.effort:g}, enable {last.enable}")

    def _hang(self, _: Snapshot) -> None:
        bench, seen = self._bench, self._seen
        heard = self._watchdog.heard()
        if not {"READY=1", "WATCHDOG=1"} <= heard:
            seen.wrong.append(f"the service manager had heard no more than {sorted(heard)}")
        bench.service.send_signal(signal.SIGUSR1)
        if not self._watchdog.wait_for_silence(LONGEST_S, bench.read_frames):
            seen.wrong.append("the signs of life did not cease")
        seen.exit_code = bench.service.end(signal.SIGABRT)
        if seen.exit_code != -signal.SIGABRT:
            seen.wrong.append(f"exit code {seen.exit_code} after SIGABRT")
        self._come_to_rest()

    @property
    def _timeout_s(self) -> float:
        return self._bench.loaded.config.simulation.command_timeout_ms / 1e3

    @property
    def _silence_s(self) -> float:
        """For how long there are no commands at the least, in s: so that the drive must have noticed."""
        return self._timeout_s + 2.0 * self._design.period_s

    @property
    def _coast_s(self) -> float:
        return 20.0 / self._bench.loaded.config.simulation.pole

    def _come_to_rest(self) -> None:
        bench, seen = self._bench, self._seen
        seen.rested = bench.wait_for_rest(self._fault_s + self._silence_s, self._coast_s + 5.0)
        seen.effort = bench.listener.orders[-1].effort

    def _watch_what_follows(self, since_s: float, spared: int = 0) -> None:
        """Watch a service that is back: no effort, no drive enabled, no motion."""
        bench, seen = self._bench, self._seen

        def later() -> list[Order]:
            return [order for order in bench.listener.orders if order.time_s >= since_s][spared:]

        # What has waited in the connection since the wait for rest tells nothing of now; and on a busy machine the bus
        # may bring later what the service has sent sooner.
        bench.operator.read_snapshots()
        bench.operator.unread.clear()
        first = bench.operator.latest["ticks"]["count"]
        bench.watch(
            lambda now: now["ticks"]["count"] >= first + (_LATER_TICKS if later() else _SILENT_TICKS),
            "the service to go on",
        )
        orders = later()
        if not orders:
            seen.wrong.append("the service sends no commands")
        if any(order.effort or order.enable for order in orders):
            seen.wrong.append("the service commands an effort, or enables the drive, without being asked to")
        if effort := bench.operator.latest["axis"]["effort"]:
            seen.wrong.append(f"the effort is {effort:g}")
        if seen.rested and (moved := bench.listener.travel(since_s)) > bench.tolerance:
            seen.wrong.append(f"the axis has moved by {moved:.3g} after it had come to rest")

    def _look_at_the_drive(self) -> None:
        bench, seen = self._bench, self._seen
        bench.read_frames()
        seen.enabled = bench.listener.reports[-1].enabled
        bench.drive.end(signal.SIGTERM)
        seen.time_outs = bench.drive.printed().get("counters", {}).get("command_timeouts")
        if not seen.rested:
            seen.wrong.append("the axis does not come to rest")
        if seen.enabled:
            seen.wrong.append("the drive is still enabled")
        if seen.time_outs is None:
            seen.wrong.append("the drive did not end as it should")

    # The verdict -----------------------------------------------------------------------------------------------------

    def _judge(self, before: Snapshot) -> Cell:
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
        cycle_s = self._bench.loaded.config.simulation.cycle_ms / 1e3
        budget = Budget(self._design, reference, self._timeout_s, cycle_s)
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

    def _was_held_up(self) -> bool:
        """Whether the machine has held up the drive after the fault, or the service before it and in its stop."""
        simulation, listener, period_s = (
            self._bench.loaded.config.simulation,
            self._bench.listener,
            self._design.period_s,
        )
        end_s = self._fault_s + self._silence_s + self._coast_s
        drive_s = listener.longest_gap_s(self._fault_s - 0.1, end_s)
        usual_s = max(period_s, simulation.feedback_period_ms / 1e3) + simulation.cycle_ms / 1e3
        until_s = listener.orders[-1].time_s if self._fault == ENDED else self._fault_s
        service_s = listener.longest_gap_s(self._fault_s - 0.5, until_s, of_orders=True)
        return max(drive_s - usual_s, service_s - period_s) > _HELD_UP_TICKS * period_s
