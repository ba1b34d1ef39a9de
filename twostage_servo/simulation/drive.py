"""The simulated drive: plant, encoder, firmware. Pure: it is told the time and given frames, and gives frames back."""

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from math import inf, isfinite
from random import Random
from typing import Any

import can

from twostage_servo.axis.messages import Feedback, Heartbeat, IndexMark
from twostage_servo.drives.drive import DriveSide
from twostage_servo.drives.frame import FrameRejected, SentFrame
from twostage_servo.simulation.drive_counters import DriveCounters
from twostage_servo.simulation.encoder import Encoder
from twostage_servo.simulation.faults import DriveFaults
from twostage_servo.simulation.firmware_timer import FirmwareTimer
from twostage_servo.simulation.settings import SimulationSettings
from twostage_servo.simulation.true_axis import TrueAxis

# Codes of the shipped DBC's value tables.
NO_FAULT = 0
COMMAND_TIMEOUT_FAULT = 1
READY_TO_SWITCH_ON = 1
OPERATION_ENABLED = 3
FAULT = 4
SWITCH_ON_DISABLED = 7


_TICKS_OF_THE_CLOCK_PER_BOOT = 100_000_000
"""Nanoseconds: no drive is switched off and on more often than every 0.1 s."""


def boots_by_the_clock() -> int:
    """Return a boot counter that is another one than that of a drive which was started a while before.

    A real drive keeps its count where a loss of its supply does not erase it. A process has no such memory, so the wall
    clock stands in: a counter of 8 bits is a new one for 25 s, and one in 256 times the old one after that.
    """
    return time.time_ns() // _TICKS_OF_THE_CLOCK_PER_BOOT


