"""An axis and its drive, without a bus: random configurations, requests, faults and loads by seed, tick by tick."""

from typing import TYPE_CHECKING

from tools.soak.configurations import drawn_by
from tools.soak.drive_model import DriveModel
from tools.soak.drive_watch import DriveWatch
from tools.soak.encoder_watch import ENCODER_FACTORS, EncoderWatch
from tools.soak.invariants import BrokenInvariantError, Invariants
from tools.soak.operator_model import OperatorModel
from twostage_servo.app.assembly import build_axis, build_drive
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.state import DRIVEN, ENABLED, State
from twostage_servo.axis.trips import TripCode

if TYPE_CHECKING:
    from twostage_servo.axis.axis import Axis

_PLANT_LIFE_TICKS = 200_000
"""How long a plant keeps its parameters."""

_HEARTBEAT_MS = 100.0
_OPERATED = 0.7
"""Share of events that an operator causes; the others are mishaps."""
_CHANGE_OF_PACE = 0.03
"""Share of events at which the operation becomes busier or calmer."""
_MOST_ENCODER_EVENTS = 30
"""Events after which the operator mends an encoder that nobody has noticed, as one is that fails at standstill."""

_ESTIMATED_AFTER_MS = 500.0
"""Time after which the estimate has followed a load that has changed."""


