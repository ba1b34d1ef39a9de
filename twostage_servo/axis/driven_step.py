"""A tick of an axis whose law runs: the effort, and all that the motion comes to."""

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.homing import HomingFailed
from twostage_servo.axis.messages import NO_EFFORT, Command
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.operation import Operation
from twostage_servo.axis.origin import Origin
from twostage_servo.axis.reference import Reference
from twostage_servo.axis.state import BRAKING, COMMANDED, DRIVEN, Event, State
from twostage_servo.axis.state_machine import StateMachine
from twostage_servo.axis.supervision import Supervision
from twostage_servo.axis.trip_latch import TripLatch
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.laws.law import Stage

_ANSWERS = frozenset({TripCode.MODEL_MISMATCH, TripCode.SIGN_REVERSED})
"""Trips by how the axis answers its effort."""


class DrivenStep:
    """Runs the law once a tick, holds the limits, and ends what has come to its end.

    Parameters
    ----------
    design
        The axis.
    machine
        Its state.
    drive
        What its drive reports.
    motion, supervision, operation
        What moves it, what watches that, and what it is about.
    latch
        Where it trips.
    origin, reference
        From where positions count, and on what they rest.
    """

    __slots__ = (
        "_design", "_drive", "_latch", "_machine", "_motion", "_operation", "_origin", "_reference", "_supervision",
    )  # fmt: skip

    def __init__(
        self,
        design: AxisDesign,
        machine: StateMachine,
        drive: DriveReport,
        motion: Motion,
        supervision: Supervision,
        operation: Operation,
        latch: TripLatch,
        origin: Origin,
        reference: Reference,
    ) -> None:
        self._design = design
        self._machine = machine
        self._drive = drive
        self._motion = motion
        self._supervision = supervision
        self._operation = operation
        self._latch = latch
        self._origin = origin
        self._reference = reference

    def step(self) -> Command:
        """Run the law, and return what goes to the drive."""
        machine, motion, law = self._machine, self._motion, self._motion.law
        changeovers, implausible = law.changeovers, motion.implausible
        effort = motion.step()
        if motion.implausible > implausible:
            self._drive.monitor.doubt()
        if not motion.finite:
            self._latch.raise_trip(
                TripCode.NOT_FINITE, f"the law computed an effort of {effort} at position {law.observer.position:g}"
            )
            motion.lose_track()
            return NO_EFFORT
        if law.changeovers != changeovers:
            self._after_changeover()
        if motion.moves_after_all or motion.cannot_stop:
            self.end_braking()
        for code, cause in self._supervision.violations(machine.state, referenced=self._reference.source is not None):
            self._latch.raise_trip(code, cause, keeps_reference=self._lacks_commands(code))
        self._check_switch_ahead()
        if machine.state is State.HOMING:
            self._home()
        elif machine.state in {State.POSITION_STAGE, State.JOGGING}:
            self._check_window()
        return Command(effort, enable=True) if machine.state in DRIVEN else NO_EFFORT

    def _lacks_commands(self, code: TripCode) -> bool:
        """Whether a trip says no more than that the commands by which the axis should brake do not arrive.

        Where the bus has been seen to take none, the drive keeps its effort. Compared with the efforts that were meant
        to act, the axis then seems to answer too little, or the wrong way round; its encoder is right.
        """
        first = self._latch.trip
        return (
            code in _ANSWERS
            and first is not None
            and first.code is TripCode.COMMANDS_DROPPED
            and self._machine.state in BRAKING
        )

    def end_braking(self) -> None:
        """Give up a braking that takes too long, and disable the drive as at its end."""
        if self._machine.next(Event.AT_REST) in {State.DISARMED, State.TRIPPED}:
            self._machine.apply(Event.AT_REST)

    def _after_changeover(self) -> None:
        # The response is judged stage by stage: what the speed stage gained or lost does not count in the next.
        self._motion.nominal.continue_from(self._motion.law)
        if self._operation.override.is_held:
            self._supervision.forget_move()  # it has come to rest, on its way
        if self._machine.state in BRAKING:
            self._supervision.forget_move()
            self._machine.apply(Event.AT_REST)
        elif self._machine.state is not State.HOLDING:
            self._machine.apply(Event.CHANGEOVER)

    def _check_switch_ahead(self) -> None:
        estimate = self._motion.law.observer
        velocity = estimate.velocity
        moves = abs(velocity) > self._design.rest_velocity
        switch = self._drive.blocks(velocity) if moves else None
        if self._machine.state in COMMANDED:  # also one so slow that its speed is none
            switch = switch or self._drive.blocks(self._operation.heading)
        if switch:
            unit = self._design.settings.unit
            self._latch.raise_trip(
                TripCode.LIMIT_SWITCH,
                f"the {switch} limit switch is active at {estimate.position:.6g} {unit}, and "
                f"the axis moves towards it at {velocity:.4g} {unit}/s",
            )

    def _check_window(self) -> None:
        position = self._drive.position if self._drive.fresh else None
        if (
            position is None
            or self._motion.law.stage is not Stage.POSITION
            or self._operation.override.is_held
            or not self._supervision.has_arrived(position)
            or self._operation.begin_last_leg()
        ):
            return
        self._supervision.forget_move()
        self._operation.end_move(MoveOutcome.REACHED)
        self._machine.apply(Event.REACHED)

    def _home(self) -> None:
        homing = self._operation.homing
        assert homing is not None  # noqa: S101 - the state and the search begin and end together
        try:
            homing.step()
        except HomingFailed as failure:
            self._latch.raise_trip(TripCode.HOMING_FAILED, str(failure))
            return
        if homing.done and homing.reference is not None:
            distance = self._origin.refer(homing.reference, self._design.settings.homing.position)
            self._operation.end_homing(distance)
            self._machine.apply(Event.REACHED)
