"""A speed reference of limited jerk: how it changes from tick to tick, and the braking that follows it.

The slope of the reference changes by at most ``r = j T²`` from one tick to the next (less where the effort's rate
allows less), with j the jerk. On the way to a speed the slope rises by r a tick, and falls by r a tick so that both
end together: an S-curve that is found anew in every tick, from whatever speed and slope the reference has.

Braking ends at a place. First the slope runs out to none, by r a tick; then the braking reference of :mod:`.reference`
falls by ``A T`` a tick, averaged over ``A T / r`` ticks, which need not be whole: an average over a time ``A / j``
makes an S-curve of a ramp (L. Biagiotti, C. Melchiorri, *Trajectory Planning for Automatic Machines and Robots*, 2008,
section 4.5), and its way is known exactly.
"""

from math import ceil, copysign, floor, sqrt
from typing import Final, NamedTuple

from twostage_servo.control.laws.adaptive.reference import RATE_SHARE, Ways
from twostage_servo.control.laws.law import ControlTask

BRAKING_SHARE: Final = 0.9
"""Share of the jerk that a braking is planned with: one that begins a little late is steeper by the rest."""

_HALVINGS: Final = 40
"""Steps in which the top speed of a short move is found."""

_WHOLE: Final = 1e-9
"""Part of a tick that is none."""


class Smoothing:
    """What limits the jerk of a speed reference.

    Parameters
    ----------
    task
        Its jerk is finite.
    """

    __slots__ = ("_effort_step", "_most", "_planned")

    def __init__(self, task: ControlTask) -> None:
        self._most = task.jerk * task.period_s**2
        self._effort_step = RATE_SHARE * task.effort_rate_limit * task.period_s**2
        self._planned = self.step(task.plant.gain) / task.period_s**2

    def step(self, gain: float) -> float:
        """Return r, by how much the slope may change in a tick, in axis unit/s.

        Parameters
        ----------
        gain
            Of the plant, in axis unit/s² per effort unit.
        """
        return min(self._most, abs(gain) * self._effort_step)

    def deceleration(self, speed: float, slope: float, step: float, most: float, period_s: float) -> float:
        """Return the deceleration with which braking takes the least time, in axis unit/s².

        From a top speed v it takes ``v/A + A/j``: least where A² is j v.

        Parameters
        ----------
        speed, slope
            Of the reference, and its change in a tick, in axis unit/s: the top is where this has run out.
        step
            r, in axis unit/s.
        most
            Largest deceleration, in axis unit/s².
        period_s
            The tick, in s.
        """
        step *= BRAKING_SHARE
        top = max(speed, 0.0) + slope * slope / (2.0 * step)
        return min(most, max(sqrt(step * top), step) / period_s)

    def change_s(self, speed: float, most: float, *, braking: bool) -> float:
        """Return how long a change of speed (axis unit/s) takes, in s, with at most an acceleration (axis unit/s²).

        The S-curve has half of the change as its average: so it goes half of `speed` times this way from or to rest.
        """
        jerk = self._planned * BRAKING_SHARE if braking else self._planned
        return speed / most + most / jerk if speed * jerk >= most * most else 2.0 * sqrt(speed / jerk)

    def move_s(self, distance: float, velocity: float, rising: float, braking: float) -> float:
        """Return how long a move from rest to rest takes, in s: rise, cruise and braking of the reference.

        Parameters
        ----------
        distance, velocity
            Its length, not negative, and its cruise velocity, in axis unit and axis unit/s.
        rising, braking
            Largest acceleration and deceleration, in axis unit/s².
        """

        def changes_s(speed: float) -> float:
            return self.change_s(speed, rising, braking=False) + self.change_s(speed, braking, braking=True)

        low, top = 0.0, velocity
        if 0.5 * velocity * changes_s(velocity) > distance:  # a short move has no cruise
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + top)
                low, top = (low, middle) if 0.5 * middle * changes_s(middle) > distance else (middle, top)
            return changes_s(top)
        return distance / velocity + 0.5 * changes_s(velocity)


