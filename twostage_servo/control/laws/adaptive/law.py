"""The adaptive two-stage law: constant speed until the braking way is left, then position control on a reference.

**Speed stage.** Velocity feedback alone: ``u = (v+ - a22 v)/b2 + f2 (v - x2) - x3``, with v the speed reference and v+
its next value. Where a limit cuts the effort, v+ becomes what will be reached, so nothing winds up.

**Change-over.** It happens in the first tick after which the reference could no longer brake to the set-point as
gently as it is meant to. That tick evaluates the speed stage's own formula, and the position stage's reference starts
at the estimate (M of equation (32)), so both give the same effort there to the last bit.

**Position stage.** A model of the axis runs along the braking reference, and
``u = u_ff + f2 g(x_r - x1) + f2 (v_r - x2) - x3`` feeds back what the axis is off it. ``g(e)`` is ``(f1/f2) e`` for a
small error, and grows with its root beyond, so that quick poles do not ask for more than the effort's rate gives.

**Identification.** While a move from rest accelerates, :mod:`.identification` finds gain, pole, load and whether the
effort acts a tick later, and both stages go on with that model. See :mod:`.estimate` and :mod:`.learning`.

A stop is :mod:`twostage_servo.control.laws.stop`, on the axis' own observer and the configured plant, as that of the
paper's law: what has been identified may be what is wrong.
"""

from copy import copy
from math import copysign, sqrt
from typing import Final, NamedTuple

from twostage_servo.control.laws.adaptive.estimate import ControlEstimate
from twostage_servo.control.laws.adaptive.reference import Braking, Shape, next_speed
from twostage_servo.control.laws.adaptive.rules import Rules
from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import ControlTask, Learned, Stage
from twostage_servo.control.laws.stop import Stop
from twostage_servo.control.observer import DisturbanceObserver

_SPEED, _POSITION, _BRAKE = Stage.SPEED, Stage.POSITION, Stage.BRAKE

_HALVINGS: Final = 24
"""Steps in which the top speed of a short move is found: to a part in sixteen million."""

_LEAST_SHARE: Final = 0.2
"""Share of the effort limit, and of the cruise velocity, that braking is planned with at least."""

_HARDEST: Final = 0.9
"""Share of what the effort limit could brake with up to which a set-point that comes late is still met."""

_END_OF_IDENTIFICATION: Final = 0.15
"""Share of the top speed below which a braking shows nothing more of the plant."""

_GRIP_SHARE: Final = 0.14
"""Share of the effort limit that feedback may add at the start of a move until the axis is seen to move: three times
the load that is expected at most. What does not move by then is stuck, and is not to be pushed harder at once."""

_LONGEST_GRIP_S: Final = 0.15
"""Time for which it is held back: by then a stall is told, or there is friction that takes more."""

_MOTION: Final = 3.0
"""Standard deviations of a sample from which the axis is seen to move."""

_LETTING_GO_S: Final = 0.5
"""Time in which the push against an obstacle gives way, from the effort limit to none."""

_NOTHING: Final = 1e-9
"""Share of the cruise velocity that is none."""


class Course(NamedTuple):
    """What the law goes on from beside what it tells; see :class:`AdaptiveLaw`."""

    speed: float
    direction: float
    turns: bool
    top: float
    ticks_cruised: int
    error: float
    braking: Braking | None