class SimulatedDrive:
    """A drive on its bus: obeys fresh commands, reports its position, and stops by itself when commands cease.

    It starts disabled, and only a rising edge of Enable (a command without it, then one with it) enables it: after the
    start as after a command time-out. So neither a rebooted drive nor a controller that was suspended and resumes moves
    the axis without a fresh command. A command without Enable acts at once, whatever the transport delay, and clears
    the fault, if its cause is gone.

    Between two events (an effort that arrives, the load that sets in, a time-out) the plant is advanced exactly, and
    only when its state is asked for.

    Parameters
    ----------
    settings : SimulationSettings
        The true plant and what goes wrong with it.
    side : DriveSide
        The drive's end of its frames.
    start_s : float
        Present time, on the clock of all later calls, which must not run backwards.
    boot_counter : int, optional
        Reported in the heartbeat; give another one to a drive that replaces a drive which was switched off.

    Attributes
    ----------
    counters : DriveCounters
        What the drive has seen so far.
    """

    def __init__(self, settings: SimulationSettings, side: DriveSide, start_s: float, boot_counter: int = 0) -> None:
        self.counters = DriveCounters()
        self._settings = settings
        self._side = side
        self._has_heartbeat = side.has_heartbeat
        self._has_index = settings.index_at is not None and side.has_index
        self._boot_counter = boot_counter
        self._axis = TrueAxis(settings, start_s)
        self._encoder = Encoder(settings)
        self._losses = Random(f"frame loss {settings.seed}")  # noqa: S311 - chance, not a secret; its own sequence
        self._delay_s = settings.delay_ms / 1e3
        self._command_timeout_s = settings.command_timeout_ms / 1e3

        self._faults = DriveFaults()
        self._stuck_effort: float | None = None  # what is applied whatever is commanded

        self._now_s = start_s  # time of the last call
        self._booted_s = inf  # when the drive will have booted; infinity when it has
        self._commanded_effort = 0.0
        self._effort = 0.0  # what of it acts
        self._arriving: deque[tuple[float, float]] = deque()  # (time at which it acts, effort)
        self._enabled = False
        self._may_enable = False  # a command without Enable has been seen since the drive last had to stop
        self._fault_code = NO_FAULT
        self._command_counter: int | None = None
        self._commanded_s = -inf
        self._feedback_counter = 0
        self._index_counter = 0
        self._feedback_asked = False
        self._feedback_timer = FirmwareTimer(start_s, settings.feedback_period_ms / 1e3)
        self._heartbeat_timer = FirmwareTimer(start_s, settings.heartbeat_ms / 1e3)

    @property
    def position(self) -> float:
        """True position at the time of the last call, axis unit."""
        self._advance()
        return self._axis.position

    @property
    def velocity(self) -> float:
        """True velocity at the time of the last call, axis unit/s."""
        self._advance()
        return self._axis.velocity

    @property
    def effort(self) -> float:
        """Effort that acts at the time of the last call, effort unit; without the load."""
        self._advance()
        return self._effort

    @property
    def due_s(self) -> float:
        """When the next :meth:`cycle` is needed, if no command comes before; s, in the past where one is needed now."""
        if self._booted_s != inf:
            return self._booted_s
        if self._feedback_asked or self._has_index:  # a mark may be passed in any cycle
            return -inf
        heartbeat_s = self._heartbeat_timer.due_s if self._has_heartbeat else inf
        return min(self._feedback_timer.due_s, heartbeat_s)

    @property
    def enabled(self) -> bool:
        """Whether the drive is enabled at the time of the last call."""
        self._advance()
        return self._enabled

    @property
    def fault_code(self) -> int:
        """Latched fault at the time of the last call, 0 for none."""
        self._advance()
        return self._fault_code

    @property
    def faults(self) -> DriveFaults:
        """What is wrong with it at the time of the last call; :meth:`change` changes it."""
        return self._faults

    def change(self, now_s: float, **faults: Any) -> None:
        """Let some faults come or go at a time; the others stay.

        Parameters
        ----------
        now_s : float
            Present time, s.
        **faults
            Fields of :class:`DriveFaults`.

        Raises
        ------
        TypeError
            If there is no such fault.
        ValueError
            If a value makes no sense. No fault has then changed.
        """
        changed = replace(self._faults, **faults)
        self._now_s = now_s
        self._advance()
        self._axis.change(changed)
        if not changed.ignores_effort:
            self._stuck_effort = None
        elif not self._faults.ignores_effort:
            self._stuck_effort = self._commanded_effort
        before, self._faults = self._faults, changed
        if changed.stays_enabled and not (before.stays_enabled or changed.safe_torque_off or self._fault_code):
            self._enabled = True
        self._effort = self._acting()
        is_new_fault = changed.fault_code not in {NO_FAULT, before.fault_code}
        if is_new_fault:
            self._fault_code = changed.fault_code
        if is_new_fault or (changed.safe_torque_off and not before.safe_torque_off):
            self._disable()
            self._may_enable = False

    def reboot(self, now_s: float, boot_s: float, *, counts: bool = True) -> None:
        """Boot anew, as after a loss of its supply: disabled at once, and deaf and dumb until it has booted.

        The axis meanwhile coasts. The encoder, an incremental one, then counts from 0 where the axis is at that time.

        Parameters
        ----------
        now_s : float
            Present time, s.
        boot_s : float
            How long it takes to boot, s; not negative.
        counts : bool, optional
            Whether the boot counter counts it; one that is not kept without supply shows the same again.

        Raises
        ------
        ValueError
            If `boot_s` is negative or not finite.
        """
        if not (isfinite(boot_s) and boot_s >= 0.0):
            raise ValueError(f"a drive cannot boot in {boot_s} s: give a time that is finite and not negative")
        self._now_s = now_s
        self._advance()
        self._disable()
        self._may_enable = False
        self._fault_code = self._faults.fault_code
        self._command_counter = None
        self._feedback_counter = self._index_counter = 0
        self._feedback_asked = False
        self._boot_counter += counts
        self._booted_s = now_s + boot_s

    def receive(self, message: can.Message, now_s: float) -> None:
        """Process a frame from the bus; the answer, if there is one, comes from the next :meth:`cycle`.

        A frame that cannot be used, an effort beyond the range of its signal included, is counted and leaves everything
        as it was; in particular it does not put off the command time-out.
        """
        self._now_s = now_s
        if self._booted_s != inf and self._is_booting():
            self.counters.lost += 1
            return
        if self._is_lost():
            return
        try:
            command = self._side.decode(message)
        except FrameRejected:
            self.counters.rejected += 1
            return
        if command is None:
            return
        if command.counter is not None and command.counter == self._command_counter:
            self.counters.stale += 1
            return
        self._advance()  # a time-out that is due comes before this command
        self.counters.accepted += 1
        self._command_counter = command.counter
        self._commanded_s = now_s
        self._feedback_asked = self._settings.feedback == "on_command"
        if not command.enable:  # also None: a drive without Enable has no edge to wait for
            self._may_enable = True
            self._fault_code = self._faults.fault_code
        if command.enable is False and not self._faults.stays_enabled:
            self._disable()
        elif self._fault_code != NO_FAULT or self._faults.safe_torque_off:
            self._may_enable = False  # the edge came too early
        elif self._may_enable or self._faults.stays_enabled:
            self._enabled = True
            self._arriving.append((now_s + self._delay_s, command.effort))

    def cycle(self, now_s: float) -> list[SentFrame]:
        """Run one firmware cycle; return the frames that the drive sends now."""
        self._now_s = now_s
        frames: list[SentFrame] = []
        if self._booted_s != inf and self._is_booting():
            return frames
        frames += self._side.answers()
        if self._has_index:
            self._advance()
            if (mark := self._axis.pop_passed_mark()) is not None:
                frames += self._index(mark)
        if self._feedback_asked or now_s >= self._feedback_timer.due_s:
            if self._feedback_asked:
                # Silence is noticed a little after the period, so that a command which is due just now can come first.
                self._feedback_timer.restart(
                    now_s + (self._settings.feedback_period_ms + self._settings.cycle_ms / 2) / 1e3
                )
                self._feedback_asked = False
            else:
                self._feedback_timer.restart_period(now_s)
            frames += self._feedback()
        if self._has_heartbeat and now_s >= self._heartbeat_timer.due_s:
            self._heartbeat_timer.restart_period(now_s)
            if not self._faults.heartbeat_silent:
                frames += self._heartbeat()
        return [frame for frame in frames if not self._is_lost()]

    def _feedback(self) -> Sequence[SentFrame]:
        self._advance()
        self.counters.samples += 1
        axis, faults, code = self._axis, self._faults, self._fault_code
        if not faults.frozen_counter:
            self._feedback_counter += 1
        return self._side.feedback(
            Feedback(
                position=self._encoder.sample(axis.position, faults.measure),
                counter=self._feedback_counter,
                enabled=self._enabled,
                fault=code != NO_FAULT,
                fault_code=code,
                command_timeout=code == COMMAND_TIMEOUT_FAULT,
                safe_torque_off=faults.safe_torque_off,
                positive_limit=axis.positive_limit,
                negative_limit=axis.negative_limit,
                home_switch=axis.home_switch,
            )
        )

    def _index(self, mark: float) -> Sequence[SentFrame]:
        self._index_counter += 1
        return self._side.index(IndexMark(self._encoder.latch(mark, self._faults.measure), self._index_counter))

    def _heartbeat(self) -> Sequence[SentFrame]:
        self._advance()
        if self._faults.heartbeat_state is not None:
            state = self._faults.heartbeat_state
        elif self._enabled:
            state = OPERATION_ENABLED
        elif self._fault_code != NO_FAULT:
            state = FAULT
        else:
            state = SWITCH_ON_DISABLED if self._faults.safe_torque_off else READY_TO_SWITCH_ON
        return self._side.heartbeat(Heartbeat(state, self._boot_counter))

    def _is_booting(self) -> bool:
        self._advance()
        return self._booted_s != inf

    def _is_lost(self) -> bool:
        if self._losses.random() < self._settings.frame_loss:
            self.counters.lost += 1
            return True
        return False

    def _advance(self) -> None:
        """Bring axis and firmware to the time of the last call, from event to event."""
        while True:
            obeys = self._enabled and not self._faults.stays_enabled
            timeout_s = self._commanded_s + self._command_timeout_s if obeys else inf
            arrival_s = self._arriving[0][0] if self._arriving else inf
            event_s = min(timeout_s, arrival_s, self._booted_s)
            if event_s > self._now_s:
                break
            self._axis.advance(event_s, self._effort)
            if event_s == timeout_s:
                self._disable()
                self._may_enable = False
                self._fault_code = COMMAND_TIMEOUT_FAULT
                self.counters.command_timeouts += 1
            elif event_s == arrival_s:
                arrived = self._arriving.popleft()[1]
                self._commanded_effort = arrived if self._stuck_effort is None else self._stuck_effort
                self._effort = self._acting()
            else:
                self._begin_to_run(event_s)
        self._axis.advance(self._now_s, self._effort)

    def _begin_to_run(self, booted_s: float) -> None:
        self._booted_s = inf
        self._encoder.restart(self._axis.position)
        self._axis.pop_passed_mark()  # nobody was there to see it
        self._feedback_timer.restart(booted_s)
        self._heartbeat_timer.restart(booted_s)

    def _acting(self) -> float:
        """Return the effort that acts with the present faults."""
        if not self._enabled:
            return self._faults.effort_while_disabled
        effort, limit = self._commanded_effort, self._faults.effort_limit
        return effort if limit is None else max(-limit, min(limit, effort))

    def _disable(self) -> None:
        self._enabled = False
        self._commanded_effort = 0.0
        self._effort = self._acting()
        self._arriving.clear()
