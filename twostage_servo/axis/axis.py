"""One axis: a drive with its law, its limits and its state, told tick by tick what happens."""

import contextlib

from twostage_servo.axis.admission import Admission
from twostage_servo.axis.arming import Arming, Obstacles
from twostage_servo.axis.count_watch import CountWatch
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.disabled_drive import DisabledDriveWatch
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.drive_watch import DriveWatch
from twostage_servo.axis.driven_step import DrivenStep
from twostage_servo.axis.duration import MoveDuration
from twostage_servo.axis.hazards import Hazards
from twostage_servo.axis.jog_timer import JogTimer
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.moves import USUAL_OVERRIDE, Move
from twostage_servo.axis.operation import Operation
from twostage_servo.axis.origin import Origin
from twostage_servo.axis.reference import Reference
from twostage_servo.axis.refusals import Obstacle
from twostage_servo.axis.requests import Requests
from twostage_servo.axis.speed_override import SpeedOverride
from twostage_servo.axis.state import CIA402, DRIVEN, ENABLED, OVERRIDABLE, State
from twostage_servo.axis.state_machine import StateMachine
from twostage_servo.axis.supervision import Supervision
from twostage_servo.axis.tick import AxisTick
from twostage_servo.axis.trip_latch import TripLatch
from twostage_servo.axis.trips import Trip, TripCode
from twostage_servo.control.estimate import Estimate  # noqa: TC001 - the class of an attribute
from twostage_servo.control.laws.law import Law, Learned, Stage


