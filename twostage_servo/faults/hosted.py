"""One run of a fault that needs real processes: what is done to the service, and what its drive makes of it."""

import signal
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from random import Random

from twostage_servo.app.assembly import design
from twostage_servo.axis.design import AxisDesign  # noqa: TC001 - the class of an attribute
from twostage_servo.axis.state import State
from twostage_servo.faults.approach import Approach
from twostage_servo.faults.bench import Bench
from twostage_servo.faults.cell import Cell
from twostage_servo.faults.hosted_verdict import ENDED, HUNG, KILLED, STOPPED, HostedVerdict, Seen, coast_s, silence_s
from twostage_servo.faults.launch import LONGEST_S
from twostage_servo.faults.listening import Order, Snapshot
from twostage_servo.faults.phase import Phase
from twostage_servo.faults.watchdog import Watchdog

WATCHDOG_S = 0.5

_LATER_TICKS = 20
"""For how long a service that is back is watched."""
_SILENT_TICKS = 500
"""For how long one that seems to send nothing is watched."""


class HostedRun:
    """One run, on a bench of its own.

    Parameters
    ----------
    fault, phase
        What begins, and when.
    random
        Of the length of the move, and of the moment of the fault.
    given_up
        Is set where nobody wants the result any more.
    """

    def __init__(self, fault: int, phase: Phase, random: Random, given_up: threading.Event | None = None) -> None:
        self._fault = fault
        self._phase = phase
        self._random = random
        self._given_up = given_up
        self._bench: Bench
        self._watchdog: Watchdog
        self._design: AxisDesign
        self._seen = Seen()
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

            self._bench = bench = stack.enter_context(Bench(config, overrides, environment, self._given_up))
            self._design = design(bench.loaded)
            before = Approach(bench, self._design, self._phase, self._random).make()
            self._fault_s = time.monotonic()
            {STOPPED: self._stop, KILLED: self._kill, ENDED: self._end, HUNG: self._hang}[self._fault](before)
            self._look_at_the_drive()
            verdict = HostedVerdict(self._fault, self._phase, bench, self._design, self._fault_s, self._seen)
            return verdict.cell(before), verdict.was_held_up()

    def _stop(self, before: Snapshot) -> None:
        bench, seen = self._bench, self._seen
        bench.service.send_signal(signal.SIGSTOP)
        self._come_to_rest()
        continued_s = time.monotonic()
        bench.service.send_signal(signal.SIGCONT)
        later_s = before["uptime_s"] + 0.5 * silence_s(bench.loaded.config.simulation, self._design.period_s)
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

    def _come_to_rest(self) -> None:
        bench, seen = self._bench, self._seen
        simulation = bench.loaded.config.simulation
        unheard_s = self._fault_s + silence_s(simulation, self._design.period_s)
        seen.rested = bench.wait_for_rest(unheard_s, coast_s(simulation) + 5.0)
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
