"""How long a move takes, from the designed response: what lets several axes arrive together."""

import functools
import math
from bisect import bisect_left

from twostage_servo.axis.design import AxisDesign, DesignError
from twostage_servo.control.laws.paper import Stage, TwoStageLaw

_CRUISE_TIMES = 20.0
"""Change-over times of cruise after which the speed has settled for good."""
_LONGEST_TIMES = 1000.0
"""Change-over times after which a stable design has come to rest in any case."""
_SMALLEST_SHARE = 1e-6
"""Share of the change-over distance below which nobody asks when the position stage gets there."""
_HALVINGS = 60


class MoveDuration:
    """The duration of a move from rest until the position window is entered for good.

    The law is linear within its limits, so one run with unit speed tells all: in the speed stage the axis runs behind
    its reference by a constant time, and in the position stage the distance left is the speed times a function of time.

    Parameters
    ----------
    design
        Gains, observer and settings.

    Raises
    ------
    DesignError
        If the response never comes to rest.
    """

    def __init__(self, design: AxisDesign) -> None:
        self._window = design.settings.window.position
        self._acceleration = design.settings.limits.acceleration
        self._period_s = design.period_s
        self._changeover_s = design.gains.changeover_time_s(design.period_s)
        self._most_ticks = math.ceil(_LONGEST_TIMES * self._changeover_s / design.period_s)
        law = design.build_unlimited_law()
        law.set_target(_CRUISE_TIMES * self._changeover_s, 1.0)
        ticks = 0
        while law.stage is Stage.SPEED and ticks < self._most_ticks:
            law.step(None)
            ticks += 1
        self._lag_s = ticks * design.period_s - law.observer.position
        self._after_cruise = self._settling(law)
        short = design.build_unlimited_law()
        short.set_target(1.0, 2.0 / self._changeover_s)  # within the change-over distance: no speed stage
        self._alone = self._settling(short)

    def duration_s(self, distance: float, velocity: float) -> float:
        """Return how long a move takes, in s.

        Parameters
        ----------
        distance
            Length of the move in axis unit, not negative.
        velocity
            Cruise velocity in axis unit/s, greater than 0.
        """
        if distance <= self._window:
            return 0.0
        cruise = distance - velocity * self._changeover_s
        if cruise <= 0.0:
            return self._enters(self._alone, self._window / distance)
        ramp_s = velocity / (2.0 * self._acceleration)
        return cruise / velocity + self._lag_s + ramp_s + self._enters(self._after_cruise, self._window / velocity)

    def velocity_for(self, distance: float, duration_s: float, fastest: float) -> float:
        """Return the cruise velocity in axis unit/s, `fastest` at most, with which a move takes so long, in s."""
        if distance <= self._window or self.duration_s(distance, fastest) >= duration_s:
            return fastest
        low, high = 0.0, fastest
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if self.duration_s(distance, middle) > duration_s:
                low = middle
            else:
                high = middle
        return high

    def _settling(self, law: TwoStageLaw) -> list[float]:
        """Return how far the axis is from its set-point at most from each tick on, the last one first."""
        largest = abs(law.target - law.observer.position)
        seen = [math.inf]
        while max(seen[-1], abs(law.observer.velocity) * self._changeover_s) > _SMALLEST_SHARE * largest:
            if len(seen) > self._most_ticks:
                raise DesignError(
                    ("axis", "law", "performance_index_ratio"), "the designed response never comes to rest"
                )
            seen.append(abs(law.target - law.observer.position))
            law.step(None)
        worst = 0.0
        later = []
        for value in reversed(seen[1:]):
            worst = max(worst, value)
            later.append(worst)
        return later

    def _enters(self, rising: list[float], share: float) -> float:
        """Return after how many seconds a response stays within a share for good."""
        return self._period_s * (len(rising) - bisect_left(rising, share))


@functools.lru_cache(maxsize=8)
def move_duration(design: AxisDesign) -> MoveDuration:
    """Return the :class:`MoveDuration` of a design, computed once: nothing changes it."""
    return MoveDuration(design)
