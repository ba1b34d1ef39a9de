"""The power stage of the simulated drive: what enables and disables it, and which effort acts on the true axis."""

from collections import deque
from collections.abc import Callable
from math import inf

from twostage_servo.simulation.drive_counters import DriveCounters
from twostage_servo.simulation.faults import DriveFaults
from twostage_servo.simulation.settings import SimulationSettings
from twostage_servo.simulation.true_axis import TrueAxis

# Codes of the shipped DBC's value table.
NO_FAULT = 0
COMMAND_TIMEOUT_FAULT = 1


class PowerStage:
    """Moves the true axis by the effort of commands, as long as they come and nothing forbids it; knows no frames.

    Between two events (an effort that arrives, the load that sets in, a time-out) the plant is advanced exactly, and
    only by :meth:`advance`: every other method but :meth:`command` advances it first.

    Parameters
    ----------
    settings : SimulationSettings
        The true plant and what goes wrong with it.
    start_s : float
        Present time, on the clock of all later calls, which must not run backwards.
    counters : DriveCounters
        Counts the command time-outs.
    on_boot : callable
        Called with the time at which the drive has booted, s; the axis then is where it is at that time.

    Attributes
    ----------
    axis : TrueAxis
        The axis that it moves.
    faults : DriveFaults
        What is wrong with it.
    enabled : bool
        Whether it is enabled.
    fault_code : int
        Latched fault, 0 for none.
    effort : float
        Effort that acts, effort unit; without the load.
    booted_s : float
        When the drive will have booted, s; infinity when it has.
    """

    def __init__(
        self,
        settings: SimulationSettings,
        start_s: float,
        counters: DriveCounters,
        on_boot: Callable[[float], None],
    ) -> None:
        self.axis = TrueAxis(settings, start_s)
        self.faults = DriveFaults()
        self.enabled = False
        self.fault_code = NO_FAULT
        self.effort = 0.0
        self.booted_s = inf
        self._counters = counters
        self._on_boot = on_boot
        self._delay_s = settings.delay_ms / 1e3
        self._command_timeout_s = settings.command_timeout_ms / 1e3
        self._stuck_effort: float | None = None  # what is applied whatever is commanded
        self._commanded_effort = 0.0  # of which `effort` acts
        self._arriving: deque[tuple[float, float]] = deque()  # (time at which it acts, effort)
        self._may_enable = False  # a command without Enable has been seen since the drive last had to stop
        self._commanded_s = -inf
        self._advanced_s = start_s

    def change(self, now_s: float, changed: DriveFaults) -> None:
        """Let other faults act from a time on, s.

        Raises
        ------
        ValueError
            If no plant is left with them. No fault has then changed.
        """
        self.advance(now_s)
        self.axis.change(changed)
        if not changed.ignores_effort:
            self._stuck_effort = None
        elif not self.faults.ignores_effort:
            self._stuck_effort = self._commanded_effort
        before, self.faults = self.faults, changed
        if changed.stays_enabled and not (before.stays_enabled or changed.safe_torque_off or self.fault_code):
            self.enabled = True
        self.effort = self._acting()
        is_new_fault = changed.fault_code not in {NO_FAULT, before.fault_code}
        if is_new_fault:
            self.fault_code = changed.fault_code
        if is_new_fault or (changed.safe_torque_off and not before.safe_torque_off):
            self._disable()
            self._may_enable = False

    def reboot(self, now_s: float, booted_s: float) -> None:
        """Disable it at a time, until the drive has booted at a later one, both in s. The axis meanwhile coasts."""
        self.advance(now_s)
        self._disable()
        self._may_enable = False
        self.fault_code = self.faults.fault_code
        self.booted_s = booted_s

    def command(self, now_s: float, effort: float, *, enable: bool | None) -> None:
        """Obey a command of the present time, to which it has been advanced: a time-out that is due comes before it.

        Parameters
        ----------
        now_s : float
            Present time, s.
        effort : float
            Commanded effort, effort unit.
        enable : bool or None
            Whether the command enables; None from a drive without Enable, which has no edge to wait for.
        """
        self._commanded_s = now_s
        if not enable:
            self._may_enable = True
            self.fault_code = self.faults.fault_code
        if enable is False and not self.faults.stays_enabled:
            self._disable()
        elif self.fault_code != NO_FAULT or self.faults.safe_torque_off:
            self._may_enable = False  # the edge came too early
        elif self._may_enable or self.faults.stays_enabled:
            self.enabled = True
            self._arriving.append((now_s + self._delay_s, effort))

    def advance(self, now_s: float) -> None:
        """Bring axis and power stage to a time in s, from event to event."""
        while True:
            obeys = self.enabled and not self.faults.stays_enabled
            # One that stayed enabled beyond its time-out, and does so no more, times out at once.
            timeout_s = max(self._commanded_s + self._command_timeout_s, self._advanced_s) if obeys else inf
            arrival_s = self._arriving[0][0] if self._arriving else inf
            event_s = min(timeout_s, arrival_s, self.booted_s)
            if event_s > now_s:
                break
            self.axis.advance(event_s, self.effort)
            if event_s == timeout_s:
                self._disable()
                self._may_enable = False
                self.fault_code = COMMAND_TIMEOUT_FAULT
                self._counters.command_timeouts += 1
            elif event_s == arrival_s:
                arrived = self._arriving.popleft()[1]
                self._commanded_effort = arrived if self._stuck_effort is None else self._stuck_effort
                self.effort = self._acting()
            else:
                self.booted_s = inf
                self._on_boot(event_s)
        self.axis.advance(now_s, self.effort)
        self._advanced_s = now_s

    def _acting(self) -> float:
        """Return the effort that acts with the present faults."""
        if not self.enabled:
            return self.faults.effort_while_disabled
        effort, limit = self._commanded_effort, self.faults.effort_limit
        return effort if limit is None else max(-limit, min(limit, effort))

    def _disable(self) -> None:
        self.enabled = False
        self._commanded_effort = 0.0
        self.effort = self._acting()
        self._arriving.clear()