class AxisSoak:
    """One axis in random operation.

    Parameters
    ----------
    seed
        Of everything.
    without
        Kinds of faults that are left out: ``encoder``, ``drive``.
    """

    def __init__(self, seed: int, without: frozenset[str] = frozenset()) -> None:
        self.configuration, self.random = drawn_by(seed)
        self.configuration.check()
        random = self.random
        loaded = self.configuration.load()
        traits = build_drive(loaded).traits
        self.tick_s = self.configuration.tick_s
        self.axis: Axis = build_axis(loaded, traits, self.tick_s)
        quantum = traits.position_quantum
        homing = self.axis.settings.homing
        self.drive = DriveModel(
            self.axis.design,
            quantum,
            random.choice((0.0, 5.0 * quantum)),
            homing.position if homing.method == "switch" else None,
            random,
        )
        self.invariants = Invariants(self.axis)
        self.watch = EncoderWatch(self.axis)
        self.drive_watch = DriveWatch(self.axis, self.drive)
        self.operator = OperatorModel(self.axis, self.drive, self.watch, self.drive_watch, random)
        self.trips = self.encoder_faults = 0
        self._tick = 0
        self._pace_ticks = 100.0
        self._heartbeat_ticks = self.axis.design.ticks(_HEARTBEAT_MS)
        self._encoder_events = 0
        self._load_is_known_at = 0
        self._plant_ends = _PLANT_LIFE_TICKS
        self._reported_trip: object = None
        self._was_homing = False
        self._boots_told = self.drive.boots
        self._mishaps = (
            *[self._fall_silent] * 6, *[self._load_the_axis] * 6, *[self._spike] * 4, *[self._suspend_host] * 3,
            *[self._fault] * 2, *[self._emergency_stop] * 2, self._reboot_or_hang, self._trip, self._knock,
            self._foreign_command, self._limit_switch,
            *([] if "encoder" in without else [self._encoder_fails] * 8),
            *([] if "drive" in without else [self._stay_enabled, self._creep] * 2),
        )  # fmt: skip

    def run(self, ticks: int) -> None:
        """Run so many ticks more."""
        end = self._tick + ticks
        random = self.random
        while self._tick < end:
            if random.random() < _CHANGE_OF_PACE:
                self._pace_ticks = random.choice((10.0, 50.0, 200.0, 500.0))
            quiet = min(end - self._tick, 1 + int(random.expovariate(1.0 / self._pace_ticks)))
            for _ in range(quiet):
                self._one_tick(0)
            self._something_happens()

    def _one_tick(self, missed: int) -> None:
        axis, drive = self.axis, self.drive
        self._tick += 1 + missed
        tick = self._tick
        axis.begin_tick(tick, missed)
        feedback = drive.feedback(tick)
        if feedback is not None:
            axis.accept_feedback(feedback)
        if tick % self._heartbeat_ticks == 0 and tick >= drive.heartbeat_silent_until:
            if drive.boots != self._boots_told:
                self._boots_told = drive.boots
                self.drive_watch.rebooted()
            axis.record_heartbeat(drive.boots)
        command = axis.step()
        drive.obey(command, tick)
        self.invariants.check(
            command, drive.position, place_known=not (self.watch.in_doubt or self.drive_watch.disobeyed)
        )
        wrong = self.watch.check(drive.position, drive.velocity, command.effort)
        wrong = wrong or self.drive_watch.check(reported=axis.drive.enabled_report is not None)
        if wrong is not None:
            raise BrokenInvariantError(wrong)
        if axis.trip is not self._reported_trip:
            self._reported_trip = axis.trip
            self.trips += axis.trip is not None
        is_homing = axis.state is State.HOMING
        if self._was_homing and not is_homing and axis.move is not None and axis.move.outcome is MoveOutcome.REACHED:
            self.watch.placed(drive.velocity)
        self._was_homing = is_homing

    def _something_happens(self) -> None:
        if self.watch.active:
            # One fault at a time: beside this one there is the operator alone.
            self._encoder_events += 1
            if self._encoder_events > _MOST_ENCODER_EVENTS:
                self._end_encoder_fault()
            else:
                self.operator.act()
        elif self.drive_watch.disobeyed or self._tick < self.drive.stuck_until or self.random.random() < _OPERATED:
            self.operator.act()
        else:
            self.random.choice(self._mishaps)()
        if self._tick > self._plant_ends and not self.watch.active:
            self.drive.change_plant()
            self._plant_ends = self._tick + _PLANT_LIFE_TICKS

    # Mishaps ---------------------------------------------------------------------------------------------------------

    def _fall_silent(self) -> None:
        self.drive.silent_until = self._tick + self.random.choice((1, 1, 2, 2, 3, 8, 60))

    def _load_the_axis(self) -> None:
        random, effort = self.random, self.axis.settings.limits.effort
        self._change_load(random.choice((0.0, random.uniform(-0.125, 0.125), random.uniform(-0.5, 0.5))) * effort)

    def _change_load(self, load: float) -> None:
        self.drive.load = load
        self._load_is_known_at = self._tick + self.axis.design.ticks(_ESTIMATED_AFTER_MS)

    def _spike(self) -> None:
        self.drive.spike_at = self._tick + 1 + self.random.randrange(3)
        height = 5.0 * self.axis.settings.limits.position_overrun
        self.drive.spike = self.random.uniform(-height, height)

    def _suspend_host(self) -> None:
        missed = self.random.choice((1, 1, 2, 3, 10))
        for _ in range(missed):
            self.drive.miss()
        self._one_tick(missed)

    def _fault(self) -> None:
        self.drive.fault_until = self._tick + self.random.randrange(1, 200)

    def _emergency_stop(self) -> None:
        self.drive.sto_until = self._tick + self.random.randrange(1, 200)

    def _reboot_or_hang(self) -> None:
        drive = self.drive
        drive.boots = (drive.boots + self.random.randrange(2)) % 256
        drive.heartbeat_silent_until = self._tick + self.random.randrange(1, 100)

    def _trip(self) -> None:
        self.axis.raise_trip(self.random.choice(list(TripCode)), "soaked")

    def _knock(self) -> None:
        knock = 0.08 * self.axis.settings.limits.velocity
        self.drive.velocity += self.random.uniform(-knock, knock)

    def _foreign_command(self) -> None:
        self.axis.record_foreign_command("soaked")

    def _limit_switch(self) -> None:
        self.drive.limit_switch = 0.0 if self.drive.limit_switch else self.random.choice((-1.0, 1.0))

    # A drive that does not obey --------------------------------------------------------------------------------------

    def _stay_enabled(self) -> None:
        """Let the power stage, once it is on, stay on for a time, with the effort that it had."""
        patience = self.axis.design.ticks(self.axis.settings.arming_timeout_ms)
        self.drive.stuck_until = self._tick + self.random.randrange(1, 6 * patience)

    def _creep(self) -> None:
        """Let the drive of an axis that is disarmed and at rest move it, and say that it is disabled."""
        limits = self.axis.settings.limits
        if self.axis.state not in ENABLED and abs(self.drive.velocity) <= self.axis.design.rest_velocity:
            self.drive.creeping = self.random.choice((-1.0, 1.0)) * self.random.uniform(0.02, 0.5) * limits.effort
            self.drive.creeping_until = self._tick + self.random.randrange(1, 500)

    # The encoder -----------------------------------------------------------------------------------------------------

    def _encoder_fails(self) -> None:
        """Let the encoder count wrongly from here on, in whatever state the axis is driven."""
        drive = self.drive
        if drive.load:  # one fault at a time: an estimate with a load that has just gone is wrong by itself
            self._change_load(0.0)
            return
        disobeys_until = max(drive.stuck_until, drive.creeping_until)
        busy = max(drive.silent_until, drive.fault_until, drive.sto_until, drive.spike_at, disobeys_until) >= self._tick
        busy = busy or self._load_is_known_at > self._tick
        if self.axis.state not in DRIVEN or busy or self.watch.in_doubt:
            return
        factor = self.random.choice(list(ENCODER_FACTORS.values()))
        self.encoder_faults += 1
        self._encoder_events = 0
        drive.encoder.fail(factor, drive.position)
        self.watch.begin(factor, drive.position, drive.velocity, drive.gain, drive.pole)

    def _end_encoder_fault(self) -> None:
        """Disarm, mend the encoder, and say where the axis is; tried again with the next event until it is disarmed."""
        if self.axis.state in ENABLED:
            self.axis.disarm()
        else:
            self.operator.mend_encoder()

    @property
    def ticks(self) -> int:
        """Ticks so far that were not missed."""
        return self.invariants.ticks

    @property
    def closest(self) -> float:
        """Largest travel with a wrong encoder so far, as a share of its bound."""
        return self.watch.closest

    @property
    def farthest(self) -> float:
        """Largest distance beyond a position limit so far, as a share of what is allowed."""
        return self.invariants.farthest

    @property
    def requests(self) -> int:
        """Requests so far."""
        return self.operator.requests

    @property
    def refusals(self) -> int:
        """Those of them that were refused."""
        return self.operator.refusals

    @property
    def moves_reached(self) -> int:
        """Moves that were reached so far."""
        return self.operator.moves_reached