class Axis:
    """An axis, composed of parts with one job each.

    A tick is `begin_tick`, then what has come from the drive, then `step`. Between two ticks the operator asks for
    something.

    Parameters
    ----------
    design
        Gains, observer and settings.
    traits
        What is known of the drive beforehand.

    Attributes
    ----------
    design, settings
        As given.
    machine
        The state of the axis.
    drive
        What the drive reports: position, age, inputs, faults.
    disabled
        Whether a drive that is told to be disabled obeys, and whether the axis stays where it is.
    motion
        The law, the response it is designed for, and which feedback it believes.
    supervision
        What holds the motion to its limits.
    reference
        On what positions rest, and why they cannot be trusted where they cannot.
    count
        Whether the encoder goes on counting from where it was last seen.
    duration
        How long moves take.
    requests
        What the operator may ask for; each of them is an attribute of the axis as well.
    slowest_velocity
        Smallest speed that a set-point is taken with, in axis unit/s.
    begin_tick, step
        As :meth:`.AxisTick.begin` and :meth:`.AxisTick.step`.
    accept_feedback, record_heartbeat, record_foreign_command
        As in :class:`.DriveWatch`.
    raise_trip, end_braking
        As :meth:`.TripLatch.raise_trip` and :meth:`.DrivenStep.end_braking`.
    recall
        As :meth:`.LearnedPlant.recall`, while the axis is disarmed.
    estimate
        Position, velocity and disturbance of the axis as its law takes them to be now.
    nominal
        The same as the axis is designed to have them now.
    """

    def __init__(self, design: AxisDesign, traits: DriveTraits) -> None:
        settings, resolution = design.settings, traits.position_quantum
        self.design = design
        self.settings = settings
        self.duration = MoveDuration(design)
        self.machine = machine = StateMachine()
        self.drive = drive = DriveReport(settings, design.period_s, traits)
        report_period_ms = 0.0 if traits.tells_enabled else settings.limits.heartbeat_ms
        self.disabled = disabled = DisabledDriveWatch(design, resolution, report_period_ms)
        self.motion = motion = Motion(design, drive, resolution)
        self.supervision = supervision = Supervision(design, motion)
        self.reference = reference = Reference(required=settings.homing.required)
        self.count = count = CountWatch(design, resolution, drive.encoder.step)
        admission = Admission(design, drive, resolution)
        origin = Origin(drive, disabled, motion, count, reference)
        jog = JogTimer(design)
        self._override = override = SpeedOverride(design, motion, admission.slowest)
        self._operation = operation = Operation(design, machine, motion, supervision, drive, override)
        self._latch = latch = TripLatch(design, machine, operation, motion, reference)
        self._hazards = hazards = Hazards(settings, machine, drive, disabled)
        watch = DriveWatch(machine, drive, disabled, count, motion, reference, hazards, latch)
        self._obstacles = obstacles = Obstacles(machine, drive, count, reference, admission)
        arming = Arming(design, machine, drive, motion, supervision, operation, latch)
        driven = DrivenStep(design, machine, drive, motion, supervision, operation, latch, origin, reference)
        self.requests = requests = Requests(
            design, machine, drive, motion, operation, latch, hazards, admission, arming, obstacles, jog, origin,
            reference,
        )  # fmt: skip
        # What the operator may ask for, as the axis' own.
        self.arm, self.check_arming, self.disarm = requests.arm, requests.check_arming, requests.disarm
        self.move_to, self.check_move, self.move_by = requests.move_to, requests.check_move, requests.move_by
        self.jog, self.bar_jog, self.stop = requests.jog, jog.bar, requests.stop
        self.home, self.set_position, self.set_override = requests.home, requests.set_position, requests.set_override
        self.reset, self.check_reset = requests.reset, requests.check_reset
        self.forget, self.check_forget = requests.forget, requests.check_forget
        self.slowest_velocity = admission.slowest
        # What it is told, tick by tick.
        tick = AxisTick(design, machine, drive, motion, watch, arming, obstacles, jog, operation, driven, latch)
        self.begin_tick, self.step = tick.begin, tick.step
        self.accept_feedback, self.record_heartbeat = watch.accept_feedback, watch.record_heartbeat
        self.record_foreign_command = watch.record_foreign_command
        self.raise_trip, self.end_braking = latch.raise_trip, driven.end_braking
        self.recall = motion.plant.recall
        # What it tells, as long as it lives.
        self.estimate: Estimate = motion.law.observer
        self.nominal: Estimate = motion.nominal.observer

    def continue_from(self, former: "Axis") -> None:
        """Continue from a former axis on the same drive; both are disarmed, only the settings have changed.

        A lost reference stays lost, and one that was found by other rules ([axis.homing]) has to be found again, as has
        one that is required now.
        """
        self.drive.continue_from(former.drive)
        self.disabled.continue_from(former.disabled)
        self.count.continue_from(former.count)
        self.reference.continue_from(former.reference)
        is_wanted = self.settings.homing.required or self.reference.is_homed
        if is_wanted and self.settings.homing != former.settings.homing:
            self.reference.lose("[axis.homing] has changed")
        learned = former.learned
        if learned is not None and learned.moves and self.settings.law.memory != "none" and _learns_as(self, former):
            with contextlib.suppress(ValueError):  # of other limits: it begins anew
                self.recall(learned)

    @property
    def can_stop(self) -> bool:
        """Whether a stop is admitted."""
        return self.requests.can_stop

    @property
    def takes_override(self) -> bool:
        """Whether a speed override is admitted."""
        return self.machine.state in OVERRIDABLE

    # What it tells ---------------------------------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """Where the axis stands."""
        return self.machine.state

    @property
    def cia402_state(self) -> str:
        """The state in the terms of CiA 402."""
        if self.machine.state is State.DISARMED and self._obstacles.first() is not None:
            return "switch on disabled"
        return CIA402[self.machine.state]

    @property
    def move(self) -> Move | None:
        """The latest move, jog or homing, or None."""
        return self._operation.move

    @property
    def trip(self) -> Trip | None:
        """The latched trip, or None. A later one does not replace it; its reaction wins if it is more severe."""
        return self._latch.trip

    @property
    def escalation(self) -> Trip | None:
        """The later trip that did so, or None."""
        return self._latch.escalation

    @property
    def trips(self) -> dict[TripCode, Trip]:
        """Every trip since the last reset, the first of each code."""
        return self._latch.trips

    @property
    def lasting(self) -> tuple[Trip, ...]:
        """What is wrong with the drive at this moment, with its present numbers.

        All of it trips but somebody else's commands to a drive that is seen to be disabled, and a drive that has
        fallen silent before it reported that it is off.
        """
        return self._hazards.lasting(self._latch.tick)

    @property
    def hazards(self) -> tuple[Trip, ...]:
        """That of it which trips, also while disabled; no reset is possible meanwhile."""
        return self._hazards.present(self._latch.tick)

    @property
    def present_trip(self) -> Trip | None:
        """The trip that the operator has to deal with first: one that lasts, else the first one; None without any."""
        return self.requests.present_trip

    @property
    def is_disabling(self) -> bool:
        """Whether the drive has been told to disable, and still has time to report that it is off."""
        return self.machine.state not in ENABLED and self.disabled.waits

    def obstacle_to_arming(self) -> Obstacle | None:
        """Return code and text of what keeps a disarmed axis from being armed, or None."""
        return self._obstacles.first()

    @property
    def ready_to_arm(self) -> bool:
        """Whether the axis could be armed now."""
        return self.machine.state is State.DISARMED and self._obstacles.first() is None

    @property
    def following_error(self) -> float:
        """Estimated position minus the position that the axis is designed to have now, axis unit; 0 when not driven."""
        return self.motion.following_error if self.machine.state in DRIVEN else 0.0

    @property
    def law(self) -> Law:
        """The law that drives the axis."""
        return self.motion.law

    @property
    def learned(self) -> Learned | None:
        """What the law has found out of its plant; None of a law that learns nothing."""
        return self.motion.plant.learned

    @property
    def times_forgotten(self) -> int:
        """How often a trip or an operator has made the law forget that."""
        return self.motion.plant.times_forgotten

    @property
    def effort(self) -> float:
        """The effort that the law gave last, in effort unit; not what has left where the axis is not driven."""
        return self.motion.law.effort

    @property
    def set_point(self) -> float:
        """The set-point in force, in axis unit; also where an override of 0 keeps the axis from it."""
        kept = self._override.kept_target
        return self.motion.law.target if kept is None else kept

    @property
    def cruise_velocity(self) -> float:
        """Magnitude of the velocity that goes with the set-point, override included, in axis unit/s."""
        return self.motion.law.cruise_velocity

    @property
    def distance_to_go(self) -> float:
        """Distance from the estimated position to the set-point, in axis unit, never negative."""
        return abs(self.set_point - self.motion.law.observer.position)

    @property
    def override_percent(self) -> float:
        """The speed override in force, in percent of the speed that is asked for; 100 where the axis is not driven."""
        return self._override.percent if self.machine.state in DRIVEN else USUAL_OVERRIDE

    def velocity_in_force(self, velocity: float) -> float:
        """Return what the override makes of a velocity (axis unit/s) that is asked for; 0 where it holds the axis."""
        return self._override.speed(velocity, self.settings.limits.velocity)

    @property
    def speed_reference(self) -> float:
        """The velocity that the law asks for now, ramped, in axis unit/s."""
        return self.motion.law.speed_reference

    @property
    def stage(self) -> Stage:
        """The stage that made the last effort."""
        return self.motion.law.stage

    @property
    def saturated(self) -> bool:
        """Whether the effort limit cut the last effort."""
        return self.motion.law.saturated

    @property
    def changeovers(self) -> int:
        """Number of changes from the speed to the position stage so far."""
        return self.motion.law.changeovers

    @property
    def predicted_ticks(self) -> int:
        """Ticks in which the model had to stand in for a sample, so far."""
        return self.motion.predicted

    @property
    def is_finite(self) -> bool:
        """Whether effort and estimate are numbers."""
        return self.motion.finite

    @property
    def referenced(self) -> bool:
        """Whether positions can be trusted: nothing has cast doubt on them since the axis was homed, or it needs none.

        On what they rest then, :attr:`reference` says.
        """
        return self.reference.source is not None


def _learns_as(axis: Axis, former: Axis) -> bool:
    """Whether what a former axis has learned holds for another one: the same law, plant, unit and tick."""
    now, then = axis.settings, former.settings
    return (now.law.type, now.law.keys, now.plant, now.unit, now.effort_unit, axis.design.period_s) == (
        then.law.type, then.law.keys, then.plant, then.unit, then.effort_unit, former.design.period_s,
    )  # fmt: skip
