"""The machine inside an axis: its state, its trips, and what it does on each tick."""

from twostage_servo.axis.admission import Admission
from twostage_servo.axis.count_watch import CountWatch
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.disabled_drive import DisabledDriveWatch
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.drive_states import DriveState
from twostage_servo.axis.homing import Homing, HomingFailed
from twostage_servo.axis.messages import IN_TIME, NO_EFFORT, Command, DriveTraits, Feedback, Reception
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.moves import Move, MoveOutcome
from twostage_servo.axis.reference import Reference
from twostage_servo.axis.refusals import Obstacle, RefusalCode
from twostage_servo.axis.state import BRAKING, CIA402, COMMANDED, DRIVEN, ENABLED, LATCHED, Event, State, next_state
from twostage_servo.axis.supervision import Supervision
from twostage_servo.axis.trips import EVENTS, RULES, Trip, TripCode
from twostage_servo.control.estimate import Estimate
from twostage_servo.control.laws.law import Law, Stage

_DISABLED_TICKS = 2
"""Disable commands that must have left before the axis may be armed: one may have been lost."""


class Machine:
    """What an axis does by itself, tick by tick; :class:`~twostage_servo.axis.axis.Axis` adds what it is asked for.

    Parameters
    ----------
    design
        Gains, observer and settings.
    traits
        What is known of the drive beforehand.

    Attributes
    ----------
    state
        Where the axis stands; see :class:`State`.
    drive
        What the drive reports: position, age, inputs, faults.
    disabled
        Whether a drive that is told to be disabled obeys, and whether the axis stays where it is.
    motion
        The law, the response it is designed for, and which feedback it believes.
    reference
        On what positions rest, and why they cannot be trusted where they cannot.
    count
        Whether the encoder goes on counting from where it was last seen.
    trip
        The latched trip, or None. A later one does not replace it, but its reaction wins if it is more severe.
    escalation
        The later trip that did so, or None.
    trips
        Every trip since the last reset, the first of each code.
    move
        The latest move, jog or homing, or None.
    """

    def __init__(self, design: AxisDesign, traits: DriveTraits) -> None:
        self.design = design
        self.settings = design.settings
        self.state = State.DISARMED
        self.drive = DriveReport(self.settings, design.period_s, traits)
        resolution = traits.position_quantum
        report_period_ms = 0.0 if traits.tells_enabled else self.settings.limits.heartbeat_ms
        self.disabled = DisabledDriveWatch(design, resolution, report_period_ms)
        self.motion = Motion(design, self.drive, resolution)
        self.supervision = Supervision(design, self.motion)
        self._admission = Admission(design, self.drive, resolution)
        self.reference = Reference(required=self.settings.homing.required)
        self.count = CountWatch(design, resolution, self.drive.step)
        self.trip: Trip | None = None
        self.escalation: Trip | None = None
        self.trips: dict[TripCode, Trip] = {}
        self.move: Move | None = None
        self._homing: Homing | None = None
        self._heading = 0.0  # its sign is the direction of the present leg
        self._final_target: float | None = None  # after an approach from the other side
        self._tick = self._missed = 0
        self._ticks_arming = 0
        self._disabled_ticks = 0
        self._jog_ticks_left = 0
        self._jog_barred_ticks = 0  # for so long nobody must ask for a jog before one is taken again
        self._deceleration = 0.0  # of the present braking, or the latest
        self._arming_ticks = design.ticks(self.settings.arming_timeout_ms)
        self._jog_ticks = design.ticks(self.settings.jog_timeout_ms)

    @property
    def law(self) -> Law:
        """The law that drives the axis."""
        return self.motion.law

    @property
    def estimate(self) -> Estimate:
        """Position, velocity and disturbance of the axis as its law takes them to be now."""
        return self.motion.law.observer

    @property
    def nominal(self) -> Estimate:
        """Position and velocity that the axis is designed to have now."""
        return self.motion.nominal.observer

    @property
    def effort(self) -> float:
        """The effort that the law gave last, in effort unit; not what has left where the axis is not driven."""
        return self.motion.law.effort

    @property
    def set_point(self) -> float:
        """The set-point in force, in axis unit."""
        return self.motion.law.target

    @property
    def cruise_velocity(self) -> float:
        """Magnitude of the velocity that goes with the set-point, in axis unit/s."""
        return self.motion.law.cruise_velocity

    @property
    def distance_to_go(self) -> float:
        """Distance from the estimated position to the set-point, in axis unit, never negative."""
        return abs(self.motion.law.target - self.motion.law.observer.position)

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

    # What the tick does ----------------------------------------------------------------------------------------------

    def begin_tick(self, tick: int, missed: int) -> None:
        """Open a tick: its index, and how many were missed just before it."""
        self._tick, self._missed = tick, missed
        driven = self.state in DRIVEN
        if missed and driven:
            self.motion.skip(missed)
        elif missed:
            self.motion.lose_track()  # it coasts, or is pushed, and nobody has looked
        self.drive.begin_tick(missed, self.motion.expected_position(driven=driven))
        self.motion.begin_tick(missed)
        self._jog_ticks_left -= 1 + missed
        self._jog_barred_ticks = max(0, self._jog_barred_ticks - 1 - missed)
        if driven and missed > self.settings.limits.missed_ticks:
            self.raise_trip(
                TripCode.MISSED_TICKS,
                f"{missed} ticks of {1e3 * self.design.period_s:g} ms were missed in one go; "
                f"axis.limits.missed_ticks is {self.settings.limits.missed_ticks}",
            )

    def take_feedback(self, feedback: Feedback, reception: Reception = IN_TIME) -> None:
        """Take one decoded feedback frame; the newest of a tick counts."""
        if not self.drive.take(feedback, reception, driven=self.state in DRIVEN):
            self.reference.lose(
                "the axis was not seen for so long that it may have gone half of the range in which its encoder counts"
            )

    def take_over(self, former: "Machine") -> None:
        """Know what a former axis on the same drive knew of it; both are disarmed, only the settings have changed.

        A lost reference stays lost, and one that was found by other rules ([axis.homing]) has to be found again, as has
        one that is required now.
        """
        self.drive.take_over(former.drive)
        self.disabled.take_over(former.disabled)
        self.count.take_over(former.count)
        self.reference.take_over(former.reference)
        is_wanted = self.settings.homing.required or self.reference.is_homed
        if is_wanted and self.settings.homing != former.settings.homing:
            self.reference.lose("[axis.homing] has changed")

    def take_heartbeat(self, boot_counter: int | None, state: DriveState | None = None, *, late: bool = False) -> None:
        """Take a heartbeat with its count of the drive's boots; a drive that has rebooted has lost its position."""
        if self.drive.take_heartbeat(boot_counter, state, late=late):
            self.reference.lose("the drive has rebooted, and its encoder starts to count anew")
            self.count.restart()
            self.disabled.motion.begin(0.0)
            self.raise_trip(TripCode.DRIVE_REBOOTED, "the drive has rebooted while it was enabled")
        elif boot_counter is not None and not late:
            self.count.take_proof()

    def take_foreign_command(self, frame: str, *, enables: bool | None = None) -> None:
        """Take a command to this axis' drive that is not its own; two masters can't hold one axis.

        It trips an enabled axis. One that is disabled is told of it for as long as it lasts, and trips as soon as the
        drive may be enabled by it.

        Parameters
        ----------
        frame
            The frame and what it asks for, in words.
        enables
            Whether it enables the drive; None where that cannot be read from it.
        """
        self.drive.foreign.take(frame, enables=enables)
        if self.state in ENABLED:
            self.raise_trip(TripCode.FOREIGN_COMMAND, self._say_foreign())

    def step(self) -> Command:
        """Close the tick: run the law, hold the limits, and return what goes to the drive."""
        command = self._decide()
        self._watch_count()
        return command

    def _decide(self) -> Command:
        state = self.state
        was_driven = state in DRIVEN
        if state in ENABLED:
            for code, cause in self.drive.troubles(arming=state is State.ARMING):
                self.raise_trip(code, cause)
        self._watch_drive(told_enabled=state in ENABLED)
        if self.state not in DRIVEN:
            self.motion.track()
        if self.state is State.ARMING:
            self._arm_when_enabled()
        self._disabled_ticks = 0 if self.state in ENABLED else self._disabled_ticks + 1
        if self.state not in DRIVEN or not was_driven:
            return Command(0.0, enable=self.state in ENABLED)
        if self.state is State.JOGGING and self._jog_ticks_left <= 0:
            self._apply(Event.STOP)
            reason = f"the jog was not renewed within {self.settings.jog_timeout_ms:g} ms"
            self._brake(self.settings.limits.acceleration, MoveOutcome.STOPPED, reason)
        return self._drive()

    def raise_trip(self, code: TripCode, cause: str) -> None:
        """Latch a trip; a second one changes nothing but that a more severe reaction takes over.

        One that concerns a disabled drive stands beside the first in any case: it must not hide behind it.
        """
        rule = RULES[code]
        after = next_state(self.state, Event.TRIP_WHILE_DISABLED if rule.while_disabled else EVENTS[rule.reaction])
        if after is None:
            return
        trip = Trip(code, cause, self._tick)
        self.trips.setdefault(code, trip)
        doubted = rule.reckoned and not self.motion.blind
        if doubted:
            self.motion.distrust()
        elif rule.blind and not self.motion.blind:
            self.motion.go_blind()
        if rule.unreferenced:
            self.reference.lose(f"{code}: {rule.position_in_doubt}")
        if self.trip is None:
            self.trip = trip
        elif after is self.state and not rule.while_disabled:
            if doubted:  # braking goes on, but from another speed
                self._brake(self._deceleration, MoveOutcome.TRIPPED)
            return
        else:
            self.escalation = trip
        before, self.state = self.state, after
        self._end_move(MoveOutcome.TRIPPED, trip.cause)
        if self.state in BRAKING and self.state is not before:
            quick = self.state is State.TRIPPED_QUICK_STOP
            limits = self.settings.limits
            self._brake(limits.quick_stop_deceleration if quick else limits.acceleration, MoveOutcome.TRIPPED)

    def end_braking(self) -> None:
        """Give up a braking that takes too long, and disable the drive as at its end."""
        if next_state(self.state, Event.AT_REST) in {State.DISARMED, State.TRIPPED}:
            self._apply(Event.AT_REST)

    @property
    def lasting(self) -> tuple[Trip, ...]:
        """What is wrong with the drive at this moment, with its present numbers.

        All of it trips but somebody else's commands to a drive that is seen to be disabled.
        """
        lasting = self.hazards
        if self.drive.foreign.lasts and all(one.code is not TripCode.FOREIGN_COMMAND for one in lasting):
            lasting = (*lasting, Trip(TripCode.FOREIGN_COMMAND, self._say_foreign(), self._tick))
        return lasting

    @property
    def hazards(self) -> tuple[Trip, ...]:
        """That of it which trips, also while disabled; no reset is possible meanwhile."""
        lasting = []
        if self.disabled.not_disabled:
            lasting.append(Trip(TripCode.DRIVE_NOT_DISABLED, self._say_not_disabled(), self._tick))
        if contradiction := self.drive.states.contradiction:
            lasting.append(Trip(TripCode.DRIVE_STATE_MISMATCH, contradiction, self._tick))
        if self._obeys_another:
            lasting.append(Trip(TripCode.FOREIGN_COMMAND, self._say_foreign(), self._tick))
        return tuple(lasting)

    @property
    def is_disabling(self) -> bool:
        """Whether the drive has been told to disable, and still has time to report that it is off."""
        return self.state not in ENABLED and self.disabled.waits

    @property
    def present_trip(self) -> Trip | None:
        """The trip that the operator has to deal with first: one that lasts, else the first one; None without any."""
        return next(iter(self.hazards), self.trip)

    def obstacle_to_arming(self) -> Obstacle | None:
        """Return code and text of what keeps a disarmed axis from being armed, or None."""
        if self._disabled_ticks < _DISABLED_TICKS:
            return RefusalCode.STILL_ENABLED, "the drive is only just being disabled: ask again."
        if self.count.awaits_proof and not self.drive.is_stale:
            return (
                RefusalCode.HEARTBEAT_LOST,
                "no heartbeat has come since the drive was silent, to say whether it has rebooted: ask again.",
            )
        return self._admission.obstacle_to_arming(referenced=self.referenced)

    @property
    def ready_to_arm(self) -> bool:
        """Whether the axis could be armed now."""
        return self.state is State.DISARMED and self.obstacle_to_arming() is None

    @property
    def cia402_state(self) -> str:
        """The state in the terms of CiA 402."""
        if self.state is State.DISARMED and self.obstacle_to_arming() is not None:
            return "switch on disabled"
        return CIA402[self.state]

    @property
    def following_error(self) -> float:
        """Estimated position minus the position that the axis is designed to have now, axis unit; 0 when not driven."""
        return self.motion.following_error if self.state in DRIVEN else 0.0

    # Parts of the tick -----------------------------------------------------------------------------------------------

    def _watch_drive(self, *, told_enabled: bool) -> None:
        """Trip by what must not last, whether the axis is enabled or not."""
        drive = self.drive
        drive.compare_states(self._missed, told_enabled=told_enabled)
        if told_enabled:
            self.disabled.release(drive.enabled_report)
        else:
            position = drive.position if drive.fresh else None
            self.disabled.look(self._missed, drive.enabled_report, position, self.law.observer.velocity)
        for trip in self.hazards:
            if trip.code not in self.trips:
                self.raise_trip(trip.code, trip.cause)

    @property
    def _obeys_another(self) -> bool:
        """Whether somebody else commands a drive that is told to be disabled, and it may be enabled by that."""
        foreign = self.drive.foreign
        if self.state in ENABLED or not foreign.lasts:
            return False
        # One whose feedback does not tell is taken at what it has been told.
        return self.disabled.seen_enabled or (self.drive.enabled is None and foreign.enables is not False)

    def _say_foreign(self) -> str:
        return f"another node on the bus commands this drive: {self.drive.foreign}"

    def _watch_count(self) -> None:
        """Lose the reference if the encoder may not count on from where it was, and trip if the axis moves by it."""
        driven, law = self.state in DRIVEN, self.law
        speed = abs(law.observer.velocity)
        if self.state in COMMANDED:
            speed = max(speed, abs(law.cruise_velocity))
        reason = self.count.look(
            self._missed,
            self.drive.position if self.drive.fresh else None,
            speed,
            driven=self.state in ENABLED,
            homed=self.reference.is_homed,
            counts_boots=self.drive.counts_boots,
        )
        if reason is None:
            return
        if driven and self.state not in LATCHED:
            self.raise_trip(TripCode.POSITION_JUMP, reason)
        self.reference.lose(reason)

    def _say_not_disabled(self) -> str:
        watch, unit = self.disabled, self.settings.unit
        moved = "" if watch.moved is None else f"; the axis has moved by {watch.moved:+.4g} {unit} meanwhile"
        foreign = self.drive.foreign
        told_by = f"; another node on the bus has commanded it: {foreign}" if foreign.came_within(watch.told_ms) else ""
        return (
            f"the drive reports that it is enabled, for {watch.enabled_ms:g} ms of the {watch.told_ms:g} ms since it "
            f"was told to disable{moved}{told_by}; axis.arming_timeout_ms is {self.settings.arming_timeout_ms:g}"
        )

    def _arm_when_enabled(self) -> None:
        self._ticks_arming += 1
        ready = self.drive.enabled is not False and self.drive.fresh and self._ticks_arming > 1
        if ready and self.motion.knows_speed:
            self.motion.start()
            self.supervision.start()
            self.move = self._final_target = None
            moving = abs(self.law.observer.velocity) > self.design.rest_velocity
            self._apply(Event.ENABLED_MOVING if moving else Event.ENABLED)
            if moving:  # pushed by hand, or still coasting: caught, not jerked back
                self._brake(self.settings.limits.acceleration, MoveOutcome.STOPPED)
        elif self._ticks_arming > self._arming_ticks:
            if self.drive.enabled is False:
                missing = "the drive has not reported that it is enabled"
            else:
                missing = "two fresh samples in a row, without a missed tick between, have not come to tell the speed"
            self.raise_trip(
                TripCode.DRIVE_NOT_ENABLED, f"{missing} within {self.settings.arming_timeout_ms:g} ms of arming"
            )

    def _drive(self) -> Command:
        law = self.law
        changeovers, implausible = law.changeovers, self.motion.implausible
        effort = self.motion.step()
        if self.motion.implausible > implausible:
            self.drive.monitor.doubt()
        if not self.motion.finite:
            self.raise_trip(TripCode.NOT_FINITE, f"the law gives effort {effort} at position {law.observer.position:g}")
            self.motion.lose_track()
            return NO_EFFORT
        if law.changeovers != changeovers:
            self._after_changeover()
        if self.motion.moves_after_all:
            self.end_braking()
        for code, cause in self.supervision.violations(self.state, referenced=self.referenced):
            self.raise_trip(code, cause)
        self._check_switch_ahead()
        if self.state is State.HOMING:
            self._home()
        elif self.state in {State.POSITION_STAGE, State.JOGGING}:
            self._check_window()
        return Command(effort, enable=True) if self.state in DRIVEN else NO_EFFORT

    def _after_changeover(self) -> None:
        # The response is judged stage by stage: what the speed stage gained or lost does not count in the next.
        self.motion.nominal.continue_from(self.law)
        if self.state in BRAKING:
            self.supervision.forget_move()
            self._apply(Event.AT_REST)
        elif self.state is not State.HOLDING:
            self._apply(Event.CHANGEOVER)

    def _check_switch_ahead(self) -> None:
        velocity = self.law.observer.velocity
        moves = abs(velocity) > self.design.rest_velocity
        switch = self.drive.blocks(velocity) if moves else None
        if self.state in COMMANDED:  # also one so slow that its speed is none
            heading = self._heading if self._homing is None else self._homing.direction
            switch = switch or self.drive.blocks(heading)
        if switch:
            self.raise_trip(
                TripCode.LIMIT_SWITCH,
                f"the {switch} limit switch is active at {self.law.observer.position:.6g} {self.settings.unit}, and "
                f"the axis moves towards it, at {velocity:.4g} {self.settings.unit}/s",
            )

    def _check_window(self) -> None:
        position = self.drive.position if self.drive.fresh else None
        if position is None or self.law.stage is not Stage.POSITION or not self.supervision.has_arrived(position):
            return
        if self._final_target is not None and self.move is not None:
            target, self._final_target = self._final_target, None
            self.supervision.begin_move()  # it has come to rest here
            self._begin_leg(target, self.move.velocity)
            return
        self.supervision.forget_move()
        self._end_move(MoveOutcome.REACHED)
        self._apply(Event.REACHED)

    def _home(self) -> None:
        assert self._homing is not None  # noqa: S101 - the state and the search begin and end together
        try:
            self._homing.step()
        except HomingFailed as failure:
            self.raise_trip(TripCode.HOMING_FAILED, str(failure))
            return
        if self._homing.done and self._homing.reference is not None:
            self._reference_at(self._homing.reference, self.settings.homing.position)
            self._end_move(MoveOutcome.REACHED)
            self._apply(Event.REACHED)

    # Small parts -----------------------------------------------------------------------------------------------------

    def _apply(self, event: Event) -> None:
        state = next_state(self.state, event)
        if state is None:
            raise RuntimeError(f"event {event} is not admitted in state {self.state}")
        self.state = state

    def _brake(self, deceleration: float, outcome: MoveOutcome, reason: str | None = None) -> None:
        self._end_move(outcome, reason)
        self._deceleration = deceleration
        self.motion.stop(deceleration)
        self.supervision.begin_braking(deceleration)

    def _set_target(self, target: float, velocity: float) -> None:
        self._heading = target - self.law.observer.position
        self.motion.set_target(target, velocity)
        if self.state in COMMANDED:
            self.supervision.change_move()
        else:
            self.supervision.begin_move()

    def _begin_leg(self, target: float, velocity: float) -> None:
        """Set out for a set-point, by whichever stage the law begins with."""
        self._set_target(target, velocity)
        self._apply(Event.MOVE_SPEED if self.law.stage is Stage.SPEED else Event.MOVE_POSITION)

    def _reference_at(self, found: float, position: float) -> None:
        """Count positions so that the place `found` (axis unit, by the former origin) is `position`."""
        self.drive.shift(position - found)
        self.disabled.motion.shift(position - found)
        self.motion.shift(position - found)
        self.count.shift(position - found)
        self.reference.find()

    def _end_move(self, outcome: MoveOutcome, reason: str | None = None) -> None:
        self._final_target = None
        if self._homing is not None:
            self._homing.end()
            self._homing = None
        if self.move is not None and self.move.outcome is MoveOutcome.MOVING:
            self.move.outcome = outcome
            self.move.reason = reason
