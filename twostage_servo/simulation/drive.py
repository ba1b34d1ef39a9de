"""The simulated drive: plant, encoder, firmware. Pure: it is told the time and given frames, and gives frames back."""

from collections import deque
from dataclasses import dataclass
from math import floor, inf
from random import Random

import can

from twostage_servo.canbus.profile import DriveProfile, Feedback, FrameRejected, Heartbeat, Identifier
from twostage_servo.simulation.plant import TruePlant
from twostage_servo.simulation.settings import SimulationSettings

# Codes of the shipped DBC's value tables.
NO_FAULT = 0
COMMAND_TIMEOUT_FAULT = 1
READY_TO_SWITCH_ON = 1
OPERATION_ENABLED = 3
FAULT = 4

# A cycle that comes early by a rounding is not early.
_ROUNDING_S = 1e-9


@dataclass(slots=True)
class DriveCounters:
    """What the drive has seen since it started.

    Attributes
    ----------
    accepted, rejected, stale : int
        Commands taken; malformed, out of range or with a wrong checksum; with the alive counter of the command before.
    lost : int
        Frames that the fault injection took away, in either direction.
    samples : int
        Positions sampled for feedback, whether the frame then got lost or not.
    command_timeouts : int
        Times the drive disabled itself because commands ceased.
    """

    accepted: int = 0
    rejected: int = 0
    stale: int = 0
    lost: int = 0
    samples: int = 0
    command_timeouts: int = 0


