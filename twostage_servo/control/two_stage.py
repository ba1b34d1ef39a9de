"""The two-stage law: constant speed until the change-over distance remains, then position control; equations (29)-(34).

The effort is ``u = I - f12 x2`` in the speed stage and ``u = I - f12 x2 - f11 (x1 + M)`` in the position stage, where
x1, x2 are the observer's position and velocity. One sum I runs through both stages: it adds up ``f22 (v - x2)`` in the
first and ``f22 (r - y)`` in the second (erratum 10).

The change-over sets ``M = -x1`` at its own tick, so both forms give the same effort there to the last bit (erratum 12).
It happens at the distance at which the position stage asks for no change of effort at the present speed, equation (19),
so the ticks after it continue as smoothly.
"""

import enum
import math

from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.optimal import ServoGains

SPEED_TOLERANCE = 0.1
"""Share of the cruise velocity by which the axis may be too fast to enter the position stage for a new set-point."""


class Stage(enum.IntEnum):
    """Which of the two stages makes the effort."""

    SPEED = 1
    POSITION = 2


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
        The velocity that the speed stage asks for now, ramped, in axis unit/s.
    saturated
        Whether the effort limit cut the last effort.
    changeovers
        Number of changes from the speed to the position stage so far.
    sample_age
        1: :meth:`step` takes the sample of the period before (see :class:`~twostage_servo.control.law.Law`).
    """

    __slots__ = (
        "_braking", "_changeover_time", "_direction", "_f11", "_f12", "_f22", "_offset", "_ramp", "_ramp_limit",
        "_rest_velocity", "_stopping", "_sum", "changeovers", "cruise_velocity", "effort", "effort_limit", "observer",
        "period_s", "saturated", "speed_reference", "stage", "target",
    )  # fmt: skip
    sample_age = 1
    _STATE = (
        "stage", "target", "cruise_velocity", "speed_reference", "effort", "saturated",
        "_sum", "_offset", "_ramp", "_braking", "_stopping", "_direction",
    )  # fmt: skip

    def __init__(
        self,
        observer: DisturbanceObserver,
        gains: ServoGains,
        period_s: float,
        *,
        acceleration_limit: float = math.inf,
        effort_limit: float = math.inf,
        rest_velocity: float = 0.0,
    ) -> None:
        self.observer = observer
        self.period_s = period_s
        self.effort_limit = effort_limit
        self._f11, self._f12, self._f22 = gains.f11, gains.f12, gains.f22
        self._rest_velocity = rest_velocity
        self._changeover_time = gains.changeover_time_s(period_s)
        self._ramp_limit = acceleration_limit * period_s
        self.changeovers = 0
        self.start()

    def start(self) -> None:
        """Hold the estimated position, beginning with no effort; the observer has been tracking it until now."""
        position = self.observer.position
        self.stage = Stage.POSITION
        self.target = position
        self.cruise_velocity = 0.0
        self.speed_reference = 0.0
        self.effort = 0.0
        self.saturated = False
        self._ramp = self._ramp_limit
        self._sum = 0.0
        self._offset = -position
        self._braking = self._stopping = False
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
        self._direction = direction = math.copysign(1.0, offset)
        distance = direction * offset
        approach = direction * self.observer.velocity
        tolerance = SPEED_TOLERANCE * velocity
        self.target = target
        self.cruise_velocity = velocity
        self._stopping = False
        self._ramp = self._ramp_limit
        near = distance <= velocity * self._changeover_time
        self._braking = approach > distance / self._changeover_time + tolerance
        if near and not self._braking and approach >= -tolerance:
            if self.stage is Stage.SPEED:
                self._enter_position_stage()
        elif self.stage is Stage.POSITION:
            self._enter_speed_stage()

    def stop(self, deceleration: float) -> None:
        """Bring the axis to rest with a slope in axis unit/s², then hold where it comes to rest."""
        if self.stage is Stage.POSITION:
            self._enter_speed_stage()
        self._stopping = True
        self._braking = False
        self._ramp = deceleration * self.period_s

    @property
    def stopping(self) -> bool:
        """Whether :meth:`stop` is still bringing the axis to rest."""
        return self._stopping

    def step(self, sample: float) -> float:
        """Take the sample that the drive made when the last effort left, ``y(k-1)``; return the effort ``u(k)``.

        Parameters
        ----------
        sample
            Measured position in axis unit; finite.

        Returns
        -------
        float
            The effort in effort unit, within the effort limit.
        """
        observer = self.observer
        observer.update(sample, self.effort)
        velocity = observer.velocity
        if self.stage is Stage.POSITION:
            self._sum += self._f22 * (self.target - sample)
            effort = self._sum - self._f12 * velocity - self._f11 * (observer.position + self._offset)
        else:
            effort = self._sum - self._f12 * velocity
            if self._speed_stage_ends():
                self._enter_position_stage()
            else:
                self._sum += self._f22 * (self._ramped_reference() - velocity)
        limit = self.effort_limit
        self.saturated = not -limit <= effort <= limit
        if self.saturated:
            limited = limit if effort > 0.0 else -limit
            self._sum += limited - effort
            effort = limited
        self.effort = effort
        return effort

    def skip(self, periods: int) -> None:
        """Account for periods in which no step was made: the last effort acted on, unseen."""
        for _ in range(periods):
            self.observer.predict(self.effort)

    def continue_from(self, other: "TwoStageLaw") -> None:
        """Take over the whole state of another law of the same axis, its estimate included."""
        self.observer.continue_from(other.observer)
        for name in self._STATE:
            setattr(self, name, getattr(other, name))

    def _speed_stage_ends(self) -> bool:
        """Decide the change-over from the estimate of this very tick."""
        velocity = self.observer.velocity
        if self._stopping:
            if self.speed_reference != 0.0 or abs(velocity) > self._rest_velocity:
                return False
            # Where the position stage would come to rest from here: equation (19) read backwards.
            self.target = self.observer.position + self._changeover_time * velocity
            self._stopping = False
            return True
        offset = self.target - self.observer.position
        direction = math.copysign(1.0, offset)
        if direction != self._direction:  # passed the set-point while braking: turn round
            self._direction = direction
            self._braking = False
        approach = velocity if self._braking else self.speed_reference
        if self._braking:
            return direction * approach * self._changeover_time <= direction * offset
        return 0.0 < direction * offset <= direction * approach * self._changeover_time

    def _ramped_reference(self) -> float:
        """Move the speed reference towards its goal by at most the acceleration limit; return it."""
        goal = 0.0 if self._stopping or self._braking else self._direction * self.cruise_velocity
        change = goal - self.speed_reference
        if abs(change) <= self._ramp:
            self.speed_reference = goal
        else:
            self.speed_reference += math.copysign(self._ramp, change)
        return self.speed_reference

    def _enter_position_stage(self) -> None:
        self._offset = -self.observer.position
        self.stage = Stage.POSITION
        self._braking = False
        self.speed_reference = 0.0
        self.changeovers += 1

    def _enter_speed_stage(self) -> None:
        self._sum -= self._f11 * (self.observer.position + self._offset)
        self.speed_reference = self.observer.velocity
        self.stage = Stage.SPEED
