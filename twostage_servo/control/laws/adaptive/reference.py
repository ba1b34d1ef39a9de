"""The speed reference that comes to rest on the set-point in whole ticks.

All is counted forward, in the direction of the move. A reference whose speed falls by ``A T`` a tick from v+ comes to
rest exactly n ticks and a part later; :func:`next_speed` is the largest v+ from which it does within the way that is
left. A moving average over m ticks then spreads the step of the effort at either end of the braking, so that the
effort's rate allows it; its taps are part of the way.

In a tick the plant goes ``alpha v+ + beta v``, with ``alpha = b1/b2`` and ``beta = T - alpha``, while its speed goes
from v to v+ at a constant effort.
"""

from math import ceil, floor, sqrt
from typing import NamedTuple

from twostage_servo.control.plant import DiscretePlant

_MOST_TAPS = 400
"""Longest average: it bounds the work of a tick where the effort's rate is low."""

_RATE_SHARE = 0.75
"""Share of the effort's rate that the reference uses; the rest is the feedback's."""


class Ways(NamedTuple):
    """What a tick's way is made of: ``alpha v+ + beta v``.

    Attributes
    ----------
    alpha, beta
        Of the speed at its end and at its start, in s.
    period_s
        The tick, in s.
    """

    alpha: float
    beta: float
    period_s: float

    @classmethod
    def of(cls, plant: DiscretePlant) -> "Ways":
        """Return those of a sampled plant."""
        alpha = plant.b1 / plant.b2
        return cls(alpha, plant.period_s - alpha, plant.period_s)


def next_speed(way: float, speed: float, deceleration: float, ways: Ways) -> float:
    """Return the largest speed a tick ahead from which an axis still comes to rest within a way.

    Parameters
    ----------
    way
        That is left, in axis unit.
    speed
        Now, in axis unit/s.
    deceleration
        In axis unit/s².
    ways
        Of the plant.
    """
    ahead = (way - ways.beta * speed) / ways.period_s
    if ahead <= 0.0:
        return 0.0
    step = deceleration * ways.period_s
    ticks = floor(0.5 * (sqrt(1.0 + 8.0 * ahead / step) - 1.0))
    return ahead / (ticks + 1.0) + 0.5 * step * ticks


class Shape(NamedTuple):
    """The moving average, as it stands at a speed.

    Attributes
    ----------
    rise
        By how much the reference rises in a tick, in axis unit/s.
    speed
        Before the average, in axis unit/s: the newest tap.
    taps
        How many it has.
    way
        How far the axis goes while the taps run out, beyond what the unaveraged reference does, in axis unit.
    """

    rise: float
    speed: float
    taps: int
    way: float

    @classmethod
    def at(
        cls, ahead: float, speed: float, goal: float, deceleration: float, gain: float, effort_step: float, ways: Ways
    ) -> "Shape":
        """Return the shape with which a reference may begin to brake.

        Parameters
        ----------
        ahead, speed
            Of the reference a tick ahead and now, in axis unit/s.
        goal
            At which it would rise no further, in axis unit/s.
        deceleration
            In axis unit/s².
        gain
            Magnitude of the plant's gain, in axis unit/s² per effort unit.
        effort_step
            Largest change of the effort in a tick, in effort unit.
        ways
            Of the plant.
        """
        period_s = ways.period_s
        rise = max(0.0, ahead - speed) if ahead < goal else 0.0
        swing = (deceleration * period_s + rise) / (gain * period_s)
        taps = min(max(2, ceil(swing / (_RATE_SHARE * effort_step))), _MOST_TAPS)
        newest = ahead + 0.5 * rise * (taps - 1)
        # Sum of ``alpha (newest - j rise) + beta (newest - (j + 1) rise)`` over j < i < m: tap i comes i ticks later.
        once = taps * (taps - 1) / 2
        twice = once * (taps - 2) / 3
        way = period_s * newest * once - rise * (period_s * twice + ways.beta * once)
        return cls(rise, newest, taps, way / taps)


class Braking:
    """The reference after the change-over.

    Parameters
    ----------
    shape
        Of the average at the change-over.
    left
        Way that is left to the unaveraged reference, in axis unit.
    deceleration
        In axis unit/s².

    Attributes
    ----------
    done
        Whether it has come to rest.
    """

    __slots__ = ("_deceleration", "_left", "_raw", "_taps", "done")

    def __init__(self, shape: Shape, left: float, deceleration: float) -> None:
        self._raw, self._left, self._deceleration = shape.speed, left, deceleration
        self._taps = [shape.speed - index * shape.rise for index in range(shape.taps)]
        self.done = False

    def __copy__(self) -> "Braking":
        """Return one that goes on by itself from where this one is."""
        other = Braking(Shape(0.0, self._raw, 0, 0.0), self._left, self._deceleration)
        other.resume(self._taps, done=self.done)
        return other

    def resume(self, taps: list[float], *, done: bool) -> None:
        """Go on with these taps, in axis unit/s."""
        self._taps, self.done = list(taps), done

    def advance(self, ways: Ways) -> float:
        """Return the averaged speed a tick on, in axis unit/s."""
        ahead = 0.0
        if self._left > 0.0:
            ahead = min(next_speed(self._left, self._raw, self._deceleration, ways), self._raw)
        self._left = self._left - ways.beta * self._raw - ways.alpha * ahead if ahead > 0.0 else 0.0
        self._raw = ahead
        self._taps.insert(0, ahead)
        self._taps.pop()
        speed = sum(self._taps) / len(self._taps)
        self.done = ahead == 0.0 and not any(self._taps)
        return 0.0 if self.done else speed
