"""A law of one stage that is given its feedback: it follows a trapezoidal reference of position and speed.

The reference keeps to the acceleration and to the cruise velocity, and comes to rest at the set-point. The model says
which effort follows it, the observer's disturbance is cancelled, and what the axis is off is fed back:
``u = (w(k+1) - a22 w(k)) / b2 - x3 + feedback(p(k) - x1, w(k) - x2)``, with p, w the reference and x the estimate.
A law of another package needs no more than that feedback: see :class:`TrackingDesign`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import copysign, isfinite, sqrt

from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import ControlTask, DesignError, Loop, Stage
from twostage_servo.control.laws.margins import settling_time_s
from twostage_servo.control.laws.paper_margins import closed_loop_poles
from twostage_servo.control.laws.stop import Stop
from twostage_servo.control.laws.stop_design import StopsByRamp
from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.optimal import ServoGains

Feedback = Callable[[float, float], float]
"""``feedback(position_error, speed_error)`` returns what is added to the effort that follows the reference.

The errors are reference minus estimate, in axis unit and axis unit/s: positive where position or speed has to rise. The
result is in effort unit. To reduce an error it needs the sign of the error times ``task.plant.gain``.
"""


class TrackingLaw:
    """See the module; the attributes are those of :class:`~twostage_servo.control.laws.law.Law`.

    Parameters
    ----------
    observer
        Estimates position, velocity and disturbance; owned by the law from here on.
    feedback
        Makes an effort of what the axis is off.
    task
        The plant, its limits and the tick.

    Attributes
    ----------
    reference
        Where the axis should be now, in axis unit.
    stop_stage
        The stage that brings the axis to rest.
    """

    def __init__(self, observer: DisturbanceObserver, feedback: Feedback, task: ControlTask) -> None:
        self.observer = observer
        self.effort_limit = task.effort_limit
        self.changeovers = 0
        self.stop_stage = Stop(
            task.sampled, task.period_s, effort_rate_limit=task.effort_rate_limit, rest_velocity=task.rest_velocity
        )
        self._feedback = feedback
        self._plant = task.sampled
        self._period_s = task.period_s
        self._acceleration = task.acceleration_limit
        self._largest_step = task.effort_rate_limit * task.period_s
        self.start()

    def start(self, effort: float = 0.0) -> None:
        """Hold the estimated position, as if it had given `effort` (effort unit) so far."""
        self.stage = Stage.POSITION
        self.effort = effort
        self.saturated = False
        self.target = self.reference = self.observer.position
        self.cruise_velocity = self.speed_reference = 0.0

    def set_target(self, target: float, velocity: float) -> None:
        """Go to a set-point (axis unit) with a cruise velocity (axis unit/s)."""
        if self.stage is Stage.BRAKE or self.speed_reference == 0.0:
            self.reference, self.speed_reference = self.observer.position, self.observer.velocity
        self.target, self.cruise_velocity = target, velocity
        self.stage = Stage.SPEED

    def stop(self, deceleration: float, friction: float = 0.0, *, gradual: bool = False) -> None:
        """Come to rest, then hold where that is; see :meth:`~twostage_servo.control.laws.law.Law.stop`."""
        if self.stage is not Stage.BRAKE:
            self.stage = Stage.BRAKE
            self.speed_reference = self.observer.velocity
            self.stop_stage.begin(self.speed_reference)
        self.stop_stage.aim(deceleration, friction, gradual=gradual)

    def step(self, sample: float | None) -> float:
        """Process the sample of the last effort's instant, in axis unit or None; return the next effort."""
        observer = self.observer
        if sample is None:
            sample = observer.position
        if self.stage is Stage.BRAKE:
            self.stop_stage.update(observer, sample, self.effort)
            if not self.stop_stage.is_over(observer.velocity):
                self.effort = self.stop_stage.step(observer, self._limited)
                self.speed_reference = self.stop_stage.state.speed_reference
                return self.effort
            self.target = observer.position
            self._arrive()
        else:
            observer.update(sample, self.effort)
        place, speed = self.reference, self.speed_reference
        if self.stage is Stage.SPEED:
            self._advance()
        ahead = (self.speed_reference - self._plant.a22 * speed) / self._plant.b2
        back = self._feedback(place - observer.position, speed - observer.velocity)
        self.effort = self._limited(ahead + back - observer.disturbance)
        return self.effort

    def skip(self, periods: int) -> None:
        """Account for periods in which no step was made: the last effort acted on, unseen."""
        for _ in range(periods):
            self.observer.predict(self.effort)

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self.observer.shift(distance)
        self.target += distance
        self.reference += distance

    def limit_effort(self, limit: float) -> None:
        """Keep the magnitude of the effort within a limit (effort unit) from the next step on."""
        self.effort_limit = limit

    def resume_at(self, velocity: float, disturbance: float) -> None:
        """Go on from another estimate: axis unit/s and effort unit; also where a stop by the former one has begun."""
        self.observer.correct(velocity, disturbance)
        self.speed_reference = velocity
        self.stop_stage.resume_at(velocity)

    def continue_from(self, other: "TrackingLaw") -> None:
        """Copy the whole state of another law of the same design, its estimate included."""
        self.observer.continue_from(other.observer)
        self.stop_stage.continue_from(other.stop_stage)
        self.stage, self.effort, self.saturated = other.stage, other.effort, other.saturated
        self.target, self.cruise_velocity = other.target, other.cruise_velocity
        self.reference, self.speed_reference = other.reference, other.speed_reference

    def _advance(self) -> None:
        """Move the reference by a period."""
        to_go, speed, step = self.target - self.reference, self.speed_reference, self._acceleration * self._period_s
        if abs(to_go) <= 0.5 * step * self._period_s and abs(speed) <= step:
            self._arrive()
            return
        # From the speed w at the end of the period it takes w²/2a to come to rest; in the period it goes (v + w) T/2.
        left = max(0.0, abs(to_go) - 0.5 * copysign(speed, speed * to_go) * self._period_s)
        fastest = sqrt(2.0 * self._acceleration * left + 0.25 * step * step) - 0.5 * step
        wanted = copysign(min(self.cruise_velocity, fastest), to_go)
        change = wanted - speed
        after = speed + copysign(min(abs(change), step), change)
        self.reference += 0.5 * (speed + after) * self._period_s
        self.speed_reference = after

    def _arrive(self) -> None:
        self.reference, self.speed_reference = self.target, 0.0
        self.stage = Stage.POSITION
        self.changeovers += 1

    def _limited(self, effort: float) -> float:
        """Hold the effort within its limit and its rate, and tell whether the limit has cut it."""
        effort, self.saturated = limited_effort(effort, self.effort, self.effort_limit, self._largest_step)
        return effort


