"""A stop: the speed goes down a ramp. What it will take is in :mod:`twostage_servo.control.laws.stop_design`.

The reference ramps down, the model says which effort follows it, the observer's disturbance is cancelled, and the
velocity error is fed back: ``u = (w(k+1) - a22 w(k)) / b2 - x3 + f_b (w(k) - x2)``, with w the ramped reference.

The ramp ends gradually: no step takes more than a share of the speed that is left. A plant that answers by 30 % more,
or with a period of delay more, would otherwise reverse by a whole step of a steep ramp. And the part of the disturbance
that goes with the speed, such as friction that the model does not have, falls with the speed: an observer that takes it
for a constant would drive the axis backwards by what it held against that friction.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import copysign, inf, isinf, sqrt

from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.per_time import NOMINAL_S, samples_in, share_in
from twostage_servo.control.plant import DiscretePlant

BRAKING_SHARE = 0.3
"""Share of the velocity error that a stop takes away in 10 ms or a period, whichever is longer, f_b b2: stable for half
to twice the model's gain or pole, and with a period of delay more."""

ENDING_SHARE = 0.25
"""Largest share of its speed that a stop takes away in 10 ms or a period, whichever is longer: what is under way when a
sample shows that speed does not reverse a plant with 30 % more gain, or with a period of delay more."""

SMOOTH_SHARE = 0.85
"""Share of the jerk that the end of a smooth stop is planned with: between two ticks it takes up to an eighth more."""

REST_TICKS = 3
"""Samples by which the speed has to be low before a stop is done: one may be the estimate's own noise."""

REST_S = 0.03
"""Time for which it has to be low, in s, where those come sooner."""


def ending_share(period_s: float) -> float:
    """Return the largest share of its speed that a stop takes away in a period (s); see :data:`ENDING_SHARE`."""
    kept: float = (1.0 - ENDING_SHARE) ** min(1.0, period_s / NOMINAL_S)
    return 1.0 - kept


def braking_gain(plant: DiscretePlant) -> float:
    """Return f_b, the effort per velocity error of a stop, in effort unit s/axis unit."""
    return share_in(BRAKING_SHARE, min(NOMINAL_S, plant.period_s)) / plant.b2


@dataclass(slots=True)
class StopState:
    """Where a stop stands.

    Attributes
    ----------
    speed_reference
        The velocity that the ramp asks for now, in axis unit/s.
    ramp
        Largest step of the ramp in a period, in axis unit/s.
    friction
        By how much the disturbance changes with the speed, in effort unit s/axis unit.
    ending_share
        Largest share of the speed that a step takes.
    jerk_step
        By how much a step of the ramp may exceed the one before, and be less, in axis unit/s; infinity for any.
    step
        The last one, in axis unit/s: what the speed has become lower by.
    ticks_at_rest
        Periods in a row, up to now, in which the speed was low.
    """

    speed_reference: float = 0.0
    ramp: float = 0.0
    friction: float = 0.0
    ending_share: float = 1.0
    jerk_step: float = inf
    step: float = 0.0
    ticks_at_rest: int = 0


