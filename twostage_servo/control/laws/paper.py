"""The two-stage law: constant speed until the change-over distance remains, then position control; equations (29)-(34).

The effort is ``u = I - f12 x2`` in the speed stage and ``u = I - f12 x2 - f11 (x1 + M)`` in the position stage, where
x1, x2 are the observer's position and velocity. One sum I runs through both stages: it adds up ``f22 (v - x2)`` in the
first and ``f22 (r - y)`` in the second (erratum 10).

The change-over sets ``M = -x1`` at its own tick, so both forms give the same effort there to the last bit (erratum 12).
It happens at the distance at which the position stage asks for no change of effort at the present speed, equation (19),
so the ticks after it continue as smoothly.

A stop is not in the paper. Its two stages would take the change-over distance to come to rest, however steep the ramp:
the sum has to run off first. So a stop has a stage of its own. The reference ramps down, the model says which effort
follows it, the observer's disturbance is cancelled, and the velocity error is fed back:
``u = (w(k+1) - a22 w(k)) / b2 - x3 + f_b (w(k) - x2)``, with w the ramped reference.

The ramp ends gradually: no step takes more than a share of the speed that is left. A plant that answers by 30 % more,
or with a period of delay more, would otherwise reverse by a whole step of a steep ramp. And the part of the disturbance
that goes with the speed, such as friction that the model does not have, falls with the speed: an observer that takes it
for a constant would drive the axis backwards by what it held against that friction.
"""

import enum
from math import copysign, inf, isfinite, isinf, sqrt

from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.optimal import ServoGains
from twostage_servo.control.plant import DiscretePlant

BRAKING_SHARE = 0.3
"""Share of the velocity error that a stop takes away in a period, f_b b2: stable for half to twice the model's gain or
pole, and with a period of delay more."""

ENDING_SHARE = 0.25
"""Largest share of its speed that a stop takes away in 10 ms or a period, whichever is longer: what is under way when a
sample shows that speed does not reverse a plant with 30 % more gain, or with a period of delay more."""

_ENDING_S = 0.01
"""The time that :data:`ENDING_SHARE` is for, in s."""

REST_TICKS = 3
"""Periods for which the speed has to be low before a stop is done: one may be the estimate's own noise."""

SPEED_TOLERANCE = 0.1
"""Share of the cruise velocity by which the axis may be too fast to enter the position stage for a new set-point."""


def ending_share(period_s: float) -> float:
    """Return the largest share of its speed that a stop takes away in a period (s); see :data:`ENDING_SHARE`."""
    kept: float = (1.0 - ENDING_SHARE) ** min(1.0, period_s / _ENDING_S)
    return 1.0 - kept


class Stage(enum.IntEnum):
    """Which of the two stages makes the effort, or that a stop does."""

    SPEED = 1
    POSITION = 2
    BRAKE = 3


_POSITION, _BRAKE = Stage.POSITION, Stage.BRAKE
"""Looked up once: a member of an enumeration takes a twentieth of the whole step each time."""


def braking_gain(plant: DiscretePlant) -> float:
    """Return f_b, the effort per velocity error of a stop, in effort unit s/axis unit."""
    return BRAKING_SHARE / plant.b2


