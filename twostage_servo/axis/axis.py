"""One axis: what an operator may ask of it; what it does then, tick by tick, is in the module ``machine``."""

import math

from twostage_servo.axis.admission import say_tripped
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.duration import MoveDuration
from twostage_servo.axis.homing import Homing
from twostage_servo.axis.machine import Machine
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.axis.moves import Move, MoveKind, MoveOutcome
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import BRAKING, LATCHED, Event, State, next_state

_FAR_S = 3600.0
"""How far ahead, in time, the set-point of a jog lies on an axis that does not know its position."""


class Axis(Machine):
    """An axis as its operator sees it: each request is carried out, or refused with a code and a reason.

    Parameters and attributes as in :class:`~twostage_servo.axis.machine.Machine`; and ``duration``, which tells how
    long its moves take.
    """

    def __init__(self, design: AxisDesign, traits: DriveTraits) -> None:
        super().__init__(design, traits)
        self.duration = MoveDuration(design)
        self._moves = 0

    # What the operator asks for --------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Enable the drive; the axis then holds the position at which it is.

        Raises
        ------
        Refused
            As in :meth:`check_arming`.
        """
        self.check_arming()
        self._ticks_arming = 0
        self._apply(Event.ARM)

    def check_arming(self) -> None:
        """Tell whether the axis could be armed.

        Raises
        ------
        Refused
            If the axis is not disarmed, there is no fresh feedback, the drive reports a fault, or the axis stands
            outside its position limits.
        """
        if (trip := self.present_trip) is not None:
            raise Refused(RefusalCode.TRIPPED, f"{say_tripped(trip)} `reset` first.")
        if self.state is not State.DISARMED:
            raise Refused(RefusalCode.ALREADY_ARMED, f"the axis is armed already ({self.state}).")
        if obstacle := self.obstacle_to_arming():
            raise Refused(*obstacle)

    def disarm(self, reason: str | None = None) -> None:
        """Bring a moving axis to rest, then disable the drive; an axis at rest is disabled at once.

        Parameters
        ----------
        reason
            What the end of a move is explained by, where it is not the operator who has asked for it.
        """
        if self.state in LATCHED:  # disabled already, or about to be
            return
        before = self.state
        self._apply(Event.DISARM)
        if self.state is State.DISARMING and before is not State.DISARMING:  # asked again, it goes on as it was
            limits = self.settings.limits
            quick = before is State.QUICK_STOPPING  # which is not made milder
            self._brake(limits.quick_stop_deceleration if quick else limits.acceleration, MoveOutcome.STOPPED, reason)

    def move_to(self, target: float, velocity: float) -> Move:
        """Take a set-point in axis unit and its cruise velocity in axis unit/s; the effort stays continuous.

        Raises
        ------
        Refused
            As in :meth:`check_move`.
        """
        self.check_move(target, velocity)
        self._end_move(MoveOutcome.REPLACED)
        first = self._first_target(target)
        self._final_target = target if first != target else None
        self._begin_leg(first, velocity)
        return self._new_move(MoveKind.MOVE, target, velocity)

    def check_move(self, target: float, velocity: float) -> None:
        """Tell whether a set-point could be taken.

        Raises
        ------
        Refused
            If the axis is not armed, is stopping, is not homed, a limit switch is in the way, or a number is not finite
            or outside the limits.
        """
        check = self._admission
        check.check_velocity(velocity, self.settings.limits.velocity)
        check.check_state(self.state, Event.MOVE_SPEED, self.present_trip)
        check.check_target(target, referenced=self.referenced, lost_because=self.reference.lost_because)
        check.check_switches(target - self.law.observer.position)

    def move_by(self, distance: float, velocity: float) -> Move:
        """Move relative to the set-point now in force, so that steps add up exactly; else as :meth:`move_to`."""
        self._admission.check_state(self.state, Event.MOVE_SPEED, self.present_trip)
        in_force = self.law.target if self._final_target is None else self._final_target
        return self.move_to(in_force + distance, velocity)

    def jog(self, velocity: float) -> None:
        """Move at a velocity in axis unit/s (its sign counts) until the jog time-out, unless asked again before.

        An axis that knows its position comes to rest at its position limit.

        Raises
        ------
        Refused
            If the axis neither holds nor jogs, the velocity is not finite or too large, or the way is blocked; or if
            somebody else has stopped it, until a jog was not asked for during its time-out.
        """
        limits, check = self.settings.limits, self._admission
        if self._jog_barred_ticks:
            self._jog_barred_ticks = self._jog_ticks
            raise Refused(
                RefusalCode.STOPPED,
                "this axis was stopped, and not by whoever jogs it: let go of the jog for "
                f"{self.settings.jog_timeout_ms:g} ms, look at the axis, and ask again.",
            )
        check.check_velocity(abs(velocity), limits.velocity if self.referenced else self.settings.homing.velocity)
        check.check_state(self.state, Event.JOG, self.present_trip)
        check.check_switches(velocity)
        self._jog_ticks_left = self._jog_ticks
        if self.state is State.JOGGING and self.move is not None and self.move.velocity == velocity:
            return
        position = self.law.observer.position
        target = position + _FAR_S * velocity
        if self.referenced:
            target = limits.position_maximum if velocity > 0.0 else limits.position_minimum
            if math.copysign(1.0, velocity) * (target - position) <= self.settings.window.position:
                raise Refused(
                    RefusalCode.POSITION_LIMIT, f"the axis stands at its limit of {target:g} {self.settings.unit}."
                )
        self._end_move(MoveOutcome.REPLACED)
        self._set_target(target, abs(velocity))
        self._apply(Event.JOG)
        self._new_move(MoveKind.JOG, target, velocity)

    def home(self) -> None:
        """Look for the reference as the settings say; `set_here` takes the place where the axis is.

        Raises
        ------
        Refused
            If the axis does not hold; with `set_here` it may be disarmed as well, but must stand still and be seen.
        """
        if self.settings.homing.method == "set_here":
            self.set_position(self.settings.homing.position)
            return
        self._admission.check_state(self.state, Event.HOME, self.present_trip)
        self._admission.check_switches(Homing.first_direction(self.settings.homing, self.drive))
        self._homing = Homing(self.design, self.motion, self.drive)
        self.supervision.begin_move()
        self._apply(Event.HOME)
        self._new_move(MoveKind.HOME, self.settings.homing.position, self.settings.homing.velocity)

    def set_position(self, position: float) -> None:
        """Say where the axis stands now, in axis unit; from then on it knows its position.

        Raises
        ------
        Refused
            If the axis moves, its position is not known, or the number is not finite or no place within its limits.
        """
        if self.state is not State.DISARMED:
            self._admission.check_state(self.state, Event.HOME, self.present_trip)
        # A sample in doubt may be a spike, which would be taken for where the axis stands.
        is_known = self.motion.knows_speed and not self.motion.doubts_sample
        velocity = self.law.observer.velocity if is_known else None
        self._admission.check_place(position, velocity, self.design.rest_velocity)
        assert self.drive.position is not None  # noqa: S101 - just checked
        self._reference_at(self.drive.position, position)

    def stop(self, reason: str | None = None, *, quick: bool = False) -> None:
        """Brake, with the acceleration limit or the quick stop deceleration, and hold where the axis comes to rest.

        An axis that is only just being armed is disarmed; one that brakes already is never braked more mildly.

        Raises
        ------
        Refused
            If the axis is not armed.
        """
        event = Event.QUICK_STOP if quick else Event.STOP
        self._admission.check_state(self.state, event, self.present_trip)
        before = self.state
        self._apply(event)
        limits = self.settings.limits
        # Only once: each braking that begins is given its time anew.
        harder = quick and before is State.DISARMING and self._deceleration < limits.quick_stop_deceleration
        if harder or (self.state in BRAKING and self.state is not before):
            self._brake(limits.quick_stop_deceleration if quick else limits.acceleration, MoveOutcome.STOPPED, reason)

    def bar_jog(self) -> None:
        """Take no jog before it was let go for its time-out: a stop must outlast the requests that keep a jog going.

        For a stop by somebody else than who jogs. Whoever asks blindly, every 100 ms, would set the axis moving again.
        """
        self._jog_barred_ticks = self._jog_ticks

    @property
    def slowest_velocity(self) -> float:
        """Smallest speed that a set-point is taken with, in axis unit/s."""
        return self._admission.slowest

    @property
    def can_stop(self) -> bool:
        """Whether a stop is admitted."""
        return next_state(self.state, Event.STOP) is not None

    def reset(self) -> None:
        """Clear a trip; the axis is disarmed afterwards and needs `arm` and a fresh set-point.

        Raises
        ------
        Refused
            As in :meth:`check_reset`.
        """
        self.check_reset()
        self._apply(Event.RESET)
        self.trip = self.escalation = None
        self.trips.clear()

    def check_reset(self) -> None:
        """Tell whether a trip could be cleared.

        Raises
        ------
        Refused
            If the axis is armed, or still braking after the trip, or something is wrong with its drive that must not
            last: one that is not disabled, that contradicts itself, or that another node commands while it is enabled.
        """
        if self.state in LATCHED and self.state is not State.TRIPPED:
            raise Refused(RefusalCode.BUSY, "the axis is still braking after its trip: `reset` when it is at rest.")
        if next_state(self.state, Event.RESET) is None:
            raise Refused(RefusalCode.NOT_TRIPPED, f"the axis is {self.state}: there is nothing to reset.")
        if (lasting := next(iter(self.hazards), None)) is not None:
            raise Refused(RefusalCode(lasting.code), f"{lasting.cause.rstrip('.')}. {lasting.next_action}")

    def _new_move(self, kind: MoveKind, target: float, velocity: float) -> Move:
        self._moves += 1
        self.move = Move(self._moves, kind, target, velocity, start=self.law.observer.position)
        return self.move

    def _first_target(self, target: float) -> float:
        """Return the set-point itself, or one beyond it for a move that would end from the wrong side."""
        approach = self.settings.approach
        if approach.direction == "either":
            return target
        sign = 1.0 if approach.direction == "positive" else -1.0
        if sign * (target - self.law.observer.position) > 0.0:
            return target
        limits = self.settings.limits
        return min(max(target - sign * approach.distance, limits.position_minimum), limits.position_maximum)