class Stop:
    """The brake stage of a law.

    Parameters
    ----------
    plant
        The sampled model.
    period_s
        T_s in s.
    effort_rate_limit
        Largest change of the effort in effort unit/s; infinity for none.
    rest_velocity
        Speed in axis unit/s at or below which a stop counts as done.

    Attributes
    ----------
    state
        Where it stands.
    """

    __slots__ = (
        "_braking_gain",
        "_period_s",
        "_plant",
        "_rate",
        "_rest_ticks",
        "_rest_velocity",
        "_smallest_step",
        "state",
    )

    def __init__(
        self, plant: DiscretePlant, period_s: float, *, effort_rate_limit: float = inf, rest_velocity: float = 0.0
    ) -> None:
        self._plant = plant
        self._period_s = period_s
        self._braking_gain = braking_gain(plant)
        self._rest_ticks = samples_in(REST_S, period_s, REST_TICKS)
        self._rate = effort_rate_limit * period_s * abs(plant.b2)  # of the ramp's steps, from one to the next
        self._rest_velocity = rest_velocity
        self._smallest_step = ending_share(period_s) * rest_velocity  # or it would never end
        self.state = StopState()

    def begin(self, velocity: float, slope: float = 0.0) -> None:
        """Begin at an estimated velocity, and its change in the last period (both in axis unit/s)."""
        self.state.speed_reference = velocity
        self.state.step = -slope if velocity >= 0.0 else slope
        self.state.ticks_at_rest = 0

    @property
    def slope(self) -> float:
        """By how much the reference has changed in the last period, in axis unit/s."""
        state = self.state
        return -state.step if state.speed_reference >= 0.0 else state.step

    def resume_at(self, velocity: float) -> None:
        """Go on from another estimated velocity, in axis unit/s."""
        self.state.speed_reference = velocity

    def aim(self, deceleration: float, friction: float, *, gradual: bool, jerk: float = inf) -> None:
        """Set the slope of the ramp, the friction and the end, as in :meth:`~.law.Law.stop`; also in mid-stop.

        Parameters
        ----------
        deceleration, friction, gradual
            As there.
        jerk
            Largest slope of the deceleration, in axis unit/s³; infinity for none.
        """
        state = self.state
        state.ramp = deceleration * self._period_s
        state.friction = friction
        state.ending_share = ending_share(self._period_s) if gradual else 1.0
        state.jerk_step = jerk * self._period_s**2

    def update(self, observer: DisturbanceObserver, sample: float, effort: float) -> None:
        """Give the observer a sample (axis unit) and the effort that acted; its friction goes with the speed."""
        before = observer.velocity
        observer.update(sample, effort)
        now = observer.velocity
        observer.correct(now, observer.disturbance + self.state.friction * (now - before))

    def is_over(self, velocity: float) -> bool:
        """Whether the axis has come to rest, by an estimated velocity in axis unit/s; asked once a period."""
        state = self.state
        at_rest = state.speed_reference == 0.0 and abs(velocity) <= self._rest_velocity
        state.ticks_at_rest = state.ticks_at_rest + 1 if at_rest else 0
        return state.ticks_at_rest >= self._rest_ticks

    def step(self, observer: DisturbanceObserver, limited: Callable[[float], float]) -> float:
        """Follow the ramp down by a period, and return the effort.

        Parameters
        ----------
        observer
            The estimate.
        limited
            Returns an effort within the law's limits.
        """
        state, plant, velocity = self.state, self._plant, observer.velocity
        now = state.speed_reference
        if isinf(state.jerk_step):
            least = max(state.ending_share * abs(now), self._smallest_step)
            step = min(state.ramp, self._steepest_step(abs(now)), least)
        else:
            step = self._smooth_step(abs(now))
        ahead = 0.0 if abs(now) <= step else now - step * copysign(1.0, now)
        wanted = (ahead - plant.a22 * now) / plant.b2 - observer.disturbance + self._braking_gain * (now - velocity)
        effort = limited(wanted)
        if effort != wanted:
            # What the limits withhold is not made up for later: the ramp goes on from the speed that will be reached.
            reached = plant.a22 * velocity + plant.b2 * (effort + observer.disturbance)
            if abs(reached) > abs(ahead) and reached * now > 0.0:
                ahead = reached
        state.step = abs(now) - abs(ahead)
        state.speed_reference = ahead
        return effort

    def continue_from(self, other: "Stop") -> None:
        """Go on as another stop on the same plant."""
        self.state = replace(other.state)

    def _steepest_step(self, speed: float) -> float:
        """Return the change of speed in a period from which the effort's rate still gets back to no braking at rest.

        If each step is smaller by r than the one before, a step s and all after it take ``s + s (s - r) / 2r`` away.
        """
        rate = self._rate
        if isinf(rate):
            return inf
        if speed <= rate:  # all of it in one step; the formula says so too, but for what its difference cancels
            return speed
        return sqrt(0.25 * rate * rate + 2.0 * rate * speed) - 0.5 * rate

    def _smooth_step(self, speed: float) -> float:
        """Return the change of speed in a period of a stop with limited jerk; below zero where it still gains speed.

        Each step differs from the one before by r at most. The gradual end takes a share s of the speed in a period,
        and its steps become smaller by ``s² v``: it may begin at ``v0 = r/s²`` with a step of ``r/s``. Before it, steps
        that become smaller by r end with that one there, as in :meth:`_steepest_step`.
        """
        state = self.state
        most, share = min(state.jerk_step, self._rate), state.ending_share
        r = SMOOTH_SHARE * most
        ending = r / (share * share)
        if speed <= ending:
            steepest = max(share * speed, min(self._smallest_step, r))
        else:
            first = r / share + 0.5 * r
            steepest = sqrt(first * first + 2.0 * r * (speed - ending)) - 0.5 * r
        step = min(max(min(state.ramp, steepest), state.step - most), state.step + most)
        return min(step, speed)
