"""The two-stage law: constant speed until the change-over distance remains, then position control; equations (29)-(34).

The effort is ``u = I - f12 x2`` in the speed stage and ``u = I - f12 x2 - f11 (x1 + M)`` in the position stage, where
x1, x2 are the observer's position and velocity. One sum I runs through both stages: it adds up ``f22 (v - x2)`` in the
first and ``f22 (r - y)`` in the second (erratum 10).

The change-over sets ``M = -x1`` at its own tick, so both forms give the same effort there to the last bit (erratum 12).
It happens at the distance at which the position stage asks for no change of effort at the present speed, equation (19),
so the ticks after it continue as smoothly.

A stop is not in the paper. Its two stages would take the change-over distance to come to rest, however steep the ramp:
the sum has to run off first. So a stop has a stage of its own: :mod:`twostage_servo.control.laws.stop`.
"""

from math import copysign, inf
from typing import NamedTuple

from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.stop import Stop
from twostage_servo.control.laws.timing import Timing
from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.optimal import ServoGains

SPEED_TOLERANCE = 0.1
"""Share of the cruise velocity by which the axis may be too fast to enter the position stage for a new set-point."""

_POSITION, _BRAKE = Stage.POSITION, Stage.BRAKE
"""Looked up once: a member of an enumeration takes a twentieth of the whole step each time."""


class Course(NamedTuple):
    """What the law goes on from beside what it tells.

    Attributes
    ----------
    sum
        I, in effort unit.
    offset
        M, in axis unit.
    ramp
        Largest step of the speed reference in a period, in axis unit/s.
    braking
        Whether the speed stage brings the axis to rest first.
    direction
        In which it goes to the set-point, 1 or -1.
    """

    sum: float
    offset: float
    ramp: float
    braking: bool
    direction: float


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
    stop_stage
        The stage that brings the axis to rest.
    sample_age
        1: :meth:`step` takes the sample of the period before.
    """

    __slots__ = (
        "_braking", "_changeover_time", "_direction", "_f11", "_f12", "_f22", "_largest_step", "_late_effort",
        "_offset", "_ramp", "_ramp_limit", "_sum", "changeovers", "cruise_velocity", "effort", "effort_limit",
        "observer", "period_s", "saturated", "speed_reference", "stage", "stop_stage", "target",
    )  # fmt: skip
    sample_age = 1

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
        self._largest_step = effort_rate_limit * period_s
        self.stop_stage = Stop(
            observer.plant, period_s, effort_rate_limit=effort_rate_limit, rest_velocity=rest_velocity
        )
        self._changeover_time = gains.changeover_time_s(period_s)
        self._ramp_limit = acceleration_limit * period_s
        self.changeovers = 0
        self.start()

    def start(self, effort: float = 0.0) -> None:
        """Hold the estimated position, as if it had given `effort` (effort unit) so far.

        The observer has been tracking the axis until now.
        """
        position = self.observer.position
        self.stage = Stage.POSITION
        self.target = position
        self.cruise_velocity = self.speed_reference = 0.0
        self.effort = self._sum = effort
        self._late_effort = 0.0  # what has acted less the last effort, which came late
        self.saturated = self._braking = False
        self._ramp = self._ramp_limit
        self._offset = -position
        self._direction = 1.0

    @property
    def velocity(self) -> float:
        """Estimated velocity that the last effort was made with, in axis unit/s."""
        return self.observer.velocity

    @property
    def distance(self) -> float:
        """Distance from the estimated position to the set-point, in axis unit, never negative."""
        return abs(self.target - self.observer.position)

    def set_target(self, target: float, velocity: float) -> None:
        """Set a new set-point, at rest or in mid-move; the effort stays continuous.

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
            Whether the ramp ends by a share of the speed in a period. Where no sample corrects the model, that would
            only cost distance: what a plant off its model does then, a gradual end does not change.
        """
        if self.stage is not Stage.BRAKE:
            self.stage = Stage.BRAKE
            self.speed_reference = self.observer.velocity
            self.stop_stage.begin(self.speed_reference)
        self.stop_stage.aim(deceleration, friction, gradual=gradual)

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower, as after homing; nothing moves."""
        self.observer.shift(distance)
        self.target += distance
        self._offset -= distance

    def step(self, sample: float | None) -> float:
        """Process the sample that the drive made when the last effort left, ``y(k-1)``; return the effort ``u(k)``.

        Parameters
        ----------
        sample
            Measured position in axis unit; finite. None if there is none, or none to be believed: the model has to do.

        Returns
        -------
        float
            The effort in effort unit, within the effort limit.
        """
        observer, acted = self.observer, self.effort + self._late_effort
        self._late_effort = 0.0
        if sample is None:
            sample = observer.position
        if self.stage is _BRAKE:
            self.stop_stage.update(observer, sample, acted)
            self.effort = self._braking_effort()
            return self.effort
        observer.update(sample, acted)
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
            self.observer.predict(self.effort + self._late_effort)
            self._late_effort = 0.0

    def tell_timing(self, timing: Timing) -> None:
        """Tell which effort has acted in place of the last one; see :class:`.TimedLaw`."""
        self._late_effort = timing.late_effort

    def limit_effort(self, limit: float) -> None:
        """Keep the magnitude of the effort within a limit (effort unit) from the next step on."""
        self.effort_limit = limit

    def resume_at(self, velocity: float, disturbance: float) -> None:
        """Go on from another estimate: axis unit/s and effort unit; also where a stop by the former one has begun."""
        self.observer.correct(velocity, disturbance)
        self.speed_reference = velocity
        self.stop_stage.resume_at(velocity)

    def continue_from(self, other: "TwoStageLaw") -> None:
        """Copy the whole state of another law of the same axis, its estimate included."""
        self.observer.continue_from(other.observer)
        self.stop_stage.continue_from(other.stop_stage)
        self.stage, self.effort, self.saturated = other.stage, other.effort, other.saturated
        self.target, self.cruise_velocity = other.target, other.cruise_velocity
        self.speed_reference = other.speed_reference
        self._sum, self._offset, self._ramp, self._braking, self._direction = other.course()

    def course(self) -> Course:
        """Return what the law goes on from beside what it tells."""
        return Course(self._sum, self._offset, self._ramp, self._braking, self._direction)

    def _limited(self, effort: float) -> float:
        """Hold the effort within its limit and its rate, and tell whether the limit has cut it."""
        effort, self.saturated = limited_effort(effort, self.effort, self.effort_limit, self._largest_step)
        return effort

    def _braking_effort(self) -> float:
        """Follow the ramp down; at rest, go over to holding the place."""
        observer, stop = self.observer, self.stop_stage
        if stop.is_over(observer.velocity):
            # Where the position stage would come to rest from here: equation (19) read backwards.
            self.target = observer.position + self._changeover_time * observer.velocity
            # Braking is over: what it took gives way to what holds against the load.
            effort = self._limited(-observer.disturbance)
            self._enter_position_stage(effort)
            return effort
        effort = stop.step(observer, self._limited)
        self.speed_reference = stop.state.speed_reference
        return effort

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
        """Set the position stage's sum so that it gives this effort at the present estimate."""
        self._offset = -self.observer.position
        self._sum = effort + self._f12 * self.observer.velocity
        self.stage = Stage.POSITION
        self.speed_reference = 0.0
        self.changeovers += 1

    def _enter_speed_stage(self) -> None:
        """Set the speed stage's sum so that it continues from the last effort."""
        self._sum = self.effort + self._f12 * self.observer.velocity
        self.speed_reference = self.observer.velocity
        self.stage = Stage.SPEED
