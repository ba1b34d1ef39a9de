"""The speed override: a percentage of the speed of each move and jog, changed at any time; 0 holds the axis."""

import math
from typing import NamedTuple

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.moves import USUAL_OVERRIDE
from twostage_servo.control.laws.law import Stage


class Leg(NamedTuple):
    """Where the axis is bound for: a set-point, the speed that was asked for, and the largest that it may have.

    In axis unit and axis unit/s.
    """

    target: float
    velocity: float
    largest: float


class SpeedOverride:
    """Sets out for a set-point with the share of the speed that is in force, and changes that on the way.

    An override of 0 holds: the law's own stop brings the axis to rest with the acceleration limit. The set-point is
    kept here, and the law is given it again as soon as the override rises. An axis that is nearer to its set-point than
    a stop takes comes to rest there instead.

    Homing does not pass through here: a search has its own speeds.

    Parameters
    ----------
    design
        The axis.
    motion
        What moves it.
    slowest
        Smallest speed that is one, in axis unit/s; a share of the speed below it holds as 0 does.

    Attributes
    ----------
    percent
        What is in force, in percent of the speed that was asked for.
    kept_target
        The set-point that an override of 0 keeps the axis from, in axis unit; None if the axis is not held.
    """

    __slots__ = (
        "_acceleration",
        "_design",
        "_leg",
        "_motion",
        "_rest_velocity",
        "_slowest",
        "_window",
        "kept_target",
        "percent",
    )

    def __init__(self, design: AxisDesign, motion: Motion, slowest: float) -> None:
        self._design = design
        self._motion = motion
        self._slowest = slowest
        self._acceleration = design.settings.limits.acceleration
        self._window = design.settings.window.position
        self._rest_velocity = design.rest_velocity
        self.reset()

    def reset(self) -> None:
        """Begin without a motion, at 100 %."""
        self.percent = USUAL_OVERRIDE
        self.end()

    def end(self) -> None:
        """End the motion; the override stays for the next one."""
        self._leg: Leg | None = None
        self.kept_target: float | None = None

    def speed(self, velocity: float, largest: float) -> float:
        """Return the speed in force where `velocity` was asked for and `largest` is possible, in axis unit/s.

        0 where the axis is held.
        """
        speed = min(velocity * (self.percent / USUAL_OVERRIDE), largest)
        return speed if speed >= self._slowest else 0.0

    @property
    def is_held(self) -> bool:
        """Whether a motion is under way that an override of 0 keeps from its set-point."""
        return self.kept_target is not None

    def set_out(self, leg: Leg) -> None:
        """Set out for a set-point, from rest or in the place of another one."""
        self._leg = leg
        speed = self.speed(leg.velocity, leg.largest)
        if speed > 0.0:
            self.kept_target = None
            self._motion.set_target(leg.target, speed)
        else:
            self._hold(leg)

    def change(self, percent: float) -> bool:
        """Take another override, and return whether the motion that is under way changes at once."""
        self.percent = percent
        leg, law = self._leg, self._motion.law
        if leg is None:
            return False
        speed = self.speed(leg.velocity, leg.largest)
        if speed == 0.0:
            if self.is_held or not self._stops_on_the_way(leg):
                return False
            self._hold(leg)
            return True
        # In its position stage the axis comes to rest at its set-point: it may be slowed down, but not hurried.
        hastens = law.stage is Stage.POSITION and abs(law.observer.velocity) <= speed
        if not self.is_held and (hastens or law.cruise_velocity == speed):
            return False
        self.kept_target = None
        self._motion.set_target(leg.target, speed)
        return True

    def _hold(self, leg: Leg) -> None:
        """Come to rest, and stay there."""
        law = self._motion.law
        self.kept_target = leg.target
        at_rest = abs(law.observer.velocity) <= self._rest_velocity and self._is_at(law.target)
        if not (at_rest and law.stage is Stage.POSITION) and law.stage is not Stage.BRAKE:
            self._motion.stop(self._acceleration, smooth=True)

    def _stops_on_the_way(self, leg: Leg) -> bool:
        """Whether a stop ends elsewhere than at the set-point, and not beyond it, where the axis would come to rest."""
        observer = self._motion.law.observer
        velocity = observer.velocity
        way = math.copysign(1.0, velocity) * (leg.target - observer.position)
        needed = self._design.stopping_distance(velocity, self._acceleration, smooth=True)
        needed += abs(velocity) * self._design.period_s
        return not (0.0 <= way <= needed or self._is_at(leg.target))

    def _is_at(self, target: float) -> bool:
        return abs(target - self._motion.law.observer.position) <= self._window
