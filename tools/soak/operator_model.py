"""The operator of a soaked axis: asks for what makes sense, mostly, and mends what has failed."""

import math
from collections.abc import Callable
from random import Random

from tools.soak.drive_model import DriveModel
from tools.soak.drive_watch import DriveWatch
from tools.soak.encoder_watch import EncoderWatch
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import State

_MENDED_AT_ONCE = 0.6
"""Share of trips with a wrong encoder after which the operator mends it before going on."""

_RAISED_AT_ONCE = 0.5
"""Share of the requests after an override of 0 that change it again: a held axis shows little."""


class OperatorModel:
    """Asks an axis for something, one thing at a time.

    Parameters
    ----------
    axis, drive, watch, drive_watch
        The axis, its drive, and what watches its encoder and its drive.
    random
        Of what is asked.

    Attributes
    ----------
    requests, refusals, moves_reached
        What was asked so far, what of it was refused, and the moves that were reached.
    """

    def __init__(
        self, axis: Axis, drive: DriveModel, watch: EncoderWatch, drive_watch: DriveWatch, random: Random
    ) -> None:
        self._axis = axis
        self._drive = drive
        self._watch = watch
        self._drive_watch = drive_watch
        self._random = random
        self._homes = axis.settings.homing.method != "set_here"
        self.requests = self.refusals = self.moves_reached = 0
        self._commands: tuple[Callable[[], object], ...] = (
            *[self._move] * 6, *[self._move_nearby] * 5, *[self._step] * 2, *[self._jog] * 2, axis.stop,
            self._quick_stop, self._override, axis.disarm, axis.arm, self._say_where, self._ask_nonsense,
            *([self._home] * 2 if self._homes else []),
        )  # fmt: skip

    def act(self) -> None:
        """Do what an operator might."""
        axis = self._axis
        if axis.trip is not None:
            if self._watch.active and axis.state is State.TRIPPED and self._random.random() < _MENDED_AT_ONCE:
                self.mend_encoder()
            self._ask(axis.reset)
        elif axis.state is State.DISARMED:
            self._arm()
        elif not axis.referenced and self._homes and axis.state is State.HOLDING and self._random.random() < 0.8:
            self._ask(self._home)
        elif axis.override_percent == 0.0 and self._random.random() < _RAISED_AT_ONCE:
            self._ask(self._override)
        else:
            self._ask(self._random.choice(self._commands))

    def mend_encoder(self) -> None:
        """Mend the encoder of an axis that is disarmed; what it counts from then on may be off."""
        self._drive.mend_encoder(absolute=self._random.random() < 0.5)
        self._watch.mended()

    # Disarmed --------------------------------------------------------------------------------------------------------

    def _arm(self) -> None:
        axis = self._axis
        if (not axis.referenced and not self._homes) or self._random.random() < 0.05:
            self._ask(self._say_where)
        if self._move_back_by_hand():
            return  # and armed when its drive has reported where it is now
        self._ask(axis.arm)

    def _move_back_by_hand(self) -> bool:
        """Move an axis by hand that stands outside its limits; return whether it did."""
        axis, drive = self._axis, self._drive
        limits = axis.settings.limits
        outside = not limits.position_minimum <= drive.position <= limits.position_maximum
        obstacle = axis.obstacle_to_arming()
        moves = outside or (obstacle is not None and obstacle[0] == RefusalCode.POSITION_LIMIT)
        if moves:
            before = drive.position
            drive.place(0.9 * math.copysign(limits.position_maximum, before))
            self._watch.moved_by_hand(before, drive.position)
            self._drive_watch.moved_by_hand(before, drive.position)
        return moves

    def _say_where(self) -> None:
        self._axis.set_position(self._drive.position)
        self._watch.placed(self._drive.velocity)

    # Armed -----------------------------------------------------------------------------------------------------------

    def _home(self) -> None:
        self._axis.home()
        velocity = self._axis.settings.homing.velocity
        self._watch.move_asked(self._drive.position, velocity, self._drive.velocity, at_rest=True)

    def _move(self) -> None:
        move = self._axis.move
        self.moves_reached += move is not None and move.outcome is MoveOutcome.REACHED
        limits = self._axis.settings.limits
        self._move_to(self._random.uniform(limits.position_minimum, limits.position_maximum))

    def _move_nearby(self) -> None:
        limits = self._axis.settings.limits
        near = 0.2 * limits.velocity
        target = self._drive.position + self._random.uniform(-near, near)
        self._move_to(min(max(target, limits.position_minimum), limits.position_maximum))

    def _move_to(self, target: float) -> None:
        drive, velocity, at_rest = self._drive, self._velocity_asked(), self._at_rest()
        self._axis.move_to(target, velocity)
        self._watch.move_asked(drive.position, self._in_force(velocity), drive.velocity, at_rest=at_rest)

    def _step(self) -> None:
        drive, velocity, at_rest = self._drive, self._velocity_asked(), self._at_rest()
        step = 0.02 * self._axis.settings.limits.velocity
        self._axis.move_by(self._random.uniform(-step, step), velocity)
        self._watch.move_asked(drive.position, self._in_force(velocity), drive.velocity, at_rest=at_rest)

    def _jog(self) -> None:
        drive, velocity, at_rest = self._drive, self._velocity_asked(), self._at_rest()
        self._axis.jog(self._random.choice((-1.0, 1.0)) * velocity)
        self._watch.move_asked(drive.position, self._in_force(velocity), drive.velocity, at_rest=at_rest)

    def _override(self) -> None:
        """Change the speed override, but not while the encoder counts wrongly: its bounds go by the speed asked for."""
        if not self._watch.active:
            self._axis.set_override(self._random.choice((0.0, 100.0, self._random.uniform(0.0, 200.0))))

    def _in_force(self, velocity: float) -> float:
        return self._axis.velocity_in_force(velocity) or velocity

    def _ask_nonsense(self) -> None:
        beyond = self._axis.settings.limits.position_maximum * 1.001
        self._axis.move_to(self._random.choice((math.nan, math.inf, -math.inf, 1e300, beyond)), self._velocity_asked())

    def _quick_stop(self) -> None:
        self._axis.stop(quick=True)

    def _at_rest(self) -> bool:
        return self._axis.state is State.HOLDING

    def _velocity_asked(self) -> float:
        return self._random.uniform(0.1, 1.0) * self._axis.settings.limits.velocity

    def _ask(self, request: Callable[[], object]) -> None:
        """Ask for something: it is carried out or refused; anything else ends the soak."""
        self.requests += 1
        try:
            request()
        except Refused:
            self.refusals += 1
