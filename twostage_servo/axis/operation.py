"""What an axis is about: the move that was asked for, its legs and speed, the search for a reference, and braking."""

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.homing import Homing
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.moves import Move, MoveKind, MoveOutcome
from twostage_servo.axis.speed_override import Leg, SpeedOverride
from twostage_servo.axis.state import COMMANDED, MOVING, Event
from twostage_servo.axis.state_machine import StateMachine
from twostage_servo.axis.supervision import Supervision
from twostage_servo.control.laws.law import Stage


class Operation:
    """Begins and ends moves and brakings, and tells motion and supervision of them.

    Parameters
    ----------
    design
        The axis.
    machine
        Its state.
    motion, supervision
        What moves it, and what watches that.
    drive
        What its drive reports.
    override
        The share of its speed that a motion has.

    Attributes
    ----------
    move
        The latest move, jog or homing, or None.
    homing
        The search for the reference that is under way, or None.
    final_target
        Where a move that goes past its set-point first ends, in axis unit; None in its last leg.
    deceleration
        Of the present braking, or the latest, in axis unit/s².
    override
        As given.
    """

    __slots__ = (
        "_design", "_drive", "_heading", "_limit", "_machine", "_motion", "_moves", "_supervision", "deceleration",
        "final_target", "homing", "move", "override",
    )  # fmt: skip

    def __init__(
        self,
        design: AxisDesign,
        machine: StateMachine,
        motion: Motion,
        supervision: Supervision,
        drive: DriveReport,
        override: SpeedOverride,
    ) -> None:
        self._design = design
        self._limit = design.settings.limits.velocity
        self._machine = machine
        self._motion = motion
        self._supervision = supervision
        self._drive = drive
        self.override = override
        self._moves = 0
        self._heading = 0.0
        self.move: Move | None = None
        self.homing: Homing | None = None
        self.final_target: float | None = None
        self.deceleration = 0.0

    @property
    def heading(self) -> float:
        """A number whose sign is the direction of the present leg."""
        return self._heading if self.homing is None else self.homing.direction

    @property
    def set_point(self) -> float:
        """Where the move in force ends, in axis unit."""
        if self.final_target is not None:
            return self.final_target
        kept = self.override.kept_target
        return self._motion.law.target if kept is None else kept

    def forget(self) -> None:
        """Begin without a move, at 100 % of the speed of the next one."""
        self.override.reset()
        self.move = self.final_target = None

    def announce(self, kind: MoveKind, target: float, velocity: float) -> Move:
        """Return a move that begins now, to a set-point in axis unit with a velocity in axis unit/s."""
        self._moves += 1
        self.move = Move(self._moves, kind, target, velocity, start=self._motion.law.observer.position)
        return self.move

    def end_move(self, outcome: MoveOutcome, reason: str | None = None) -> None:
        """End the move that is under way, if there is one."""
        self.final_target = None
        self.override.end()
        if self.homing is not None:
            self.homing.end()
            self.homing = None
        if self.move is not None and self.move.outcome is MoveOutcome.MOVING:
            self.move.end(outcome, reason)

    def set_target(self, target: float, velocity: float, largest: float | None = None) -> None:
        """Set out for a set-point in axis unit with a velocity in axis unit/s; the state stays as it is.

        The override applies to the velocity; `largest` is what it may come to, the velocity limit if it is None.
        """
        self._heading = target - self._motion.law.observer.position
        is_under_way = self._machine.state in COMMANDED
        if not is_under_way:
            self._motion.plant.forget_former_moves()
        self.override.set_out(Leg(target, velocity, self._limit if largest is None else largest))
        if is_under_way:
            self._supervision.change_move()
        else:
            self._supervision.begin_move()

    def begin_leg(self, target: float, velocity: float, final_target: float | None = None) -> None:
        """Set out for a set-point, by whichever stage the law begins with; `final_target` is that of a leg after it."""
        self.final_target = final_target
        self.set_target(target, velocity)
        self._tell_stage()

    def begin_last_leg(self) -> bool:
        """Set out for the end of a move that has gone past its set-point first; return whether there is one."""
        if self.final_target is None or self.move is None:
            return False
        target = self.final_target
        self._supervision.begin_move()  # it has come to rest here
        self.begin_leg(target, self.move.velocity)
        return True

    def change_override(self, percent: float) -> None:
        """Take another share of the speed, in percent: in the motion that is under way, and in those to come."""
        law, was_held = self._motion.law, self.override.is_held
        was_at_rest = was_held and law.stage is Stage.POSITION
        if not self.override.change(percent):
            return
        if was_held:
            self._heading = law.target - law.observer.position  # the stop may have gone beyond it
        if was_at_rest:
            self._supervision.begin_move()
        else:
            self._supervision.change_move()
        if self._machine.state in MOVING:
            self._tell_stage()

    def _tell_stage(self) -> None:
        self._machine.apply(Event.MOVE_POSITION if self._motion.law.stage is Stage.POSITION else Event.MOVE_SPEED)

    def begin_homing(self) -> None:
        """Begin to look for the reference."""
        homing = self._design.settings.homing
        self._motion.plant.forget_former_moves()
        self.homing = Homing(self._design, self._motion, self._drive)
        self._supervision.begin_move()
        self._machine.apply(Event.HOME)
        self.announce(MoveKind.HOME, homing.position, homing.velocity)

    def end_homing(self, distance: float) -> None:
        """End the search with the reference found, from which positions now count: `distance` lower than before."""
        if self.move is not None:
            self.move.shift_start(distance)
        self.end_move(MoveOutcome.REACHED)

    def declare_homed(self, position: float) -> None:
        """Keep as a homing what only says that the axis stands at a position, in axis unit."""
        self.announce(MoveKind.HOME, position, 0.0).end(MoveOutcome.REACHED, None)

    def brake(
        self, deceleration: float, outcome: MoveOutcome, reason: str | None = None, *, smooth: bool = False
    ) -> None:
        """End the move, and bring the axis to rest with a deceleration in axis unit/s²; `smooth` as for a motion."""
        self.end_move(outcome, reason)
        self.deceleration = deceleration
        self._motion.stop(deceleration, smooth=smooth)
        self._supervision.begin_braking(deceleration, smooth=smooth)

    def brake_anew(self) -> None:
        """Go on braking after a trip, from another speed than the axis was thought to have."""
        self._motion.stop(self.deceleration)
        self._supervision.begin_braking(self.deceleration)
