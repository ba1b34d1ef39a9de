"""What an operator may ask of an axis: each request is carried out, or refused with a code and a reason."""

import math

from twostage_servo.axis.admission import Admission, tripped_text
from twostage_servo.axis.arming import Arming, Obstacles
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.hazards import Hazards
from twostage_servo.axis.homing import Homing
from twostage_servo.axis.jog_timer import JogTimer
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.moves import Move, MoveKind, MoveOutcome
from twostage_servo.axis.operation import Operation
from twostage_servo.axis.origin import Origin
from twostage_servo.axis.reference import Reference
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import BRAKING, COMMANDED, LATCHED, Event, State
from twostage_servo.axis.state_machine import StateMachine
from twostage_servo.axis.trip_latch import TripLatch
from twostage_servo.axis.trips import Trip

_FAR_S = 3600.0
"""How far ahead, in time, the set-point of a jog lies on an axis that does not know its position."""


class Requests:
    """Carries out what the operator asks for.

    Parameters
    ----------
    design
        The axis.
    machine, drive, motion, operation, latch, hazards
        Its state, what its drive reports, what moves it, what it is about, its trips, and what is wrong with the drive.
    admission, arming, obstacles, jog
        The checks before every request, the way to an armed axis and what is in it, and how long a jog goes on.
    origin, reference
        From where positions count, and on what they rest.
    """

    def __init__(
        self,
        design: AxisDesign,
        machine: StateMachine,
        drive: DriveReport,
        motion: Motion,
        operation: Operation,
        latch: TripLatch,
        hazards: Hazards,
        admission: Admission,
        arming: Arming,
        obstacles: Obstacles,
        jog: JogTimer,
        origin: Origin,
        reference: Reference,
    ) -> None:
        self._settings = design.settings
        self._rest_velocity = design.rest_velocity
        self._machine = machine
        self._drive = drive
        self._motion = motion
        self._operation = operation
        self._latch = latch
        self._hazards = hazards
        self._admission = admission
        self._arming = arming
        self._obstacles = obstacles
        self._jog = jog
        self._origin = origin
        self._reference = reference

    @property
    def present_trip(self) -> Trip | None:
        """The trip that the operator has to deal with first: one that lasts, else the first one; None without any."""
        return next(iter(self._hazards.present(self._latch.tick)), self._latch.trip)

    @property
    def _referenced(self) -> bool:
        return self._reference.source is not None

    def arm(self) -> None:
        """Enable the drive; the axis then holds the position at which it is.

        Raises
        ------
        Refused
            As in :meth:`check_arming`.
        """
        self.check_arming()
        self._arming.begin()

    def check_arming(self) -> None:
        """Tell whether the axis could be armed.

        Raises
        ------
        Refused
            If the axis is not disarmed, there is no fresh feedback, the drive reports a fault, or the axis stands
            outside its position limits.
        """
        if (trip := self.present_trip) is not None:
            raise Refused(RefusalCode.TRIPPED, f"{tripped_text(trip)} `reset` first.")
        if self._machine.state is State.DISARMING:
            raise Refused(RefusalCode.BUSY, "the axis brakes to be disarmed: `arm` it once it is.")
        if self._machine.state is not State.DISARMED:
            raise Refused(RefusalCode.ALREADY_ARMED, f"the axis is armed already ({self._machine.state}).")
        if obstacle := self._obstacles.first():
            raise Refused(*obstacle)

    def disarm(self, reason: str | None = None) -> None:
        """Bring a moving axis to rest, then disable the drive; an axis at rest is disabled at once.

        Never refused: one that is disabled, or is about to be after a trip, goes on as it was.

        Parameters
        ----------
        reason
            What the end of a move is explained by, where it is not the operator who has asked for it.
        """
        before = self._machine.state
        self._machine.apply(Event.DISARM)
        if (
            self._machine.state is State.DISARMING and before is not State.DISARMING
        ):  # asked again, it goes on as it was
            self._brake(reason, quick=before is State.QUICK_STOPPING)  # which is not made milder

    def move_to(self, target: float, velocity: float) -> Move:
        """Begin a move to a set-point in axis unit, at a cruise velocity in axis unit/s; the effort stays continuous.

        Raises
        ------
        Refused
            As in :meth:`check_move`.
        """
        self.check_move(target, velocity)
        self._operation.end_move(MoveOutcome.REPLACED)
        first = self._first_target(target)
        self._operation.begin_leg(first, velocity, final_target=target if first != target else None)
        return self._operation.announce(MoveKind.MOVE, target, velocity)

    def check_move(self, target: float, velocity: float) -> None:
        """Tell whether a set-point could be taken.

        Raises
        ------
        Refused
            If the axis is not armed, is stopping, is not homed, a limit switch is in the way, or a number is not finite
            or outside the limits.
        """
        check = self._admission
        check.check_velocity(velocity, self._settings.limits.velocity)
        check.check_state(self._machine.state, Event.MOVE_SPEED, self.present_trip)
        check.check_target(target, referenced=self._referenced, lost_because=self._reference.lost_because)
        check.check_switches(target - self._motion.law.observer.position)

    def move_by(self, distance: float, velocity: float) -> Move:
        """Move relative to the set-point now in force, so that steps add up exactly; else as :meth:`move_to`."""
        self._admission.check_state(self._machine.state, Event.MOVE_SPEED, self.present_trip)
        return self.move_to(self._operation.set_point + distance, velocity)

    def jog(self, velocity: float) -> None:
        """Move at a velocity in axis unit/s (its sign counts) until the jog time-out, unless asked again before.

        An axis that knows its position comes to rest at its position limit.

        Raises
        ------
        Refused
            If the axis neither holds nor jogs, the velocity is not finite or too large, or the way is blocked; or if
            somebody else has stopped it, until a jog was not asked for during its time-out.
        """
        limits, check = self._settings.limits, self._admission
        if self._jog.is_barred:
            self._jog.bar()
            raise Refused(
                RefusalCode.STOPPED,
                "this axis was stopped by another client: release the jog for "
                f"{self._settings.jog_timeout_ms:g} ms, check the axis, and jog again.",
            )
        largest = limits.velocity if self._referenced else self._settings.homing.velocity
        check.check_velocity(abs(velocity), largest)
        check.check_state(self._machine.state, Event.JOG, self.present_trip)
        check.check_switches(velocity)
        self._jog.renew()
        move = self._operation.move
        if self._machine.state is State.JOGGING and move is not None and move.velocity == velocity:
            return
        position = self._motion.law.observer.position
        target = position + _FAR_S * velocity
        if self._referenced:
            target = limits.position_maximum if velocity > 0.0 else limits.position_minimum
            if math.copysign(1.0, velocity) * (target - position) <= self._settings.window.position:
                raise Refused(
                    RefusalCode.POSITION_LIMIT, f"the axis stands at its limit of {target:g} {self._settings.unit}."
                )
        self._operation.end_move(MoveOutcome.REPLACED)
        self._operation.set_target(target, abs(velocity), largest)
        self._machine.apply(Event.JOG)
        self._operation.announce(MoveKind.JOG, target, velocity)

    def set_override(self, percent: float) -> None:
        """Let the axis move at a percentage of the speed that is asked for, from 0 to 200, until it is armed again.

        It applies at once to a move or a jog, and to those to come; not to homing, nor to a stop. The speed never goes
        beyond the velocity limit. 0 brings the axis to rest with the acceleration limit, and keeps its set-point.

        Raises
        ------
        Refused
            If it is not a number from 0 to 200, or the axis is not armed or is about to be disarmed.
        """
        self._admission.check_override(percent, self._machine.state, self.present_trip)
        self._operation.change_override(percent)

    def home(self) -> None:
        """Look for the reference as the settings say; `set_here` takes the place where the axis is.

        Raises
        ------
        Refused
            If the axis does not hold; with `set_here` it may be disarmed as well, but must stand still and be seen.
        """
        if self._settings.homing.method == "set_here":
            self.set_position(self._settings.homing.position)
            return
        self._admission.check_state(self._machine.state, Event.HOME, self.present_trip)
        self._admission.check_switches(Homing.first_direction(self._settings.homing, self._drive))
        self._operation.begin_homing()

    def set_position(self, position: float) -> None:
        """Say where the axis stands now, in axis unit; from then on it knows its position.

        Raises
        ------
        Refused
            If the axis moves, its position is not known, or the number is not finite or no place within its limits.
        """
        if self._machine.state is not State.DISARMED:
            self._admission.check_state(self._machine.state, Event.HOME, self.present_trip)
        # A sample in doubt may be a spike, which would be taken for where the axis stands.
        is_known = self._motion.knows_speed and not self._motion.doubts_sample
        velocity = self._motion.law.observer.velocity if is_known else None
        self._admission.check_place(position, velocity, self._rest_velocity)
        assert self._drive.position is not None  # noqa: S101 - just checked
        self._origin.refer(self._drive.position, position)
        self._operation.declare_homed(position)

    def stop(self, reason: str | None = None, *, quick: bool = False) -> None:
        """Brake, with the acceleration limit or the quick stop deceleration, and hold where the axis comes to rest.

        An axis that is only just being armed is disarmed; one that brakes already is never braked more mildly.

        Raises
        ------
        Refused
            If the axis is not armed.
        """
        event = Event.QUICK_STOP if quick else Event.STOP
        self._admission.check_state(self._machine.state, event, self.present_trip)
        before = self._machine.state
        self._machine.apply(event)
        # Only once: each braking that begins is given its time anew.
        hardest = self._settings.limits.quick_stop_deceleration
        harder = quick and before is State.DISARMING and self._operation.deceleration < hardest
        if harder or (self._machine.state in BRAKING and self._machine.state is not before):
            self._brake(reason, quick=quick)

    @property
    def can_stop(self) -> bool:
        """Whether a stop is admitted."""
        return self._machine.next(Event.STOP) is not None

    def reset(self) -> None:
        """Clear a trip; the axis is disarmed afterwards and needs `arm` and a fresh set-point.

        Raises
        ------
        Refused
            As in :meth:`check_reset`.
        """
        self.check_reset()
        self._machine.apply(Event.RESET)
        self._latch.reset()

    def check_reset(self) -> None:
        """Tell whether a trip could be cleared.

        Raises
        ------
        Refused
            If the axis is armed, or still braking after the trip, or something is wrong with its drive that must not
            last: one that is not disabled, that contradicts itself, or that another node commands while it is enabled.
        """
        if self._machine.state in LATCHED and self._machine.state is not State.TRIPPED:
            raise Refused(RefusalCode.BUSY, "the axis is still braking after its trip: `reset` when it is at rest.")
        if self._machine.next(Event.RESET) is None:
            raise Refused(RefusalCode.NOT_TRIPPED, f"the axis is {self._machine.state}: there is nothing to reset.")
        if (lasting := next(iter(self._hazards.present(self._latch.tick)), None)) is not None:
            raise Refused(RefusalCode(lasting.code), f"{lasting.cause.rstrip('.')}. {lasting.next_action}")

    def forget(self) -> None:
        """Forget what the law has learned of its plant; the next move begins with the configured one.

        Raises
        ------
        Refused
            As in :meth:`check_forget`.
        """
        self.check_forget()
        self._motion.plant.forget()

    def check_forget(self) -> None:
        """Tell whether the law could forget.

        Raises
        ------
        Refused
            If the law learns nothing, or the axis moves: in mid-move it would go on by another plant.
        """
        if self._motion.plant.learned is None:
            law = self._settings.law.type
            raise Refused(
                RefusalCode.LEARNS_NOTHING,
                f"the law that drives the axis (axis.law.type = {law}) learns nothing, or its keys in axis.law.{law} "
                "keep it from learning: there is nothing to forget.",
            )
        if (state := self._machine.state) in COMMANDED:
            raise Refused(RefusalCode.BUSY, f"the axis is {state}: `stop` it, or wait until it holds, then `forget`.")
        if state in BRAKING:
            raise Refused(RefusalCode.BUSY, f"the axis is {state}: wait until it is at rest, then `forget`.")

    def _brake(self, reason: str | None, *, quick: bool) -> None:
        limits = self._settings.limits
        deceleration = limits.quick_stop_deceleration if quick else limits.acceleration
        self._operation.brake(deceleration, MoveOutcome.STOPPED, reason, smooth=not quick)

    def _first_target(self, target: float) -> float:
        """Return the set-point itself, or one beyond it for a move that would end from the wrong side."""
        approach = self._settings.approach
        if approach.direction == "either":
            return target
        sign = 1.0 if approach.direction == "positive" else -1.0
        if sign * (target - self._motion.law.observer.position) > 0.0:
            return target
        limits = self._settings.limits
        return min(max(target - sign * approach.distance, limits.position_minimum), limits.position_maximum)
