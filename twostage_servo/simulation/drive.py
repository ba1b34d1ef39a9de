"""The simulated drive: its firmware, which reads and sends frames, with the encoder and the power stage behind it.

Pure: it is told the time and given frames, and gives frames back.
"""

import time
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
from twostage_servo.simulation.power_stage import COMMAND_TIMEOUT_FAULT, NO_FAULT, PowerStage
from twostage_servo.simulation.settings import SimulationSettings

# Codes of the shipped DBC's value table.
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

    The plant is advanced only when its state is asked for, see :class:`PowerStage`.

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
        self._power_stage = PowerStage(settings, start_s, self.counters, self._begin_to_run)
        self._encoder = Encoder(settings)
        self._losses = Random(f"frame loss {settings.seed}")  # noqa: S311 - chance, not a secret; its own sequence
        self._now_s = start_s  # time of the last call
        self._command_counter: int | None = None
        self._feedback_counter = 0
        self._index_counter = 0
        self._feedback_asked = False
        self._feedback_timer = FirmwareTimer(start_s, settings.feedback_period_ms / 1e3)
        self._heartbeat_timer = FirmwareTimer(start_s, settings.heartbeat_ms / 1e3)

    @property
    def position(self) -> float:
        """True position at the time of the last call, axis unit."""
        self._advance()
        return self._power_stage.axis.position

    @property
    def velocity(self) -> float:
        """True velocity at the time of the last call, axis unit/s."""
        self._advance()
        return self._power_stage.axis.velocity

    @property
    def effort(self) -> float:
        """Effort that acts at the time of the last call, effort unit; without the load."""
        self._advance()
        return self._power_stage.effort

    @property
    def due_s(self) -> float:
        """When the next :meth:`cycle` is needed, if no command comes before; s, in the past where one is needed now."""
        booted_s = self._power_stage.booted_s
        if booted_s != inf:
            return booted_s
        if self._feedback_asked or self._has_index:  # a mark may be passed in any cycle
            return -inf
        heartbeat_s = self._heartbeat_timer.due_s if self._has_heartbeat else inf
        return min(self._feedback_timer.due_s, heartbeat_s)

    @property
    def enabled(self) -> bool:
        """Whether the drive is enabled at the time of the last call."""
        self._advance()
        return self._power_stage.enabled

    @property
    def fault_code(self) -> int:
        """Latched fault at the time of the last call, 0 for none."""
        self._advance()
        return self._power_stage.fault_code

    @property
    def faults(self) -> DriveFaults:
        """What is wrong with it at the time of the last call; :meth:`change` changes it."""
        return self._power_stage.faults

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
        changed = replace(self._power_stage.faults, **faults)
        self._now_s = now_s
        self._power_stage.change(now_s, changed)

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
        self._power_stage.reboot(now_s, now_s + boot_s)
        self._command_counter = None
        self._feedback_counter = self._index_counter = 0
        self._feedback_asked = False
        self._boot_counter += counts

    def receive(self, message: can.Message, now_s: float) -> None:
        """Process a frame from the bus; the answer, if there is one, comes from the next :meth:`cycle`.

        A frame that cannot be used, an effort beyond the range of its signal included, is counted and leaves everything
        as it was; in particular it does not put off the command time-out.
        """
        self._now_s = now_s
        if self._power_stage.booted_s != inf and self._is_booting():
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
        self._power_stage.advance(now_s)  # a time-out that is due comes before this command
        self.counters.accepted += 1
        self._command_counter = command.counter
        self._feedback_asked = self._settings.feedback == "on_command"
        self._power_stage.command(now_s, command.effort, enable=command.enable)

    def cycle(self, now_s: float) -> list[SentFrame]:
        """Run one firmware cycle; return the frames that the drive sends now."""
        self._now_s = now_s
        frames: list[SentFrame] = []
        if self._power_stage.booted_s != inf and self._is_booting():
            return frames
        frames += self._side.answers()
        if self._has_index:
            self._advance()
            if (mark := self._power_stage.axis.pop_passed_mark()) is not None:
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
            if not self._power_stage.faults.heartbeat_silent:
                frames += self._heartbeat()
        return [frame for frame in frames if not self._is_lost()]

    def _feedback(self) -> Sequence[SentFrame]:
        self._advance()
        self.counters.samples += 1
        stage = self._power_stage
        axis, faults, code = stage.axis, stage.faults, stage.fault_code
        if not faults.frozen_counter:
            self._feedback_counter += 1
        return self._side.feedback(
            Feedback(
                position=self._encoder.sample(axis.position, faults.measure),
                counter=self._feedback_counter,
                enabled=stage.enabled,
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
        latched = self._encoder.latch(mark, self._power_stage.faults.measure)
        return self._side.index(IndexMark(latched, self._index_counter))

    def _heartbeat(self) -> Sequence[SentFrame]:
        self._advance()
        stage = self._power_stage
        if stage.faults.heartbeat_state is not None:
            state = stage.faults.heartbeat_state
        elif stage.enabled:
            state = OPERATION_ENABLED
        elif stage.fault_code != NO_FAULT:
            state = FAULT
        else:
            state = SWITCH_ON_DISABLED if stage.faults.safe_torque_off else READY_TO_SWITCH_ON
        return self._side.heartbeat(Heartbeat(state, self._boot_counter))

    def _is_booting(self) -> bool:
        self._advance()
        return self._power_stage.booted_s != inf

    def _is_lost(self) -> bool:
        if self._losses.random() < self._settings.frame_loss:
            self.counters.lost += 1
            return True
        return False

    def _advance(self) -> None:
        """Bring power stage and axis to the time of the last call."""
        self._power_stage.advance(self._now_s)

    def _begin_to_run(self, booted_s: float) -> None:
        axis = self._power_stage.axis
        self._encoder.restart(axis.position)
        axis.pop_passed_mark()  # nobody was there to see it
        self._feedback_timer.restart(booted_s)
        self._heartbeat_timer.restart(booted_s)
