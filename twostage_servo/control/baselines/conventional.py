"""The conventional two-stage law of section III, equations (14)-(19), and its refinement of reference [6]."""

import math

from twostage_servo.control.baselines.velocity import VelocitySource
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.optimal import ServoGains
from twostage_servo.control.plant import DiscretePlant


class ConventionalTwoStage:
    """Speed stage on the measured velocity, position stage on a model of the plant that is started at the change-over.

    Speed stage, (14): ``u = I - f12 x2``, and I adds up ``f22 (v - x2)``. When no more than p remains, (18), the model
    is started at ``x_m(k+1) = [v T_s, v]``, (16)-(17), positions counted from the one at that tick. Position stage,
    (15): ``u = I - f11 x_m1 - f12 x_m2``, and I adds up ``f22 (r - y)``, from the tick of the change-over on: its
    ``f22 p`` cancels ``f11 v T_s`` (erratum 14), so the effort goes on without a step.

    The model is fed with the same effort as the plant and never sees the plant again. A constant disturbance that the
    effort has to balance moves the model for ever, so its position runs away, and I has to follow it: the error that
    remains is ``f11 v_m T_s / f22``, where v_m is the model's velocity under that effort.

    Parameters
    ----------
    model
        The sampled plant as it is believed to be.
    gains
        f11, f12, f22.
    velocity_source
        A speed sensor for the two-output form, a differentiator for the one-output form.
    difference_gain
        Feedback in the position stage of what the plant has moved beyond its model, ``y - y(k) - x_m1``, in effort
        unit/axis unit. 0 is the law of section III. Reference [6] feeds the difference back and gives no steady-state
        error; with f11, our reading of it, the position term is fed by the plant alone and only the velocity by the
        model, and nothing runs away any more.
    sum_as_printed
        Let I begin its sum of ``r - y`` one tick later, as (15) is printed (erratum 14).

    Attributes
    ----------
    stage
        The stage that makes the next effort.
    """

    sample_age = 0

    def __init__(
        self,
        model: DiscretePlant,
        gains: ServoGains,
        velocity_source: VelocitySource,
        *,
        difference_gain: float = 0.0,
        sum_as_printed: bool = False,
    ) -> None:
        self._model = model
        self._f11, self._f12, self._f22 = gains.f11, gains.f12, gains.f22
        self._changeover_time = gains.changeover_time_s(model.period_s)
        self._measure = velocity_source
        self._difference_gain = difference_gain
        self._sum_as_printed = sum_as_printed
        self._anchor = self._sum = self._target = self._velocity_reference = 0.0
        self._model_position = self._model_velocity = self.velocity = 0.0
        self._moving = False
        self.changeovers = 0
        self.stage = Stage.SPEED

    def set_target(self, target: float, velocity: float) -> None:
        """Set the set-point (axis unit) and the magnitude of the cruise velocity (axis unit/s) of a move from rest."""
        self._target = target
        self._velocity_reference = velocity
        self._moving = False
        self.stage = Stage.SPEED

    def step(self, sample: float) -> float:
        """Process ``y(k)`` in axis unit; return the effort ``u(k)`` in effort unit."""
        measured = self._measure(sample)
        error = self._target - sample
        if self.stage is Stage.POSITION:
            return self._position_stage(sample, error)
        if not self._moving:
            self._direction = math.copysign(1.0, error)
        self.velocity = measured
        effort = self._sum - self._f12 * measured
        if self._direction * error <= self._velocity_reference * self._changeover_time:
            self._start_model(sample)
            if not self._sum_as_printed:
                self._sum += self._f22 * error
        else:
            self._sum += self._f22 * (self._direction * self._velocity_reference - measured)
        self._moving = True
        return effort

    def _position_stage(self, sample: float, error: float) -> float:
        position, velocity, model = self._model_position, self._model_velocity, self._model
        self.velocity = velocity
        difference = sample - self._anchor - position
        effort = self._sum - self._f11 * position - self._f12 * velocity - self._difference_gain * difference
        self._sum += self._f22 * error
        self._model_position = position + model.a12 * velocity + model.b1 * effort
        self._model_velocity = model.a22 * velocity + model.b2 * effort
        return effort

    def _start_model(self, sample: float) -> None:
        """Set ``x_m(k+1)``: cruising, or still at rest when the whole move is no longer than p."""
        velocity = self._direction * self._velocity_reference if self._moving else 0.0
        self._anchor = sample
        self._model_position = velocity * self._model.period_s
        self._model_velocity = velocity
        self.stage = Stage.POSITION
        self.changeovers += self._moving
