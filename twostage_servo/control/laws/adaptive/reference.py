"""The speed reference that comes to rest on the set-point in whole ticks.

All is counted forward, in the direction of the move. A reference whose speed falls by ``A T`` a tick from v+ comes to
rest exactly n ticks and a part later; :func:`next_speed` is the largest v+ from which it does within the way that is
left. A moving average over m ticks then spreads the step of the effort at either end of the braking, so that the
effort's rate allows it; its taps are part of the way.

In a tick the plant goes ``alpha v+ + beta v``, with ``alpha = b1/b2`` and ``beta = T - alpha``, while its speed goes
from v to v+ at a constant effort.
"""

from math import ceil, floor, sqrt
from typing import NamedTuple, Protocol

from twostage_servo.control.plant import DiscretePlant

_MOST_TAPS = 400
"""Longest average: it bounds the work of a tick where the effort's rate is low."""

RATE_SHARE = 0.75
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


class BrakingShape(Protocol):
    """How a braking may begin.

    Attributes
    ----------
    speed
        Before the average, in axis unit/s: the newest tap.
    way
        How far the axis goes beyond what the unaveraged reference does, in axis unit.
    last_weight
        Weight of the oldest tap, as a share of that of any other.
    """

    @property
    def speed(self) -> float: ...  # noqa: D102 - see the class

    @property
    def way(self) -> float: ...  # noqa: D102 - see the class

    @property
    def last_weight(self) -> float: ...  # noqa: D102 - see the class

    def lead(self) -> list[float]:
        """Return the speeds (axis unit/s) before those of the average, the first one first."""

    def history(self) -> list[float]:
        """Return the taps of the average when it begins, the newest first, in axis unit/s."""


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
        taps = min(max(2, ceil(swing / (RATE_SHARE * effort_step))), _MOST_TAPS)
        newest = ahead + 0.5 * rise * (taps - 1)
        # Sum of ``alpha (newest - j rise) + beta (newest - (j + 1) rise)`` over j < i < m: tap i comes i ticks later.
        once = taps * (taps - 1) / 2
        twice = once * (taps - 2) / 3
        way = period_s * newest * once - rise * (period_s * twice + ways.beta * once)
        return cls(rise, newest, taps, way / taps)

    @property
    def last_weight(self) -> float:
        """1: all taps weigh the same."""
        return 1.0

    def lead(self) -> list[float]:
        """Return none: the average begins at once."""
        return []

    def history(self) -> list[float]:
        """Return the taps, the newest first, in axis unit/s."""
        return [self.speed - index * self.rise for index in range(self.taps)]


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

    __slots__ = ("_deceleration", "_last_weight", "_lead", "_left", "_raw", "_taps", "done")

    def __init__(self, shape: BrakingShape, left: float, deceleration: float) -> None:
        self._raw, self._left, self._deceleration = shape.speed, left, deceleration
        self._lead, self._taps, self._last_weight = shape.lead(), shape.history(), shape.last_weight
        self.done = False

    def __copy__(self) -> "Braking":
        """Return one that goes on by itself from where this one is."""
        other = type(self).__new__(type(self))
        other.resume(self)
        return other

    def resume(self, other: "Braking") -> None:
        """Go on where another one is."""
        self._raw, self._left, self._deceleration, self._lead, self._taps, self._last_weight = other.stands()
        self.done = other.done

    def stands(self) -> tuple[float, float, float, list[float], list[float], float]:
        """Return what it goes on from."""
        return self._raw, self._left, self._deceleration, list(self._lead), list(self._taps), self._last_weight

    def advance(self, ways: Ways) -> float:
        """Return the averaged speed a tick on, in axis unit/s."""
        if self._lead:
            return self._lead.pop(0)
        ahead = 0.0
        if self._left > 0.0:
            ahead = min(next_speed(self._left, self._raw, self._deceleration, ways), self._raw)
        self._left = self._left - ways.beta * self._raw - ways.alpha * ahead if ahead > 0.0 else 0.0
        self._raw = ahead
        self._taps.insert(0, ahead)
        self._taps.pop()
        lacks = 1.0 - self._last_weight
        speed = (sum(self._taps) - lacks * self._taps[-1]) / (len(self._taps) - lacks)
        self.done = ahead == 0.0 and not any(self._taps)
        return 0.0 if self.done else speed
