"""Gains from closed-loop poles, in closed form: a model that has just been identified is taken on within its tick.

Which process noise makes a Kalman filter of them, or why none does, is in docs/adaptive-law.md. Poles are given in z,
so they mean the same share of a tick on every tick.
"""

from math import atan2, cos, hypot, sin, sqrt
from typing import NamedTuple, Protocol

from twostage_servo.control.plant import DiscretePlant, Triple

_LEAST_POLE = 0.02
"""A pole nearer to 0 than this is as good as there: its power would be, whatever the exponent."""


class Pair(NamedTuple):
    """Two poles, ``real ± j sqrt(square)``; real ones where the square is negative.

    Attributes
    ----------
    real, square
        In z, and in z².
    """

    real: float
    square: float

    def slower(self, exponent: float) -> "Pair":
        """Return the poles to a power: below 1, what they let die down takes ``1/exponent`` times as long."""
        if self.square >= 0.0:
            imaginary = sqrt(self.square)
            radius, angle = hypot(self.real, imaginary) ** exponent, atan2(imaginary, self.real) * exponent
            return Pair(radius * cos(angle), (radius * sin(angle)) ** 2)
        half = sqrt(-self.square)
        larger = max(self.real + half, _LEAST_POLE) ** exponent
        smaller = max(self.real - half, _LEAST_POLE) ** exponent
        return Pair(0.5 * (larger + smaller), -0.25 * (larger - smaller) ** 2)

    def at(self, z: float) -> float:
        """Return the value of the pair's monic polynomial, ``(z - real)² + square``."""
        return (z - self.real) ** 2 + self.square


class Gains(Protocol):
    """Where the gains of a plant come from.

    Attributes
    ----------
    memory
        Lower right entry of A_o of the observer, equation (25).
    """

    @property
    def memory(self) -> float: ...  # noqa: D102 - see the class

    def observer_gain(self, plant: DiscretePlant) -> Triple:
        """Return L1, L2, L3 of the disturbance observer in predictor form, in 1, 1/s and effort unit per axis unit."""

    def feedback_gains(self, plant: DiscretePlant) -> tuple[float, float]:
        """Return f1 and f2 of ``u = -f1 x1 - f2 x2``, in effort unit per axis unit and per axis unit/s."""

    def slower(self, exponent: float) -> "Gains":
        """Return those where less is known: what the loop lets die down takes ``1/exponent`` times as long."""


class FixedGains(NamedTuple):
    """The gains that the paper's design gives for the configured plant; they stay, whatever is known.

    Attributes
    ----------
    observer, feedback, memory
        ``A_o K`` of equations (26) and (27), f11 and f12 of (13), and the corner of (25).
    """

    observer: Triple
    feedback: tuple[float, float]
    memory: float

    def observer_gain(self, plant: DiscretePlant) -> Triple:  # noqa: ARG002 - the interface's
        """Return ``A_o K``."""
        return self.observer

    def feedback_gains(self, plant: DiscretePlant) -> tuple[float, float]:  # noqa: ARG002 - the interface's
        """Return f11 and f12."""
        return self.feedback

    def slower(self, exponent: float) -> "FixedGains":  # noqa: ARG002 - the interface's
        """Return the same."""
        return self


class Poles(NamedTuple):
    """Where the poles of the closed loop are to be.

    Attributes
    ----------
    single, observer
        Of the observer's error: a real one, and two.
    feedback
        Of the position stage.
    """

    single: float
    observer: Pair
    feedback: Pair

    @property
    def memory(self) -> float:
        """1: the disturbance persists."""
        return 1.0

    def observer_gain(self, plant: DiscretePlant) -> Triple:
        """Return L1, L2, L3; see :func:`observer_gain`."""
        return observer_gain(plant, self.single, self.observer)

    def feedback_gains(self, plant: DiscretePlant) -> tuple[float, float]:
        """Return f1 and f2; see :func:`feedback_gains`."""
        return feedback_gains(plant, self.feedback)

    def slower(self, exponent: float) -> "Poles":
        """Return all of them to a power; see :meth:`Pair.slower`."""
        return Poles(
            max(self.single, _LEAST_POLE) ** exponent, self.observer.slower(exponent), self.feedback.slower(exponent)
        )


def observer_gain(plant: DiscretePlant, single: float, pair: Pair) -> Triple:
    """Return the predictor gain of :class:`~twostage_servo.control.observer.DisturbanceObserver` for three poles.

    For ``A_o`` of equation (25) with a disturbance that persists, ``det(zI - A_o + L C)`` is
    ``(z - 1)(z - a22)(z - 1 + L1) + a12 L2 (z - 1) + (b1 (z - a22) + a12 b2) L3``; at z = 1 only L3 is left, since
    ``b1 (1 - a22) + a12 b2 = b2 T``, at z = a22 only L2 beside it, and the coefficient of z² holds L1.
    """
    a12, a22, b2 = plant.a12, plant.a22, plant.b2
    l3 = (1.0 - single) * pair.at(1.0) / (b2 * plant.period_s)
    l2 = (a12 * b2 * l3 - (a22 - single) * pair.at(a22)) / (a12 * (1.0 - a22))
    l1 = 2.0 + a22 - single - 2.0 * pair.real
    return l1, l2, l3


def feedback_gains(plant: DiscretePlant, pair: Pair) -> tuple[float, float]:
    """Return f1 and f2 of ``u = -f1 x1 - f2 x2``, in effort unit per axis unit and per axis unit/s, for two poles."""
    f1 = pair.at(1.0) / (plant.b2 * plant.period_s)
    f2 = (1.0 + plant.a22 - plant.b1 * f1 - 2.0 * pair.real) / plant.b2
    return f1, f2