class SimulatedDrive:
    """A drive on its bus: obeys fresh commands, reports its position, and stops by itself when commands cease.

    It starts disabled, and only a rising edge of Enable (a command without it, then one with it) enables it: after the
    start as after a command time-out. So neither a rebooted drive nor a controller that stalled and resumes moves the
    axis without somebody's fresh wish. A command without Enable acts at once, whatever the transport delay, and clears
    the fault.

    Between two events (an effort that arrives, the load that sets in, a time-out) the plant is advanced exactly, and
    only when its state is asked for.

    Parameters
    ----------
    settings : SimulationSettings
        The true plant and what goes wrong with it.
    profile : DriveProfile
        Layout of the frames.
    start_s : float
        Present time, on the clock of all later calls, which must not run backwards.
    boot_counter : int, optional
        Reported in the heartbeat; give another one to a drive that replaces a drive which was switched off.

    Attributes
    ----------
    counters : DriveCounters
        What the drive has seen so far.
    """

    def __init__(
        self, settings: SimulationSettings, profile: DriveProfile, start_s: float, boot_counter: int = 0
    ) -> None:
        self.counters = DriveCounters()
        self._settings = settings
        self._profile = profile
        self._heartbeat_id = profile.heartbeat_id
        self._boot_counter = boot_counter
        self._plant = TruePlant(settings.gain, settings.pole, settings.coulomb_friction, settings.initial_position)
        self._noise = Random(settings.seed)  # noqa: S311 - measurement noise, not a secret
        self._losses = Random(f"frame loss {settings.seed}")  # noqa: S311 - likewise; its own sequence
        self._delay_s = settings.delay_ms / 1e3
        self._command_timeout_s = settings.command_timeout_ms / 1e3

        self._now_s = start_s  # time of the last call
        self._plant_s = start_s  # time up to which the plant has been advanced
        self._load = 0.0
        self._load_due_s = start_s + settings.load_at_s
        self._effort = 0.0
        self._arriving: deque[tuple[float, float]] = deque()  # (time at which it acts, effort)
        self._enabled = False
        self._may_enable = False  # a command without Enable has been seen since the start or the time-out
        self._fault_code = NO_FAULT
        self._command_counter: int | None = None
        self._commanded_s = -inf
        self._feedback_counter = 0
        self._feedback_asked = False
        self._feedback_timer = _FirmwareTimer(start_s, settings.feedback_period_ms / 1e3)
        self._heartbeat_timer = _FirmwareTimer(start_s, settings.heartbeat_ms / 1e3)

    @property
    def position(self) -> float:
        """True position at the time of the last call, axis unit."""
        self._advance()
        return self._plant.position

    @property
    def velocity(self) -> float:
        """True velocity at the time of the last call, axis unit/s."""
        self._advance()
        return self._plant.velocity

    @property
    def effort(self) -> float:
        """Effort that acts at the time of the last call, effort unit; without the load."""
        self._advance()
        return self._effort

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

    def receive(self, message: can.Message, now_s: float) -> None:
        """Take a frame from the bus; the answer, if there is one, comes from the next :meth:`cycle`.

        A frame that cannot be used, an effort beyond the range of its signal included, is counted and leaves everything
        as it was; in particular it does not put off the command time-out.
        """
        self._now_s = now_s
        if self._is_lost():
            return
        try:
            command = self._profile.decode_command(message)
        except FrameRejected:
            self.counters.rejected += 1
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
            self._fault_code = NO_FAULT
        if command.enable is False:
            self._disable()
        elif self._may_enable:
            self._enabled = True
            self._arriving.append((now_s + self._delay_s, command.effort))

    def cycle(self, now_s: float) -> list[tuple[Identifier, bytes]]:
        """Run one firmware cycle.

        Returns
        -------
        list of (identifier, data)
            The frames that the drive sends now.
        """
        self._now_s = now_s
        frames: list[tuple[Identifier, bytes]] = []
        if self._feedback_asked or now_s >= self._feedback_timer.due_s:
            if self._feedback_asked:
                # Silence is noticed a little after the period, so that a command which is due just now can come first.
                self._feedback_timer.restart(
                    now_s + (self._settings.feedback_period_ms + self._settings.cycle_ms / 2) / 1e3
                )
                self._feedback_asked = False
            else:
                self._feedback_timer.restart_period(now_s)
            frames.append((self._profile.feedback_id, self._feedback()))
        if self._heartbeat_id is not None and now_s >= self._heartbeat_timer.due_s:
            self._heartbeat_timer.restart_period(now_s)
            frames.append((self._heartbeat_id, self._heartbeat()))
        return [frame for frame in frames if not self._is_lost()]

    def _feedback(self) -> bytes:
        self._advance()
        self.counters.samples += 1
        self._feedback_counter = (self._feedback_counter + 1) % self._profile.counter_modulus
        measured = self._plant.position + self._noise.gauss(0.0, self._settings.noise_std)
        quantum = self._settings.quantum
        if quantum:
            measured = round(measured / quantum) * quantum
        code = self._fault_code
        return self._profile.encode_feedback(
            Feedback(
                position=measured,
                counter=self._feedback_counter,
                enabled=self._enabled,
                fault=code != NO_FAULT,
                fault_code=code,
                command_timeout=code == COMMAND_TIMEOUT_FAULT,
            )
        )

    def _heartbeat(self) -> bytes:
        self._advance()
        idle = READY_TO_SWITCH_ON if self._fault_code == NO_FAULT else FAULT
        return self._profile.encode_heartbeat(
            Heartbeat(OPERATION_ENABLED if self._enabled else idle, self._boot_counter)
        )

    def _is_lost(self) -> bool:
        if self._losses.random() < self._settings.frame_loss:
            self.counters.lost += 1
            return True
        return False

    def _advance(self) -> None:
        """Bring plant and firmware to the time of the last call, from event to event."""
        while True:
            timeout_s = self._commanded_s + self._command_timeout_s if self._enabled else inf
            arrival_s = self._arriving[0][0] if self._arriving else inf
            event_s = min(timeout_s, arrival_s, self._load_due_s)
            if event_s > self._now_s:
                break
            self._advance_plant(event_s)
            if event_s == timeout_s:
                self._disable()
                self._may_enable = False
                self._fault_code = COMMAND_TIMEOUT_FAULT
                self.counters.command_timeouts += 1
            elif event_s == arrival_s:
                self._effort = self._arriving.popleft()[1]
            else:
                self._load = self._settings.load
                self._load_due_s = inf
        self._advance_plant(self._now_s)

    def _advance_plant(self, until_s: float) -> None:
        if until_s != self._plant_s:
            self._plant.advance(until_s - self._plant_s, self._effort - self._load)
            self._plant_s = until_s

    def _disable(self) -> None:
        self._enabled = False
        self._effort = 0.0
        self._arriving.clear()


class _FirmwareTimer:
    """Due at ``anchor + n * period``; what a late cycle missed is skipped."""

    __slots__ = ("_anchor_s", "_period_s", "due_s")

    def __init__(self, anchor_s: float, period_s: float) -> None:
        self._period_s = period_s
        self.restart(anchor_s)

    def restart(self, anchor_s: float) -> None:
        self._anchor_s = anchor_s
        self.due_s = anchor_s - _ROUNDING_S

    def restart_period(self, now_s: float) -> None:
        periods = floor((now_s - self._anchor_s + _ROUNDING_S) / self._period_s) + 1
        self.due_s = self._anchor_s + periods * self._period_s - _ROUNDING_S
