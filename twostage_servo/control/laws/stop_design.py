"""How far a stop of :mod:`twostage_servo.control.laws.stop` goes and how long it takes, on the model and off it."""

from dataclasses import dataclass
from math import sqrt
from typing import Protocol

from twostage_servo.control.laws.law import ControlTask
from twostage_servo.control.laws.stop import SMOOTH_SHARE, ending_share
from twostage_servo.control.plant import MODEL_ERROR


def smoothing_time_s(velocity: float, deceleration: float, jerk: float) -> float:
    """Return by how much longer an S-curve takes than a ramp, at most, in s.

    Parameters
    ----------
    velocity
        By which the speed changes, in axis unit/s.
    deceleration
        Slope of the ramp, in axis unit/s²; the S-curve's is less where the change is too small for it.
    jerk
        Of the S-curve, in axis unit/s³; infinity for none.
    """
    speed, jerk = abs(velocity), SMOOTH_SHARE * jerk
    if speed >= deceleration * deceleration / jerk:
        return deceleration / jerk
    return 2.0 * sqrt(speed / jerk) - speed / deceleration


def smoothing_distance(velocity: float, deceleration: float, jerk: float) -> float:
    """Return how much farther an S-curve from a velocity to rest goes than a ramp, at most, in axis unit.

    Both go on at half of the speed on average, in an S-curve that is even. Parameters as in :func:`smoothing_time_s`.
    """
    return 0.5 * abs(velocity) * smoothing_time_s(velocity, deceleration, jerk)


@dataclass(frozen=True, slots=True)
class StopDesign:
    """How far and how long a :class:`Stop` goes.

    Attributes
    ----------
    task
        The plant, its limits and the tick.
    """

    task: ControlTask

    def distance(self, velocity: float, deceleration: float) -> float:
        """Return how far the plant of the model goes, in axis unit; as :meth:`~.law.LawDesign.stopping_distance`.

        The ramp's own ``v²/2a``, a tick until the first effort of it acts, the time that the effort rate takes, and the
        gradual end: where a share s of the speed is less than a step of the ramp, ``a T``, the speed falls by that
        share in a tick, which takes ``v T (1/s - 1/2)``.
        """
        speed, attainable, period_s = abs(velocity), self.attainable(deceleration), self.task.period_s
        share = ending_share(period_s)
        ending_speed = min(speed, attainable * period_s / share)
        ending_s = period_s * (1.0 / share - 0.5) - ending_speed / (2.0 * attainable)
        steepest = min(attainable, share * speed / period_s)
        return self._ramp_distance(speed, deceleration, steepest) + ending_speed * ending_s

    def certain_distance(self, velocity: float, deceleration: float) -> float:
        """Return how far an axis goes at most whose plant is off its model, in axis unit.

        A plant that answers by a share less keeps that share of its speed when the ramp ends, and coasts.
        """
        coasting = abs(velocity) / self.task.plant.pole
        ramp = self._ramp_distance(abs(velocity), deceleration, deceleration)
        return max(ramp + MODEL_ERROR * coasting, self.distance(velocity, deceleration))

    def ramp_time_s(self, velocity: float, deceleration: float) -> float:
        """Return how long the ramp takes, with the time for the effort rate, in s."""
        return abs(velocity) / self.attainable(deceleration) + self.effort_time_s(velocity, deceleration)

    def attainable(self, deceleration: float) -> float:
        """Return the part of a deceleration (axis unit/s²) that limit and rate of the effort allow.

        Friction helps less and less as the axis slows down, and the effort has to take over at its rate.
        """
        plant, task = self.task.plant, self.task
        return min(
            deceleration, abs(plant.gain) * task.effort_limit, abs(plant.gain) * task.effort_rate_limit / plant.pole
        )

    def effort_time_s(self, velocity: float, deceleration: float) -> float:
        """Return how long the effort rate takes from the effort of a cruise to that of braking, in s."""
        plant, task = self.task.plant, self.task
        cruise = abs(velocity * plant.pole / plant.gain)
        swing = min(abs(deceleration / plant.gain), cruise + task.effort_limit)
        return swing / task.effort_rate_limit

    def _ramp_distance(self, speed: float, deceleration: float, steepest: float) -> float:
        """Return the way of a ramp to its sharp end, whose effort is that of a deceleration `steepest`."""
        delay_s = self.task.period_s + self.effort_time_s(speed, steepest)
        return speed * delay_s + speed**2 / (2.0 * self.attainable(deceleration))


class _Design(Protocol):
    """A law's design that stops by a ramp."""

    @property
    def task(self) -> ControlTask:
        """What the law is designed for."""

    @property
    def settling_time_s(self) -> float:
        """How long the end of a stop takes to die down to a hundredth, in s."""


class StopsByRamp:
    """What a law's design says of its stops where they are those of :class:`Stop`."""

    __slots__ = ()

    def stopping_distance(self: _Design, velocity: float, deceleration: float) -> float:
        """Return how far the plant of the model goes in a stop, in axis unit."""
        return StopDesign(self.task).distance(velocity, deceleration)

    def certain_stopping_distance(self: _Design, velocity: float, deceleration: float) -> float:
        """Return how far an axis goes at most whose plant is off its model, in axis unit."""
        return StopDesign(self.task).certain_distance(velocity, deceleration)

    def stopping_time_s(self: _Design, velocity: float, deceleration: float) -> float:
        """Return how long a stop takes, in s: the ramp, the effort rate, and until the rest has died down."""
        return StopDesign(self.task).ramp_time_s(velocity, deceleration) + self.settling_time_s