@dataclass(frozen=True, eq=False)
class TrackingDesign(StopsByRamp):
    """The design of a :class:`TrackingLaw`; see :class:`~twostage_servo.control.laws.law.LawDesign`.

    Parameters
    ----------
    task
        What it is designed for.
    feedback
        See :data:`Feedback`.
    time_constant_s
        Slowest time constant of the loop with this feedback, in s: 1/b if its slowest pole is at -b. The effort does
        not depend on it. Times the speed it is the change-over distance that ``check`` shows; a move counts as reached
        only when the designed speed times this is within the position window; and it is a part of the duration of a
        move, from which the velocities of a synchronised move follow.
    named_gains
        The gains of the feedback by their names, which ``design`` shows.
    what_from
        What the gains follow from, in a few words, such as ``"bandwidth 6/s"``: ``design`` shows it behind them in
        parentheses. Empty where there is nothing to say.

    Raises
    ------
    DesignError
        If the time constant is no positive number, or a stop would be unstable with this observer.
    """

    task: ControlTask
    feedback: Feedback
    time_constant_s: float
    named_gains: Mapping[str, float] = field(default_factory=dict)
    what_from: str = ""

    def __post_init__(self) -> None:
        if not (isfinite(self.time_constant_s) and self.time_constant_s > 0.0):
            raise DesignError((), f"the time constant is {self.time_constant_s!r} s: a number greater than 0 is needed")
        if not self._stop_radius() < 1.0:
            raise DesignError((), "a stop would be unstable with this observer; choose other observer variances")

    @property
    def changeover_time_s(self) -> float:
        """The time constant, in s: the reference ends so far ahead of the axis, for each axis unit/s."""
        return self.time_constant_s

    def changeover_distance(self, velocity: float) -> float:
        """Return how far the axis is from the set-point when the reference ends there, in axis unit."""
        return velocity * self.changeover_time_s

    @property
    def settling_time_s(self) -> float:
        """How long the slowest pole of a stop takes to die down to a hundredth, in s."""
        return settling_time_s(self._stop_radius(), self.task.period_s)

    def build(self, observer: DisturbanceObserver) -> TrackingLaw:
        """Return a law within the task's limits."""
        return TrackingLaw(observer, self.feedback, self.task)

    def move_duration_s(self, distance: float, velocity: float, window: float) -> float:
        """Return how long a move takes, in s: the reference's trapezoid, and what the axis is behind it."""
        acceleration = self.task.acceleration_limit
        speed = min(velocity, sqrt(acceleration * distance))
        return distance / speed + speed / acceleration + self.time_constant_s * math.log(distance / window)

    def gains(self) -> Mapping[str, float]:
        """Return the gains of the feedback."""
        return self.named_gains

    def origin(self) -> str:
        """Return what they follow from."""
        return self.what_from

    def loops(self) -> Mapping[str, Loop]:
        """Return none: of a feedback that may be any function no margins are known."""
        return {}

    def _stop_radius(self) -> float:
        task, unused = self.task, ServoGains(0.0, 0.0, 0.0)  # a stop has gains of its own
        poles = closed_loop_poles(task.sampled, unused, task.kalman, task.noise, Stage.BRAKE)
        return max(abs(pole) for pole in poles)
