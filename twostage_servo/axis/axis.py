"""One axis: requests and feedback in, an effort and an enable bit out, once a tick."""

import itertools
import math

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.messages import NO_EFFORT, Command, Move, Refused
from twostage_servo.axis.state import DRIVEN, ENABLED, Event, State, next_state
from twostage_servo.axis.supervision import Supervision
from twostage_servo.axis.trips import Reaction, Trip, TripCode
from twostage_servo.control.two_stage import Stage

_DISABLED_TICKS = 2
"""Disable commands that must have left before the axis may be armed: one may have been lost."""


class Axis:
    """The axis' state machine around its law.

    Parameters
    ----------
    design
        Gains, observer and settings.
    counter_modulus
        Number of values of the feedback's alive counter.

    Attributes
    ----------
    state
        Where the axis stands; see :class:`State`.
    law
        The law that drives it, with its observer.
    drive
        What the drive reports: position, age, faults.
    trip
        The latched trip, or None.
    move
        The latest move, or None.
    nominal
        The same law on a free-running model of the plant: the response that the axis is designed to give.
    """

    def __init__(self, design: AxisDesign, counter_modulus: int) -> None:
        self.design = design
        self.settings = design.settings
        self.state = State.DISARMED
        self.law = design.build_law()
        self.nominal = design.build_nominal_law()
        self.supervision = Supervision(design, self.law, self.nominal)
        self.drive = DriveReport(self.settings, design.period_s, counter_modulus)
        self.trip: Trip | None = None
        self.move: Move | None = None
        self._tick = 0
        self._ticks_arming = 0
        self._disabled_ticks = 0
        self._tracking = False
        self._sent_effort = 0.0
        self._move_numbers = itertools.count(1)
        self._arming_ticks = math.ceil(self.settings.arming_timeout_ms / (1e3 * design.period_s))

    # What the operator asks for --------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Enable the drive; the axis then holds the position at which it is.

        Raises
        ------
        Refused
            If the axis is not disarmed, there is no fresh feedback, the drive reports a fault, or the axis stands
            outside its position limits.
        """
        if self.state is not State.DISARMED:
            if self.trip is not None:
                raise Refused(
                    "tripped", f"the axis has tripped ({self.trip.code}): {self.trip.cause.rstrip('.')}. `reset` first."
                )
            raise Refused("already_armed", f"the axis is armed already ({self.state}).")
        if obstacle := self.drive.obstacle_to_arming():
            raise Refused(*obstacle)
        if self._disabled_ticks < _DISABLED_TICKS:
            raise Refused("still_enabled", "the drive is only just being disabled: ask again.")
        limits = self.settings.limits
        position = self.drive.position
        if position is not None and not self.supervision.is_inside(position, limits.position_overrun):
            raise Refused(
                "position_limit",
                f"the axis stands at {position:.6g} {self.settings.unit}, more than "
                f"{limits.position_overrun:g} {self.settings.unit} outside its limits {limits.position_minimum:g} to "
                f"{limits.position_maximum:g}: move it back by hand first.",
            )
        self._ticks_arming = 0
        self._apply(Event.ARM)

    def disarm(self) -> None:
        """Bring a moving axis to rest, then disable the drive; an axis at rest is disabled at once."""
        if next_state(self.state, Event.DISARM) is None:  # tripped: disabled already, or about to be
            return
        self._apply(Event.DISARM)
        if self.state is State.DISARMING:
            self._end_move("stopped")
            self.law.stop(self.settings.limits.acceleration)
            self.nominal.stop(self.settings.limits.acceleration)

    def move_to(self, target: float, velocity: float) -> Move:
        """Take a set-point in axis unit and its cruise velocity in axis unit/s; the effort stays continuous.

        Raises
        ------
        Refused
            If the axis is not armed, is stopping, or a number is not finite or outside the limits.
        """
        limits = self.settings.limits
        unit = self.settings.unit
        if not (math.isfinite(velocity) and 0.0 < velocity <= limits.velocity):
            raise Refused(
                "velocity_limit",
                f"velocity {velocity:g} {unit}/s: it must be greater than 0 and at most {limits.velocity:g} {unit}/s.",
            )
        if not (math.isfinite(target) and self.supervision.is_inside(target, 0.0)):
            raise Refused(
                "position_limit",
                f"set-point {target:g} {unit}: it must lie from {limits.position_minimum:g} to "
                f"{limits.position_maximum:g} {unit}.",
            )
        if next_state(self.state, Event.MOVE_SPEED) is None:
            raise Refused(*self._why_not_movable())
        self._end_move("replaced")
        self.law.set_target(target, velocity)
        self.nominal.set_target(target, velocity)
        self.move = Move(next(self._move_numbers), target, velocity, start=self.law.observer.position)
        self.supervision.begin_move()
        self._apply(Event.MOVE_SPEED if self.law.stage is Stage.SPEED else Event.MOVE_POSITION)
        return self.move

    def move_by(self, distance: float, velocity: float) -> Move:
        """Move relative to the set-point now in force, so that steps add up exactly; else as :meth:`move_to`."""
        if next_state(self.state, Event.MOVE_SPEED) is None:
            raise Refused(*self._why_not_movable())
        return self.move_to(self.law.target + distance, velocity)

    def stop(self) -> None:
        """Brake with the acceleration limit and hold where the axis comes to rest.

        Raises
        ------
        Refused
            If the axis is not armed.
        """
        if next_state(self.state, Event.STOP) is None:
            raise Refused(*self._why_not_movable())
        self._apply(Event.STOP)
        if self.state is State.STOPPING:
            self._end_move("stopped")
            self.law.stop(self.settings.limits.acceleration)
            self.nominal.stop(self.settings.limits.acceleration)

    def reset(self) -> None:
        """Clear a trip; the axis is disarmed afterwards and needs `arm` and a fresh set-point.

        Raises
        ------
        Refused
            If the axis is armed, or still braking after the trip.
        """
        if self.state is State.QUICK_STOP:
            raise Refused("busy", "the axis is still braking after its trip: `reset` when it is at rest.")
        if next_state(self.state, Event.RESET) is None:
            raise Refused("not_tripped", f"the axis is {self.state}: there is nothing to reset.")
        self._apply(Event.RESET)
        self.trip = None

    # What the tick does ----------------------------------------------------------------------------------------------

    def begin_tick(self, tick: int, missed: int) -> None:
        """Open a tick: its index, and how many were missed just before it."""
        self._tick = tick
        self.drive.begin_tick(missed)
        if self.state in DRIVEN and missed:
            self.law.skip(missed)
            self.nominal.skip(missed)
            if missed > self.settings.limits.missed_ticks:
                self.raise_trip(
                    TripCode.MISSED_TICKS,
                    f"{missed} ticks of {1e3 * self.design.period_s:g} ms were missed in one go; "
                    f"axis.limits.missed_ticks is {self.settings.limits.missed_ticks}",
                )

    def take_feedback(self, position: float, counter: int | None, enabled: bool | None, fault_code: int | None) -> None:
        """Take one decoded feedback frame; the newest of a tick counts.

        Parameters
        ----------
        position
            Measured position in axis unit.
        counter
            Alive counter, or None.
        enabled
            Whether the drive says it is enabled; None where it does not tell.
        fault_code
            The drive's fault code if it reports a fault, else None.
        """
        if not self.drive.monitor.accept(counter):
            return
        if math.isfinite(position):
            self.drive.take(position, enabled, fault_code)
        else:
            self.raise_trip(TripCode.NOT_FINITE, f"the drive's feedback gives the position {position}")

    def notice_foreign_command(self, frame: str) -> None:
        """Take notice of a command to this axis' drive that is not its own; two masters can't hold one axis."""
        self.drive.notice_foreign_command()
        self.raise_trip(TripCode.FOREIGN_COMMAND, f"another node on the bus commands this drive: {frame}")

    def step(self) -> Command:
        """Close the tick: run the law, hold the limits, and return what goes to the drive."""
        command = self._decide()
        self._sent_effort = command.effort
        return command

    def _decide(self) -> Command:
        state = self.state
        was_driven = state in DRIVEN
        if state in ENABLED and (trouble := self.drive.trouble(arming=state is State.ARMING)):
            self.raise_trip(*trouble)
        if self.state not in DRIVEN:
            self._track()
        if self.state is State.ARMING:
            self._arm_when_enabled()
        self._disabled_ticks = 0 if self.state in ENABLED else self._disabled_ticks + 1
        if self.state not in DRIVEN or not was_driven:
            return Command(0.0, enable=self.state in ENABLED)
        law = self.law
        changeovers = law.changeovers
        sample = self.drive.position if self.drive.fresh else None
        if sample is None:
            sample = law.observer.position
        effort = law.step(sample)
        self.nominal.step(self.nominal.observer.position)
        if not (math.isfinite(effort) and math.isfinite(law.observer.velocity)):
            self.raise_trip(TripCode.NOT_FINITE, f"the law gives effort {effort} at position {sample:g}")
            self._tracking = False
            return NO_EFFORT
        if law.changeovers != changeovers:
            self._after_changeover()
        self._check_limits()
        if self.state is State.POSITION_STAGE:
            self._check_window()
        return Command(effort, enable=True) if self.state in DRIVEN else NO_EFFORT

    def raise_trip(self, code: TripCode, cause: str) -> None:
        """Latch a trip; a second one changes nothing but that a more severe reaction takes over."""
        trip = Trip(code, cause, self._tick)
        disable = trip.reaction is Reaction.DISABLE or self.state is State.QUICK_STOP
        if next_state(self.state, Event.TRIP_DISABLE if disable else Event.TRIP_QUICK_STOP) is None:
            return
        self._apply(Event.TRIP_DISABLE if disable else Event.TRIP_QUICK_STOP)
        if self.trip is None:
            self.trip = trip
        self._end_move("tripped")
        if self.state is State.QUICK_STOP:
            self.supervision.start()
            self.law.stop(self.settings.limits.quick_stop_deceleration)
            self.nominal.continue_from(self.law)

    def end_braking(self) -> None:
        """Give up a braking that takes too long, and disable the drive as at its end."""
        if self.state in {State.DISARMING, State.QUICK_STOP}:
            self._apply(Event.AT_REST)

    @property
    def ready_to_arm(self) -> bool:
        """Whether there is fresh feedback, and the drive has had time to be disabled."""
        return not self.drive.is_stale and self._disabled_ticks >= _DISABLED_TICKS

    @property
    def following_error(self) -> float:
        """Estimated position minus the position that the axis is designed to have now, axis unit; 0 when not driven."""
        return self.supervision.following_error if self.state in DRIVEN else 0.0

    # Checks ----------------------------------------------------------------------------------------------------------

    def _arm_when_enabled(self) -> None:
        self._ticks_arming += 1
        if self.drive.enabled is not False and self.drive.fresh and self._ticks_arming > 1:
            self.law.start()
            moving = abs(self.law.observer.velocity) > self.design.rest_velocity
            if moving:  # pushed by hand, or still coasting: caught, not jerked back
                self.law.stop(self.settings.limits.acceleration)
            self.nominal.continue_from(self.law)
            self.supervision.start()
            self.move = None
            self._apply(Event.ENABLED_MOVING if moving else Event.ENABLED)
        elif self._ticks_arming > self._arming_ticks:
            self.raise_trip(
                TripCode.DRIVE_NOT_ENABLED,
                f"the drive has not reported that it is enabled within {self.settings.arming_timeout_ms:g} ms",
            )

    def _track(self) -> None:
        """Let the observer follow the axis while no effort acts, so that arming starts from its position and speed."""
        observer = self.law.observer
        position = self.drive.position if self.drive.fresh else None
        if self.drive.is_stale:
            self._tracking = False
        elif position is None:
            observer.predict(self._sent_effort)
        elif self._tracking:
            observer.update(position, self._sent_effort)
        else:
            observer.reset(position)
            self._tracking = True

    def _after_changeover(self) -> None:
        # The response is judged stage by stage: what the speed stage gained or lost does not count in the next.
        self.nominal.continue_from(self.law)
        if self.state in {State.STOPPING, State.DISARMING, State.QUICK_STOP}:
            self.supervision.forget_move()
            self._apply(Event.AT_REST)
        else:
            self._apply(Event.CHANGEOVER)

    def _check_limits(self) -> None:
        for code, cause in self.supervision.violations():
            # Beyond the position limits there is nothing better to do than to go on with the quick stop.
            if not (code is TripCode.POSITION_LIMIT and self.state is State.QUICK_STOP):
                self.raise_trip(code, cause)

    def _check_window(self) -> None:
        position = self.drive.position if self.drive.fresh else None
        if position is not None and self.supervision.has_arrived(position):
            self.supervision.forget_move()
            self._end_move("reached")
            self._apply(Event.REACHED)

    # Small parts -----------------------------------------------------------------------------------------------------

    def _apply(self, event: Event) -> None:
        state = next_state(self.state, event)
        if state is None:
            raise RuntimeError(f"event {event} is not admitted in state {self.state}")
        self.state = state

    def _end_move(self, outcome: str) -> None:
        if self.move is not None and self.move.outcome == "moving":
            self.move.outcome = outcome

    def _why_not_movable(self) -> tuple[str, str]:
        if self.trip is not None:
            return (
                "tripped",
                f"the axis has tripped ({self.trip.code}): {self.trip.cause.rstrip('.')}. {self.trip.next_action}",
            )
        if self.state is State.DISARMED:
            return "disarmed", "the axis is disarmed: `arm` it first."
        return "busy", f"the axis is {self.state}: wait until it holds."