class TwoStageLaw:
    """One axis' law with its observer; :meth:`step` turns a position sample into an effort.

    Parameters
    ----------
    observer
        Estimates position and velocity; owned by the law from here on.
    gains
        f11, f12, f22.
    period_s
        T_s in s.
    acceleration_limit
        Largest slope of the speed reference, in axis unit/s²; infinity for the paper's step.
    effort_limit
        Largest magnitude of the effort, in effort unit; infinity for none. What the limit cuts off is taken back out of
        the sum (back-calculation), so nothing winds up.
    effort_rate_limit
        Largest change of the effort in effort unit/s; infinity for none. Taken back out of the sum likewise.
    rest_velocity
        Speed in axis unit/s at or below which a stop counts as done.

    Attributes
    ----------
    stage
        The stage that made the last effort.
    effort
        The last effort, in effort unit.
    target, cruise_velocity
        The set-point r in axis unit and the magnitude of its velocity v in axis unit/s.
    speed_reference
        The velocity that the speed stage, or a stop, asks for now, ramped, in axis unit/s.
    saturated
        Whether the effort limit cut the last effort.
    changeovers
        Number of changes from the speed to the position stage so far.
    sample_age
        1: :meth:`step` takes the sample of the period before (see :class:`~twostage_servo.control.laws.law.Law`).
    """

    __slots__ = (
        "_braking", "_braking_gain", "_changeover_time", "_direction", "_ending_share", "_f11", "_f12", "_f22",
        "_friction", "_largest_step", "_offset", "_ramp", "_ramp_limit", "_rest_velocity", "_smallest_step", "_sum",
        "_ticks_at_rest", "changeovers", "cruise_velocity", "effort", "effort_limit", "observer", "period_s",
        "saturated", "speed_reference", "stage", "target",
    )  # fmt: skip
    sample_age = 1
    _STATE = (
        "stage", "target", "cruise_velocity", "speed_reference", "effort", "saturated",
        "_sum", "_offset", "_ramp", "_braking", "_ending_share", "_friction", "_ticks_at_rest", "_direction",
    )  # fmt: skip

    def __init__(
        self,
        observer: DisturbanceObserver,
        gains: ServoGains,
        period_s: float,
        *,
        acceleration_limit: float = inf,
        effort_limit: float = inf,
        effort_rate_limit: float = inf,
        rest_velocity: float = 0.0,
    ) -> None:
        self.observer = observer
        self.period_s = period_s
        self.effort_limit = effort_limit
        self._f11, self._f12, self._f22 = gains.f11, gains.f12, gains.f22
        self._braking_gain = braking_gain(observer.plant)
        self._largest_step = effort_rate_limit * period_s
        self._rest_velocity = rest_velocity
        self._smallest_step = ending_share(period_s) * rest_velocity  # or it would never end
        self._changeover_time = gains.changeover_time_s(period_s)
        self._ramp_limit = acceleration_limit * period_s
        self.changeovers = 0
        self.start()

    def start(self) -> None:
        """Hold the estimated position, beginning with no effort; the observer has been tracking it until now."""
        position = self.observer.position
        self.stage = Stage.POSITION
        self.target = position
        self.cruise_velocity = self.speed_reference = 0.0
        self.effort = self._sum = self._friction = 0.0
        self.saturated = self._braking = False
        self._ramp = self._ramp_limit
        self._offset = -position
        self._ending_share = self._direction = 1.0
        self._ticks_at_rest = 0

    @property
    def velocity(self) -> float:
        """Estimated velocity that the last effort was made with, in axis unit/s."""
        return self.observer.velocity

    @property
    def distance(self) -> float:
        """Distance from the estimated position to the set-point, in axis unit, never negative."""
        return abs(self.target - self.observer.position)

    def set_target(self, target: float, velocity: float) -> None:
        """Take a new set-point, at rest or in mid-move; the effort stays continuous.

        The axis goes through the speed stage, unless the set-point lies within the change-over distance of `velocity`.
        A set-point too near for the present speed, or behind, is met by braking or turning in the speed stage first.

        Parameters
        ----------
        target
            Set-point r, in axis unit.
        velocity
            Magnitude of the cruise velocity v, in axis unit/s, greater than 0.
        """
        offset = target - self.observer.position
        self._direction = direction = copysign(1.0, offset)
        distance = direction * offset
        approach = direction * self.observer.velocity
        tolerance = SPEED_TOLERANCE * velocity
        self.target = target
        self.cruise_velocity = velocity
        self._ramp = self._ramp_limit
        near = distance <= velocity * self._changeover_time
        self._braking = approach > distance / self._changeover_time + tolerance
        if near and not self._braking and approach >= -tolerance:
            if self.stage is not Stage.POSITION:
                self._enter_position_stage(self.effort)
        elif self.stage is not Stage.SPEED:
            self._enter_speed_stage()

    def stop(self, deceleration: float, friction: float = 0.0, *, gradual: bool = False) -> None:
        """Bring the axis to rest, then hold where it comes to rest.

        Parameters
        ----------
        deceleration
            Slope of the speed reference, in axis unit/s².
        friction
            By how much the disturbance changes with the speed, in effort unit s/axis unit: what the model's own
            friction lacks, or has too much of. The observer's disturbance holds it at the present speed.
        gradual
            Whether the ramp ends by :func:`ending_share` of the speed in a period. Where no sample corrects the model,
            that would only cost distance: what a plant off its model does then, a gradual end does not change.
        """
        if self.stage is not Stage.BRAKE:
            self.stage = Stage.BRAKE
            self.speed_reference = self.observer.velocity
            self._ticks_at_rest = 0
        self._ramp = deceleration * self.period_s
        self._friction = friction
        self._ending_share = ending_share(self.period_s) if gradual else 1.0

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower, as after homing; nothing moves."""
        self.observer.position += distance
        self.target += distance
        self._offset -= distance

    def step(self, sample: float | None) -> float:
        """Take the sample that the drive made when the last effort left, ``y(k-1)``; return the effort ``u(k)``.

        Parameters
        ----------
        sample
            Measured position in axis unit; finite. None if there is none, or none to be believed: the model has to do.

        Returns
        -------
        float
            The effort in effort unit, within the effort limit.
        """
        observer = self.observer
        if sample is None:
            sample = observer.position
        if self.stage is _BRAKE:
            before = observer.velocity
            observer.update(sample, self.effort)
            observer.disturbance += self._friction * (observer.velocity - before)
            self.effort = self._braking_effort()
            return self.effort
        observer.update(sample, self.effort)
        velocity = observer.velocity
        if self.stage is _POSITION:
            self._sum += self._f22 * (self.target - sample)
            effort = self._sum - self._f12 * velocity - self._f11 * (observer.position + self._offset)
        else:
            effort = self._sum - self._f12 * velocity
            if self._speed_stage_ends():
                self._enter_position_stage(effort)
            else:
                reference = self.speed_reference
                if self._braking or reference != self._direction * self.cruise_velocity:
                    reference = self._ramped_reference()
                self._sum += self._f22 * (reference - velocity)
        limit, step = self.effort_limit, self._largest_step
        if -limit <= effort <= limit and -step <= effort - self.effort <= step:  # within both: a call less each tick
            self.saturated = False
            self.effort = effort
            return effort
        self.effort = limited = self._limited(effort)
        if limited != effort:
            self._sum += limited - effort
        return limited

    def skip(self, periods: int) -> None:
        """Account for periods in which no step was made: the last effort acted on, unseen."""
        for _ in range(periods):
            self.observer.predict(self.effort)

    def continue_from(self, other: "TwoStageLaw") -> None:
        """Take over the whole state of another law of the same axis, its estimate included."""
        self.observer.continue_from(other.observer)
        for name in self._STATE:
            setattr(self, name, getattr(other, name))

    def _limited(self, effort: float) -> float:
        """Hold the effort within its limit and its rate; what is no number stays none, for others to see."""
        if not isfinite(effort):
            return effort
        limit = self.effort_limit
        self.saturated = not -limit <= effort <= limit
        if self.saturated:
            effort = limit if effort > 0.0 else -limit
        step = effort - self.effort
        if abs(step) > self._largest_step:
            effort = self.effort + copysign(self._largest_step, step)
        return effort

    def _braking_effort(self) -> float:
        """Follow the ramp down; at rest, go over to holding the place."""
        observer, now, ramp = self.observer, self.speed_reference, self._ramp
        velocity = observer.velocity
        self._ticks_at_rest = self._ticks_at_rest + 1 if now == 0.0 and abs(velocity) <= self._rest_velocity else 0
        if self._ticks_at_rest >= REST_TICKS:
            # Where the position stage would come to rest from here: equation (19) read backwards.
            self.target = observer.position + self._changeover_time * velocity
            # Braking is over: what it took gives way to what holds against the load.
            effort = self._limited(-observer.disturbance)
            self._enter_position_stage(effort)
            return effort
        plant = observer.plant
        step = min(ramp, self._steepest_step(abs(now)), max(self._ending_share * abs(now), self._smallest_step))
        ahead = 0.0 if abs(now) <= step else now - copysign(step, now)
        wanted = (ahead - plant.a22 * now) / plant.b2 - observer.disturbance + self._braking_gain * (now - velocity)
        effort = self._limited(wanted)
        if effort != wanted:
            # What the limits withhold is not made up for later: the ramp goes on from the speed that will be reached.
            reached = plant.a22 * velocity + plant.b2 * (effort + observer.disturbance)
            if abs(reached) > abs(ahead) and reached * now > 0.0:
                ahead = reached
        self.speed_reference = ahead
        return effort

    def _steepest_step(self, speed: float) -> float:
        """Return the change of speed in a period from which the effort's rate still gets back to no braking at rest.

        If each step is smaller by r than the one before, a step s and all after it take ``s + s (s - r) / 2r`` away.
        """
        rate = self._largest_step * abs(self.observer.plant.b2)
        if isinf(rate):
            return inf
        if speed <= rate:  # all of it in one step; the formula says so too, but for what its difference cancels
            return speed
        return sqrt(0.25 * rate * rate + 2.0 * rate * speed) - 0.5 * rate

    def _speed_stage_ends(self) -> bool:
        """Decide the change-over from the estimate of this very tick."""
        offset = self.target - self.observer.position
        direction = copysign(1.0, offset)
        if direction != self._direction:  # passed the set-point while braking: turn round
            self._direction = direction
            self._braking = False
        distance = direction * offset
        if self._braking:
            return direction * self.observer.velocity * self._changeover_time <= distance
        return 0.0 < distance <= direction * self.speed_reference * self._changeover_time

    def _ramped_reference(self) -> float:
        """Move the speed reference towards its goal by at most the acceleration limit; return it."""
        goal = 0.0 if self._braking else self._direction * self.cruise_velocity
        change = goal - self.speed_reference
        if abs(change) > self._ramp:
            goal = self.speed_reference + copysign(self._ramp, change)
        self.speed_reference = goal
        return goal

    def _enter_position_stage(self, effort: float) -> None:
        """Take the position stage's sum so that it gives this effort at the present estimate."""
        self._offset = -self.observer.position
        self._sum = effort + self._f12 * self.observer.velocity
        self.stage = Stage.POSITION
        self.speed_reference = 0.0
        self.changeovers += 1

    def _enter_speed_stage(self) -> None:
        """Take the speed stage's sum so that it goes on from the last effort."""
        self._sum = self.effort + self._f12 * self.observer.velocity
        self.speed_reference = self.observer.velocity
        self.stage = Stage.SPEED
