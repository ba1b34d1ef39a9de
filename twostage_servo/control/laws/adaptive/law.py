"""The adaptive two-stage law: constant speed until the braking way is left, then position control on a reference.

**Speed stage** (:mod:`.speed_stage`). Velocity feedback follows a ramped speed reference.

**Change-over** (:mod:`.changeover`). It happens in the first tick after which the reference could no longer brake to
the set-point as gently as it is meant to. That tick evaluates the speed stage's own formula, and the position stage's
reference starts at the estimate (M of equation (32)), so both give the same effort there to the last bit.

**Position stage** (:mod:`.position_stage`). A model of the axis runs along the braking reference (:mod:`.reference`),
and what the axis is off it is fed back.

**Identification.** While a move from rest accelerates, :mod:`.identification` finds gain, pole, load and whether the
effort acts a tick later, and both stages go on with that model. See :mod:`.estimate` and :mod:`.learning`. Until the
axis is seen to move, the effort is held back (:mod:`.departure`).

A stop is :mod:`twostage_servo.control.laws.stop`, on the axis' own observer and the configured plant, as that of the
paper's law: what has been identified may be what is wrong.
"""

from math import copysign, inf, isfinite, isinf
from typing import Final

from twostage_servo.control.laws.adaptive.course import Course
from twostage_servo.control.laws.adaptive.departure import Departure
from twostage_servo.control.laws.adaptive.estimate import ControlEstimate
from twostage_servo.control.laws.adaptive.position_stage import PositionStage
from twostage_servo.control.laws.adaptive.rules import Rules, loop_period_s
from twostage_servo.control.laws.adaptive.speed_stage import SpeedStage
from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import ControlTask, Learned, Stage
from twostage_servo.control.laws.stop import Stop
from twostage_servo.control.laws.timing import IN_TIME, Timing
from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.plant import Plant

_SPEED, _POSITION, _BRAKE = Stage.SPEED, Stage.POSITION, Stage.BRAKE
"""Looked up once, since a look-up of a member costs a measurable part of a step."""

_STANDING_SHARE = 0.5
"""Share of the speed of a move up to which an axis counts as standing. The estimate of an axis at rest shows that much
where a slow move takes hundreds of ticks for each step of its encoder."""


_NOTHING: Final = 1e-9
"""Share of the way of a tick at the speed of a move, up to which an axis at rest stands at its set-point already."""