class AdaptiveLaw:
    """One axis' law; see :class:`~twostage_servo.control.laws.law.Law`.

    Parameters
    ----------
    observer
        The axis' own estimate; owned by the law from here on.
    estimate
        What it controls by.
    task
        Plant, tick and limits.
    rules
        How it shapes a move.
    """

    __slots__ = (
        "_braking", "_direction", "_estimate", "_held_effort", "_largest_step", "_leaves", "_model_position", "_ramp",
        "_rise", "_rules", "_speed", "_start", "_task", "_ticks_cruised", "_ticks_held",
        "_top", "_turns", "changeovers",
        "cruise_velocity", "effort", "effort_limit", "observer", "saturated", "speed_reference", "stage", "stop_stage",
        "target",
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
        self._task = task
        self._rules = rules
        self._largest_step = task.effort_rate_limit * task.period_s
        self._ramp = task.acceleration_limit * task.period_s
        self.changeovers = 0
        self.start()

    # What it is told --------------------------------------------------------------------------------------------------

    def start(self, effort: float = 0.0) -> None:
        """Hold the estimated position, as if it had given `effort` (effort unit) so far."""
        self._estimate.start(self.observer, effort)
        self.stage = _POSITION
        self.effort = effort
        self.saturated = False
        self.target = self._model_position = self._start = self.observer.position
        self.cruise_velocity = self.speed_reference = 0.0
        self._forget_course()

    def _forget_course(self) -> None:
        self._speed = 0.0  # of the reference, counted in the direction
        self._direction = 1.0
        self._turns = False  # whether it comes to rest first, since the set-point cannot be met otherwise
        self._top = self._rise = 0.0
        self._ticks_cruised = 0
        self._braking: Braking | None = None
        self._leaves = False  # an obstacle that holds it against all of its effort
        self._ticks_held = 0
        self._held_effort: float | None = None  # by which the axis was held, until it is seen to move

    def set_target(self, target: float, velocity: float) -> None:
        """Go to a set-point (axis unit) with a cruise velocity (axis unit/s); the effort stays continuous."""
        estimate = self._estimate
        at_rest = self.stage is _POSITION and self._braking is None
        if self.stage is _BRAKE:
            estimate.start(self.observer, self.effort)
        estimate.give_up()
        signed = self._direction * self._speed if self.stage is _SPEED else estimate.velocity
        self.target, self.cruise_velocity = target, velocity
        self._leaves = self.saturated and abs(self.observer.velocity) <= self._task.rest_velocity
        self._start = self.observer.position
        self._direction = direction = copysign(1.0, target - estimate.position)
        self._speed = 0.0 if at_rest else direction * signed
        self._turns = False
        self._braking = None
        self._ticks_cruised = 0
        self.stage = _SPEED
        if at_rest:
            self._held_effort, self._ticks_held = self.effort, 0
            estimate.begin_move(direction)

    def stop(self, deceleration: float, friction: float = 0.0, *, gradual: bool = False) -> None:
        """Come to rest in the brake stage, then hold; see :meth:`~twostage_servo.control.laws.law.Law.stop`."""
        if self.stage is not _BRAKE:
            self._estimate.give_up()
            self.stage = _BRAKE
            self.speed_reference = self.observer.velocity
            self.stop_stage.begin(self.speed_reference)
        self.stop_stage.aim(deceleration, friction, gradual=gradual)

    def skip(self, periods: int) -> None:
        """Account for periods in which no step was made: the last effort acted on, unseen."""
        for _ in range(periods):
            self.observer.predict(self.effort)
            self._estimate.skip(self.effort)

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower; nothing moves."""
        self.observer.shift(distance)
        self._estimate.shift(distance)
        self.target += distance
        self._model_position += distance
        self._start += distance

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
    def learned(self) -> Learned:
        """What it has found out of the plant."""
        return self._estimate.learned

    def continue_from(self, other: "AdaptiveLaw") -> None:
        """Copy the whole state of another law of the same axis, its estimate included; each keeps its own model."""
        self.observer.continue_from(other.observer)
        self._estimate.continue_from(other.control_estimate, self.observer)
        self.stop_stage.continue_from(other.stop_stage)
        self.stage, self.effort, self.saturated = other.stage, other.effort, other.saturated
        self.target, self.cruise_velocity = other.target, other.cruise_velocity
        self.speed_reference = other.speed_reference
        course = other.course()
        self._speed, self._direction, self._turns, self._top, self._ticks_cruised, error, self._braking = course
        self._model_position = self._estimate.position + error

    @property
    def control_estimate(self) -> ControlEstimate:
        """What it controls by."""
        return self._estimate

    def course(self) -> Course:
        """Return what the law goes on from beside what it tells."""
        error = self._model_position - self._estimate.position
        braking = copy(self._braking)
        return Course(self._speed, self._direction, self._turns, self._top, self._ticks_cruised, error, braking)

    # What it does -----------------------------------------------------------------------------------------------------

    def step(self, sample: float | None) -> float:
        """Process the sample that belongs to the last effort's instant; return the next effort, in effort unit."""
        observer, estimate = self.observer, self._estimate
        if self.stage is _BRAKE:
            self.stop_stage.update(observer, observer.position if sample is None else sample, self.effort)
            self.effort = self._braking_effort()
            return self.effort
        estimate.update(sample, self.effort)
        observer.update(observer.position if sample is None else sample, self.effort)
        if self.stage is _SPEED:
            wanted = self._let_go(sample) if self._leaves else self._speed_stage()
            if self._held_effort is not None:
                wanted = self._gripped(wanted, self._held_effort, sample)
        else:
            if self._braking is None:
                estimate.rest(sample)
            wanted = self._position_stage()
        self.speed_reference = self._direction * self._speed
        self.effort, self.saturated = limited_effort(wanted, self.effort, self.effort_limit, self._largest_step)
        return self.effort

    def _braking_effort(self) -> float:
        """Follow the ramp down; at rest, go over to holding the place."""
        observer, stop = self.observer, self.stop_stage
        if stop.is_over(observer.velocity):
            effort = self._limited(-observer.disturbance)  # braking is over: what it took gives way to what holds
            self._estimate.start(observer, effort)
            self._forget_course()
            f1, f2 = self._estimate.model.feedback
            # Where the position stage asks for no change of effort at this speed.
            self.target = self._model_position = observer.position + f2 / f1 * observer.velocity
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

    # Speed stage ------------------------------------------------------------------------------------------------------

    def _speed_stage(self) -> float:
        """Return the effort for the next value of the speed reference, and see whether it is time to brake."""
        estimate, model, speed = self._estimate, self._estimate.model, self._speed
        plant, direction = model.sampled, self._direction
        velocity, disturbance = direction * estimate.velocity, direction * estimate.disturbance
        deceleration = self._planned_deceleration()
        goal = 0.0 if self._turns else self.cruise_velocity
        step = self._largest_rise() if speed < goal else self._ramp
        ahead = min(goal, speed + step) if speed < goal else max(goal, speed - step)
        back = model.feedback[1] * (speed - velocity) - disturbance
        wanted = (ahead - plant.a22 * speed) / plant.b2 + back
        effort, _ = limited_effort(wanted, direction * self.effort, self.effort_limit, self._largest_step)
        if effort != wanted:
            reached = plant.a22 * velocity + plant.b2 * (effort + disturbance)
            ahead = min(max(reached, min(0.0, speed)), max(goal, speed))
        if estimate.learning.is_new:
            least = max(ahead, _LEAST_SHARE * self.cruise_velocity)
            deceleration = min(deceleration, least / (self._rules.first_braking * self._task.period_s))
        way = direction * (self.target - estimate.position) - model.ways.beta * speed
        if not self._turns:
            shape, is_there = self._shape(ahead, deceleration), False
            if ahead > speed and self._is_late(ahead, shape, way, deceleration):
                ahead = self._highest_speed(ahead, way, deceleration)
                is_there = ahead <= _NOTHING * goal
                shape = self._shape(ahead, deceleration)
                wanted = (ahead - plant.a22 * speed) / plant.b2 + back
            left = way - model.ways.alpha * ahead - shape.way
            if next_speed(left, shape.speed, deceleration, model.ways) < shape.speed or is_there:
                self._begin_braking(shape, left, deceleration, ahead)
        self._rise = ahead - plant.a22 * speed
        if self._turns and ahead <= 0.0:
            self._turn_round(ahead)
        else:
            self._speed = ahead
        if estimate.is_identifying and ahead == goal:
            self._cruise()
        return direction * wanted

    def _let_go(self, sample: float | None) -> float:
        """Return an effort that changes evenly until an axis that has pushed against an obstacle is seen to leave it.

        What an obstacle holds vanishes with the push. Where that takes a tick, it is a step of load as large as all of
        the effort, and looks like a plant of another gain.
        """
        step = self.effort_limit * self._task.period_s / _LETTING_GO_S
        position = self._estimate.position if sample is None else sample
        if self._direction * (position - self._start) > _MOTION * self._estimate.spread:
            self._leaves = False
            self._speed = max(0.0, self._direction * self._estimate.velocity)
        return self.effort + copysign(step, self._direction * self._estimate.model.plant.gain)

    def _gripped(self, wanted: float, held: float, sample: float | None) -> float:
        """Return what is wanted within what the start of a move may take, until the axis is seen to move."""
        estimate, plant = self._estimate, self._estimate.model.sampled
        self._ticks_held += 1
        moves = sample is not None and abs(sample - self._start) > _MOTION * estimate.spread
        if moves or self._ticks_held * self._task.period_s > _LONGEST_GRIP_S:
            self._held_effort = None
            return wanted
        most = abs(self._rise / plant.b2) + _GRIP_SHARE * self.effort_limit
        return min(max(wanted, held - most), held + most)

    def _planned_deceleration(self) -> float:
        """Return the deceleration that braking is planned with, in axis unit/s²."""
        model, limit = self._estimate.model, self.effort_limit
        gain = model.plant.gain
        pushes = copysign(1.0, gain) * self._direction * self._estimate.disturbance  # the axis on
        left = max(limit - pushes, _LEAST_SHARE * limit)
        return min(self._rules.braking_share * abs(gain) * left, self._task.acceleration_limit)

    def _largest_rise(self) -> float:
        """Return by how much the speed reference may rise in a tick, in axis unit/s."""
        rules, period_s = self._rules, self._task.period_s
        if not self._estimate.learning.is_new:
            return self._ramp
        ticks = rules.first_acceleration
        quickest = self.cruise_velocity / ticks
        return min(self._ramp, quickest, abs(self.target - self._start) / (ticks * ticks * period_s))

    def _shape(self, ahead: float, deceleration: float) -> Shape:
        model, step = self._estimate.model, self._largest_step
        gain = abs(model.plant.gain)
        return Shape.at(ahead, self._speed, self.cruise_velocity, deceleration, gain, step, model.ways)

    def _is_late(self, ahead: float, shape: Shape, way: float, deceleration: float) -> bool:
        """Whether a speed a tick ahead would be more than from which the axis still comes to rest within the way."""
        ways = self._estimate.model.ways
        left = way - ways.alpha * ahead - shape.way
        return next_speed(left, shape.speed, deceleration, ways) < shape.speed - deceleration * self._task.period_s

    def _highest_speed(self, ahead: float, way: float, deceleration: float) -> float:
        """Return the highest speed a tick ahead, at most `ahead`, from which it does: the top of a short move."""
        low, high = 0.0, ahead
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if self._is_late(middle, self._shape(middle, deceleration), way, deceleration):
                high = middle
            else:
                low = middle
        return low

    def _begin_braking(self, shape: Shape, left: float, deceleration: float, ahead: float) -> None:
        """Go over to the position stage; or come to rest and turn, if no braking meets the set-point any more."""
        estimate, speed = self._estimate, self._speed
        ways = estimate.model.ways
        hardest = min(_HARDEST / self._rules.braking_share * deceleration, self._task.acceleration_limit)
        needed = shape.speed * shape.speed / (2.0 * left) if left > 0.0 else copysign(float("inf"), shape.speed)
        if ahead > 0.0 and speed > 0.0 and needed > max(hardest, 2.0 * deceleration):
            self._turns = True
            return
        self.stage = _POSITION
        self.changeovers += 1
        self._model_position = estimate.position + self._direction * (ways.beta * speed + ways.alpha * ahead)
        self._braking = Braking(shape, left, max(deceleration, needed)) if ahead > 0.0 else None
        self._top = ahead

    def _turn_round(self, ahead: float) -> None:
        """Set out for the set-point from rest, or nearly so."""
        direction = copysign(1.0, self.target - self._estimate.position)
        self._speed = ahead if direction == self._direction else -ahead
        self._direction = direction
        self._turns = False
        self._start = self._estimate.position

    def _cruise(self) -> None:
        """End to identify where the cruise shows nothing more."""
        self._ticks_cruised += 1
        rules = self._rules
        is_enough = self._ticks_cruised >= rules.identification_ticks and self._estimate.learning.is_sure
        if is_enough or self._ticks_cruised >= rules.longest_identification_ticks:
            self._estimate.finish()

    # Position stage ---------------------------------------------------------------------------------------------------

    def _position_stage(self) -> float:
        """Return the effort that follows the braking reference, or holds the set-point."""
        estimate, speed = self._estimate, self._speed
        if estimate.is_identifying and speed < _END_OF_IDENTIFICATION * self._top:
            estimate.finish()
        model, direction = estimate.model, self._direction
        plant = model.sampled
        ahead = forward = 0.0
        if self._braking is not None:
            ahead = self._braking.advance(model.ways)
            forward = (ahead - plant.a22 * speed) / plant.b2
        velocity_error = direction * speed - estimate.velocity
        back = self._pull(self._model_position - estimate.position) + model.feedback[1] * velocity_error
        self._model_position += direction * (plant.a12 * speed + plant.b1 * forward)
        if self._braking is None or self._braking.done:
            self._model_position = self.target
            self._braking = None
        self._speed = ahead
        return direction * forward + back - estimate.disturbance

    def _pull(self, error: float) -> float:
        """Return the effort for an error of the position, in axis unit."""
        model = self._estimate.model
        f1, f2 = model.feedback
        quickness = f1 / f2
        most = self._rules.pull_share * abs(model.plant.gain) * self._largest_step  # in axis unit/s²
        linear = most / (quickness * quickness)
        if abs(error) <= linear:
            return f1 * error
        return copysign(f2 * sqrt(2.0 * most * (abs(error) - 0.5 * linear)), error)