def next_slope(slope: float, left: float, most: float, step: float) -> float:
    """Return the slope of an S-curve for the next tick.

    Slopes that become smaller by r each add up to what is left of the speed in whole ticks and a part; it is the
    largest of those, as near as r allows.

    Parameters
    ----------
    slope
        Change of the speed in the last tick, in axis unit/s.
    left
        What is left to the speed that is to be reached, in axis unit/s.
    most, step
        Largest slope, and r, in axis unit/s.
    """
    ticks = floor(0.5 * (sqrt(1.0 + 8.0 * abs(left) / step) - 1.0))
    wanted = copysign(min(most, abs(left) / (ticks + 1.0) + 0.5 * step * ticks), left)
    return min(max(wanted, slope - step), slope + step)


class SmoothShape(NamedTuple):
    """A braking of limited jerk, as it may begin; see the module.

    Attributes
    ----------
    ahead, slope
        The reference a tick ahead, and its change to there, in axis unit/s.
    step
        r, in axis unit/s.
    runs
        Ticks in which the slope runs out.
    fall
        ``A T``, in axis unit/s.
    fallen
        Ticks for which the unaveraged reference has fallen already: its average has the slope that there is.
    speed
        Before the average, in axis unit/s: the newest tap.
    length
        Of the average, in ticks.
    way
        How far the axis goes while the slope and then the taps run out, beyond what the unaveraged reference does, in
        axis unit.
    """

    ahead: float
    slope: float
    step: float
    runs: int
    fall: float
    fallen: float
    speed: float
    length: float
    way: float

    @classmethod
    def at(cls, ahead: float, slope: float, deceleration: float, step: float, ways: Ways) -> "SmoothShape":
        """Return the shape with which a reference may begin to brake.

        Parameters
        ----------
        ahead, slope, step
            As the attributes.
        deceleration
            A, in axis unit/s².
        ways
            Of the plant.
        """
        period_s = ways.period_s
        runs = max(0, ceil(slope / step - _WHOLE))
        # The speeds ``v_i = ahead + i slope - r i (i+1)/2``; the last tick has no slope left.
        rises = runs - 1 if runs else 0
        top = ahead + rises * slope - 0.5 * step * rises * (rises + 1)
        sum_before = runs * ahead + slope * runs * rises / 2 - step * rises * runs * (runs + 1) / 6
        runout = period_s * sum_before + ways.alpha * (top - ahead)
        planned = BRAKING_SHARE * step
        fall = max(deceleration * period_s, -slope, planned)
        length = fall / planned
        fallen = max(0.0, -slope / planned)
        # Tap i is ``newest + fall m(i)`` with m(i) = min(i, fallen), and comes i ticks later: until then it goes
        # ``alpha tap_j + beta tap_(j+1)`` for each j < i. With P(i) the sum of m before i, R(i) that of P:
        whole = ceil(length - _WHOLE) - 1
        last = length - whole
        mean = (_first_sum(whole, fallen) + last * min(whole, fallen)) / length
        newest = top - fall * mean
        indices = whole * (whole - 1) / 2 + last * whole
        twice = _second_sum(whole, fallen) + last * _first_sum(whole, fallen)
        taps_way = (period_s * (newest * indices + fall * twice)) / length + ways.beta * fall * mean
        return cls(ahead, slope, step, runs, fall, fallen, newest, length, runout + taps_way)

    def lead(self) -> list[float]:
        """Return the speeds until the slope has run out, the first one first."""
        speeds, speed, slope = [], self.ahead, self.slope
        for _ in range(self.runs):
            slope = max(0.0, slope - self.step)
            speed += slope
            speeds.append(speed)
        return speeds

    def history(self) -> list[float]:
        """Return the taps of the average where the slope has run out, the newest first, in axis unit/s."""
        taps = ceil(self.length - _WHOLE)
        return [self.speed + self.fall * min(index, self.fallen) for index in range(taps)]

    @property
    def last_weight(self) -> float:
        """Weight of the oldest tap, as a share of that of any other."""
        return self.length - (ceil(self.length - _WHOLE) - 1)


def _first_sum(count: int, most: float) -> float:
    """Return the sum of min(i, most) over i < count."""
    below = min(count, floor(most) + 1)
    return below * (below - 1) / 2 + (count - below) * most


def _second_sum(count: int, most: float) -> float:
    """Return the sum of :func:`_first_sum` over i < count."""
    below = min(count, floor(most) + 2)
    above = count - below
    first = below * (below - 1) * (below - 2) / 6
    return first + above * _first_sum(below, most) + most * above * (above - 1) / 2