class AdaptiveLaw:
    """One axis' law; its attributes are those of :class:`~twostage_servo.control.laws.law.Law`.

    Parameters
    ----------
    observer
        The axis' own estimate; owned by the law from here on.
    estimate
        What it controls by; owned by the law from here on.
    task
        Plant, tick and limits.
    rules
        How it shapes a move.

    Attributes
    ----------
    stop_stage
        The stage that brings the axis to rest.
    sample_age
        1: :meth:`step` takes the sample of the tick before.
    """

    __slots__ = (
        "_course", "_departure", "_estimate", "_is_smooth", "_largest_step", "_period_s", "_position_stage",
        "_rest_velocity", "_speed_stage", "_timing", "changeovers", "cruise_velocity", "effort", "effort_limit",
        "observer", "saturated", "speed_reference", "stage", "stop_stage", "target",
    )  # fmt: skip
    sample_age = 1

    def __init__(
        self, observer: DisturbanceObserver, estimate: ControlEstimate, task: ControlTask, rules: Rules
    ) -> None:
        self.observer = observer
        self.effort_limit = task.effort_limit
        self.stop_stage = Stop(
            task.sampled, task.period_s, effort_rate_limit=task.effort_rate_limit, rest_velocity=task.rest_velocity
        )
        self._estimate = estimate
        self._departure = Departure(estimate, task.period_s, loop_period_s(task), holds_back=rules.holds_back)
        self._speed_stage = SpeedStage(estimate, self._departure, task, rules)
        self._position_stage = PositionStage(estimate, task, rules)
        self._largest_step = task.effort_rate_limit * task.period_s
        self._period_s = task.period_s
        self._rest_velocity = task.rest_velocity
        self._is_smooth = isfinite(task.jerk)
        self.changeovers = 0
        self.start()

    # What it is told --------------------------------------------------------------------------------------------------

    def start(self, effort: float = 0.0) -> None:
        """Hold the estimated position, as if it had given `effort` (effort unit) so far."""
        position = self.observer.position
        self._estimate.start(self.observer, effort)
        self.stage = _POSITION
        self.effort = effort
        self._timing = IN_TIME
        self.saturated = False
        self.speed_reference = 0.0
        self._hold(Course(position, position))
        self._departure.set_out(position)

    def set_target(self, target: float, velocity: float) -> None:
        """Go to a set-point (axis unit) with a cruise velocity (axis unit/s); the effort stays continuous."""
        estimate, course = self._estimate, self._course
        at_rest = self.stage is _POSITION and course.braking is None and self._stands(velocity)
        if self.stage is _BRAKE:
            estimate.start(self.observer, self.effort)
        estimate.give_up()
        if at_rest and abs(target - estimate.position) <= _NOTHING * velocity * self._period_s:
            self._hold(Course(target, target, velocity))
            return
        signed_speed, signed_slope = self._reference()
        direction = copysign(1.0, target - estimate.position)
        speed = 0.0 if at_rest else direction * signed_speed
        self._follow(Course(target, course.position, velocity, direction, speed, direction * signed_slope))
        presses = self.saturated and abs(self.observer.velocity) <= self._rest_velocity
        # The way that is left is counted from the estimate; one that presses is believed least of all.
        self._departure.set_out(self.observer.position if presses else estimate.position, leaves_obstacle=presses)
        self.stage = _SPEED
        if at_rest:
            self._departure.hold(self.effort)
            estimate.begin_move(direction)

    def _reference(self) -> tuple[float, float]:
        """Return the speed that the next move goes on from, and its change in the last tick, in axis unit/s."""
        course = self._course
        if self.stage is _BRAKE:
            return self._estimate.velocity, self.stop_stage.slope
        if self.stage is _SPEED or (self._is_smooth and course.braking is not None):
            return course.direction * course.speed, course.direction * course.slope
        return self._estimate.velocity, course.direction * course.slope  # one that has just come to rest has some

    def _stands(self, cruise_velocity: float) -> bool:
        """Whether the axis stands, beside how fast (axis unit/s) it is to be: one that moves shows another plant."""
        return abs(self._estimate.velocity) <= max(self._rest_velocity, _STANDING_SHARE * cruise_velocity)

    def stop(self, deceleration: float, friction: float = 0.0, *, gradual: bool = False, jerk: float = inf) -> None:
        """Come to rest in the brake stage, then hold; see :meth:`~twostage_servo.control.laws.law.Law.stop`."""
        if self.stage is not _BRAKE:
            self._estimate.give_up()
            speed, slope = self._reference()
            self.stage = _BRAKE
            # One that is not smooth is not to depend on a reference: it may be what the axis does not follow.
            self.speed_reference = self.observer.velocity if isinf(jerk) else speed
            self.stop_stage.begin(self.speed_reference, slope)
        self.stop_stage.aim(deceleration, friction, gradual=gradual, jerk=jerk)

    def skip(self, periods: int) -> None:
        """Account for periods in which no step was made: the last effort acted on, unseen."""
        for _ in range(periods):
            acted = self.effort + self._timing.late_effort
            self._timing = IN_TIME
            self.observer.predict(acted)
            self._estimate.skip(acted)

    def tell_timing(self, timing: Timing) -> None:
        """Tell of the next period what was not in time; see :class:`.TimedLaw`."""
        self._timing = timing

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower; nothing moves."""
        self.observer.shift(distance)
        self._estimate.shift(distance)
        self._departure.shift(distance)
        self._course.shift(distance)
        self.target = self._course.target

    def limit_effort(self, limit: float) -> None:
        """Keep the magnitude of the effort within a limit (effort unit) from the next step on."""
        self.effort_limit = limit

    def resume_at(self, velocity: float, disturbance: float) -> None:
        """Go on from another estimate: axis unit/s and effort unit of the configured plant."""
        self.observer.correct(velocity, disturbance)
        self._estimate.start(self.observer, self.effort)
        self.speed_reference = velocity
        self.stop_stage.resume_at(velocity)

    def forget(self) -> None:
        """Believe the configured plant again."""
        self._estimate.forget()

    @property
    def learns(self) -> bool:
        """Whether it identifies the plant."""
        return self._estimate.learns

    @property
    def learned(self) -> Learned:
        """What it has found out of the plant."""
        return self._estimate.learned

    @property
    def identified(self) -> Plant | None:
        """The plant that it controls by as by one that is known; None while none is."""
        return self._estimate.learning.identified

    @property
    def plant_estimate(self) -> DisturbanceObserver:
        """Where the axis is by the plant that it believes in, a tick after the last sample."""
        return self._estimate.observer

    def recall(self, learned: Learned) -> None:
        """Believe what has been learned before; see :meth:`~twostage_servo.control.laws.law.LearningLaw.recall`."""
        self._estimate.recall(learned)

    def continue_from(self, other: "AdaptiveLaw") -> None:
        """Go on where another law of the same axis stands, its estimate included; each keeps its own model.

        How a move has departed is each law's own as well.
        """
        self.observer.continue_from(other.observer)
        self._estimate.continue_from(other.control_estimate, self.observer)
        self.stop_stage.continue_from(other.stop_stage)
        self.stage, self.effort, self.saturated = other.stage, other.effort, other.saturated
        self.speed_reference = other.speed_reference
        error = other.course.position - other.control_estimate.position
        self._follow(other.course.copied_to(self._estimate.position + error))

    @property
    def control_estimate(self) -> ControlEstimate:
        """What it controls by."""
        return self._estimate

    @property
    def course(self) -> Course:
        """Where its move goes, and where that stands."""
        return self._course

    def _follow(self, course: Course) -> None:
        """Take a course, and tell where it goes."""
        self._course = course
        self.target, self.cruise_velocity = course.target, course.cruise_velocity

    def _hold(self, course: Course) -> None:
        """Follow a course that stands still; no move is under way."""
        self._follow(course)
        self._departure.clear()
        self._speed_stage.clear()

    # What it does -----------------------------------------------------------------------------------------------------

    def step(self, sample: float | None) -> float:
        """Process the sample that belongs to the last effort's instant; return the next effort, in effort unit."""
        observer, estimate, course = self.observer, self._estimate, self._course
        timing, self._timing = self._timing, IN_TIME
        acted = self.effort + timing.late_effort
        if self.stage is _BRAKE:
            self.stop_stage.update(observer, observer.position if sample is None else sample, acted)
            self.effort = self._braking_effort()
            return self.effort
        estimate.update(sample, acted, timing)
        observer.update(observer.position if sample is None else sample, acted)
        if estimate.is_misled:
            estimate.resume(observer)
        if self.stage is _SPEED:
            departure, limit = self._departure, self.effort_limit
            shown = None if sample is None else sample - timing.dating  # what has only been added shows no motion
            if departure.leaves_obstacle:
                wanted = departure.release(course, shown, self.effort, limit)
            else:
                wanted = self._speed_stage.step(course, self.effort, limit)
            if departure.is_held:
                wanted = departure.held_back(wanted, self._speed_stage.rise, shown, limit)
            if course.has_changed_over:
                self.stage = _POSITION
                self.changeovers += 1
        else:
            if course.braking is None:
                estimate.rest(sample)
            wanted = self._position_stage.step(course)
        self.speed_reference = course.direction * course.speed
        self.effort, self.saturated = limited_effort(wanted, self.effort, self.effort_limit, self._largest_step)
        return self.effort

    def _braking_effort(self) -> float:
        """Follow the ramp down; at rest, go over to holding the place."""
        observer, stop = self.observer, self.stop_stage
        if stop.is_over(observer.velocity):
            effort = self._limited(-observer.disturbance)  # braking is over: what it took gives way to what holds
            self._estimate.start(observer, effort)
            f1, f2 = self._estimate.model.feedback
            # Where the position stage asks for no change of effort at this speed.
            place = observer.position + f2 / f1 * observer.velocity
            self._hold(Course(place, place, self.cruise_velocity))
            self.stage = _POSITION
            self.speed_reference = 0.0
            self.changeovers += 1
            return effort
        effort = stop.step(observer, self._limited)
        self.speed_reference = stop.state.speed_reference
        return effort

    def _limited(self, effort: float) -> float:
        effort, self.saturated = limited_effort(effort, self.effort, self.effort_limit, self._largest_step)
        return effort
