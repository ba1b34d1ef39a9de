"""What must hold of an axis whose encoder has begun to count wrongly: how far it goes, and what it then claims to know.

As in :mod:`twostage_servo.faults.budget`, the way has three parts, each from the limits and the model: what passes
before the fault is certain, which `check` holds to the position overrun unless ``axis.limits.undetected_travel`` states
more, on the model's own plant; the latency; and coming to rest, by the quick stop or without effort, whichever takes
longer. The speed is that of the motion that was asked for; an encoder that counts half lets the law drive twice as
fast, and one that stands still lets the effort grow by the stall effort until it is told from friction.

Another scale is told by the jump of the measured speed where it comes in a cruise, from the slowest speed on of which
`check` says so (:func:`certain_speed`). A plant off its model makes the estimate of the speed wrong while that changes:
then, and at rest, the scale is told from the answer to the effort alone, like a plant of another gain. One that is
:data:`MODEL_ERROR` off is accepted, and what looks like such a one cannot be told from it. That is the limit of one
encoder, and no travel is held to a bound then. An axis that is slower than that speed may creep: what its encoder hides
is less than its noise.
"""

import math
from collections import deque

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.detection import allowed_travel, slowest_certain_velocity
from twostage_servo.axis.motion import IMPLAUSIBLE_SAMPLES
from twostage_servo.axis.state import BRAKING, COMMANDED, DRIVEN
from twostage_servo.control.model_monitor.monitor import DATE_SHARE, NOISE_SHARE
from twostage_servo.control.per_time import NOMINAL_S, kept_in
from twostage_servo.control.plant import MODEL_ERROR

ENCODER_FACTORS = {"turned round": -1.0, "counting double": 2.0, "counting half": 0.5, "frozen": 0.0}
"""What can become of an encoder, and how many units it then counts for one."""

REFUSED_GAINS = (0.45, 2.2)
"""Below the first and above the second multiple of the model's gain a plant is none that could be accepted."""

_SAMPLE_AGE_TICKS = 2
"""A fault may fall just behind a sample, and a sample is read a tick after it was taken."""

_OFF_MODEL_SHARE = 1.25
"""How far an axis may go whose plant is off its model, as a multiple of the bound: `check` computes the undetected
travel on the model's own plant. The largest that 650 hours found is 1.213: a plant with 1.28 of the gain and 0.85 of
the pole on a tick of 1 ms, whose encoder turned round while it turned round itself, with all of its effort."""

_HIDDEN_SHARE = 2.0
"""The same for an encoder that turns round below the speed from which on `check` calls that certain, while the axis
comes to rest. The largest that 1,800 hours found is 1.88: in a quick stop at 49 of 64 mm/s, on a plant
with 0.85 of the gain and 0.73 of the pole and a tick of 1 ms, the axis ran away until 310 ms later it was told."""

_CRUISE_S = 0.3
"""Time after which the estimate of the speed is that of a cruise: 30 ticks of 10 ms, of whatever length they are."""

_FROM_REST = 3.5
"""How many times as fast as in a cruise an axis has to be for its scale to show from rest on, for each nominal tick of
its period, and as often on a shorter one. In a cruise the measured speed jumps, by more on a longer tick; from rest on
the same difference grows with the speed, while the estimates follow. Six plants up to 30 % off, with half and twice the
scale: 3.1 times are needed on a tick of 10 ms, 2.9 on 5 ms, 1.5 on 1 ms, 5.6 on 20 ms."""

_CRUISE_SHARE = 0.1
"""Share by which the speed may have changed in them. A plant off its model makes the estimate wrong by up to
:data:`MODEL_ERROR` of the change, 3 % of the speed, and an encoder that counts double shows twice that: 6 % of its
jump. So the change explains the samples 277 times better than no change does, and it takes 50 times: that leaves a
factor of five for what accepted plants make up for meanwhile."""

_FADING = 0.998
"""Share that is left 10 ms later of the largest speed, by which late samples are judged."""


def undetected_travel(design: AxisDesign) -> float:
    """Return how far the axis may go, in axis unit, before an encoder that counts wrongly has to be noticed."""
    return max(allowed_travel(design), design.settings.limits.position_overrun)


def travel_bound(design: AxisDesign, speed: float, factor: float) -> float:
    """Return how far the axis may go in all, in axis unit.

    Parameters
    ----------
    design
        The axis.
    speed
        Largest speed of the motion without the fault, in axis unit/s.
    factor
        How many units the encoder counts for one.
    """
    limits = design.settings.limits
    reached = 2.0 * speed if factor == ENCODER_FACTORS["counting half"] else speed
    if factor == ENCODER_FACTORS["frozen"]:
        plant = design.settings.plant
        reached += abs(plant.gain) / plant.pole * limits.stall_effort * (1.0 + MODEL_ERROR)
    coasting = reached / (design.settings.plant.pole * (1.0 - MODEL_ERROR))
    rest = max(coasting, design.certain_stopping_distance(reached, limits.quick_stop_deceleration))
    latency_s = (IMPLAUSIBLE_SAMPLES + _SAMPLE_AGE_TICKS) * design.period_s
    return undetected_travel(design) + reached * latency_s + rest + design.settings.window.position


def certain_speed(design: AxisDesign, slowest: float, fastest: float) -> float:
    """Return the speed (axis unit/s) from which on another scale of the encoder shows.

    `check` finds it in a cruise. Nothing is decided below a surprise that is made up of the noise, and of what late
    samples may be off at the largest speed of late. All that is compared with it goes with the speed, so that twice the
    surprise takes twice the speed.

    Parameters
    ----------
    design
        The axis.
    slowest
        What `check` says, in axis unit/s.
    fastest
        Largest speed of late, in axis unit/s.
    """
    noise: float = NOISE_SHARE * design.noise.measurement_variance**0.5
    share_s = DATE_SHARE * 1e-3 * design.settings.limits.innovation_time_ms
    return slowest * (noise + share_s * max(slowest, fastest)) / (noise + share_s * slowest)


class EncoderWatch:
    """Follows an axis from the moment at which its encoder begins to count wrongly.

    Parameters
    ----------
    axis
        The axis.

    Attributes
    ----------
    factor
        How many units the encoder counts for one; 1 while it is sound.
    closest
        Largest travel so far as a share of its bound.
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._slowest = slowest_certain_velocity(axis.design)
        self.factor = 1.0
        self.closest = 0.0
        self._origin = self._speed = self._bound = 0.0
        self._gain = self._pole = 1.0
        self._error_allowed = 0.0
        self._is_certain = True
        self._was_driven = False
        self._began = ""
        self._effort_before: float | None = None  # with which its encoder stood still, where that did not show
        self._from_rest = False
        self._is_hidden = False  # a turned encoder, by a speed that is too low for it to be certain
        self._is_slow = False  # whether it has not been fast enough yet for its scale to show
        self._cruise_ticks = max(2, round(_CRUISE_S / axis.design.period_s))
        self._speeds: deque[float] = deque(maxlen=self._cruise_ticks)
        self._stall_ticks = axis.design.ticks(axis.settings.limits.stall_time_ms) + _SAMPLE_AGE_TICKS
        self._ticks_beyond = 0  # with an effort that has changed by the stall effort
        self._fastest = 0.0

    @property
    def active(self) -> bool:
        """Whether the encoder counts wrongly."""
        return self.factor != 1.0

    @property
    def in_doubt(self) -> bool:
        """Whether the axis may take its place for another one, so that its position limits say nothing of the truth."""
        return self._error_allowed > 0.0

    def begin(self, factor: float, position: float, speed: float, gain: float = 1.0, pole: float = 1.0) -> None:
        """Begin to watch.

        Parameters
        ----------
        factor
            How many units the encoder counts for one from now on.
        position, speed
            Where the axis truly is, and its velocity, in axis unit and axis unit/s.
        gain, pole
            The plant's true gain and pole, as multiples of the model's.
        """
        self.factor, self._gain, self._pole = factor, gain, pole
        self._began = f"{self._axis.state} at {speed:.4g}"
        shows = abs(speed) >= self._certain_speed()
        steady = self._axis.state in BRAKING or self._cruises(abs(speed))
        at_rest = self._axis.state not in COMMANDED and abs(speed) <= self._axis.design.rest_velocity
        asked = max(abs(speed), self._speed_asked())
        self._begin_motion(position, asked, shows=shows, steady=steady, from_rest=at_rest)

    def move_asked(self, position: float, velocity: float, speed: float, *, at_rest: bool) -> None:
        """Take a motion that was asked for.

        Parameters
        ----------
        position
            Where the axis truly is, in axis unit.
        velocity, speed
            What was asked for, and the true velocity, in axis unit/s.
        at_rest
            Whether the axis takes itself to be at rest. It may creep on from a stop all the same, behind an encoder
            that counts half; then not all of the motion shows another scale.
        """
        if not self.active:
            return
        if at_rest:
            self._began += f", then from rest at {velocity:.4g}"
            stood_with = self._effort_before
            stands = abs(speed) <= self._axis.design.rest_velocity
            self._begin_motion(position, velocity, shows=False, steady=False, from_rest=stands)
            if stood_with is not None:  # it has stood still since then: that effort the axis compares with
                self._effort_before = stood_with
        else:
            self._speed = max(self._speed, velocity)
            self._set_bound()

    def check(self, position: float, speed: float, effort: float) -> str | None:
        """Look at the true axis (axis unit, axis unit/s) and its effort after a tick; say what is wrong, or None.

        An encoder that stands still at an axis too slow for its jump to show is friction's double: until the effort has
        changed by the stall effort, which is more than its friction, for the stall time, nothing tells them apart, and
        the axis may creep.
        So may one with another scale, until it has been fast enough for that to show.
        """
        self._speeds.append(abs(speed))
        self._fastest = max(kept_in(_FADING, self._axis.design.period_s) * self._fastest, abs(speed))
        begins, self._was_driven = not self._was_driven, self._axis.state in DRIVEN
        if begins and self._was_driven and (wrong := self._check_arming(position, speed)):
            return wrong
        if not self.active:
            return None
        if begins and self._was_driven:  # an operator has armed it again: a motion of its own, from where it is
            self._began += ", then armed again"
            self._begin_motion(position, abs(speed), shows=False, steady=False, from_rest=True)
        if self._may_creep(abs(speed), effort):
            self._origin = position
            self._error_allowed = math.inf
        travel = abs(position - self._origin)
        self.closest = max(self.closest, travel / self._bound)
        if travel <= self._bound:
            return None
        name = next(name for name, factor in ENCODER_FACTORS.items() if factor == self.factor)
        trip = self._axis.trip
        return (
            f"with its encoder {name} since it was {self._began} {self._axis.settings.unit}/s the axis has gone "
            f"{travel:.4g} {self._axis.settings.unit}, {self._bound:.4g} is the most; it is {self._axis.state}, "
            f"{'not tripped' if trip is None else trip.code}"
        )

    def _may_creep(self, speed: float, effort: float) -> bool:
        if self._effort_before is not None:
            if abs(effort - self._effort_before) < self._axis.settings.limits.stall_effort:
                self._ticks_beyond = 0
                return True
            self._ticks_beyond += 1
            if self._ticks_beyond > self._stall_ticks:
                self._effort_before = None
        times = _FROM_REST * max(1.0, self._axis.design.period_s / NOMINAL_S) if self._from_rest else 1.0
        self._is_slow = self._is_slow and speed < times * self._certain_speed()
        return self._is_slow

    def _check_arming(self, position: float, speed: float) -> str | None:
        """Look at an axis that has been armed, at a true position and speed; return what is wrong, or None."""
        believed = self._axis.estimate.position
        if not self._axis.referenced:
            return None
        error, allowed = abs(believed - position), self._error_allowed + self._accuracy(abs(speed))
        if error <= allowed:
            return None
        return (
            f"the axis counts as referenced, takes its place for {believed:.6g} {self._axis.settings.unit}, and is at "
            f"{position:.6g}: that is off by {error:.4g}, and {allowed:.4g} is the most"
        )

    def mended(self) -> None:
        """Take notice that the encoder counts rightly again; where it is may still be wrong."""
        self.factor = 1.0

    def placed(self, speed: float) -> None:
        """Take notice that the axis was told where it is, or has found it out, at a true velocity in axis unit/s.

        It may have set out by itself, and the samples show that later: what it has gone since the last one is unknown.
        """
        moves = abs(speed) > self._axis.design.rest_velocity
        self._error_allowed = abs(speed) * _SAMPLE_AGE_TICKS * self._axis.design.period_s if moves else 0.0
        if self.active:
            self._error_allowed += abs(1.0 - self.factor) * self._bound

    def moved_by_hand(self, before: float, after: float) -> None:
        """Take notice that somebody has moved the axis from a true place to another (axis unit), which is no travel."""
        if self.active:
            self._origin += after - before
            self._error_allowed += abs(1.0 - self.factor) * abs(after - before)

    def _begin_motion(self, position: float, speed: float, *, shows: bool, steady: bool, from_rest: bool) -> None:
        """Begin with a motion.

        Parameters
        ----------
        position, speed
            Where the axis truly is, in axis unit, and how fast it is to be, in axis unit/s.
        shows
            Whether it is fast enough for the fault to show in the samples themselves, whatever the plant.
        steady
            Whether nothing hides that: it cruises, or is coming to rest in any case.
        from_rest
            Whether the fault is there from rest on, so that all of the motion shows it.
        """
        self._origin, self._speed = position, speed
        is_scale = self.factor > 0.0
        self._is_certain = not is_scale or (shows and steady) or (from_rest and self._is_refused())
        self._is_slow, self._from_rest = is_scale and not shows, from_rest
        self._is_hidden = self.factor < 0.0 and not shows and self._axis.state in BRAKING
        self._ticks_beyond = 0
        self._effort_before = None if shows or self.factor else self._axis.effort
        self._set_bound()
        self._error_allowed += abs(1.0 - self.factor) * self._bound

    def _is_refused(self) -> bool:
        """Whether no plant that could be accepted has this gain while it speeds up, nor this one in a cruise."""
        low, high = REFUSED_GAINS
        gain = self.factor * self._gain
        return not (low < gain < high or low < gain / self._pole < high)

    def _certain_speed(self) -> float:
        return certain_speed(self._axis.design, self._slowest, self._fastest)

    def _cruises(self, speed: float) -> bool:
        """Whether it goes at an even speed, and is not about to change it: it may just have been asked to."""
        asked = self._speed_asked()
        if len(self._speeds) < self._cruise_ticks or (asked and abs(asked - speed) > _CRUISE_SHARE * speed):
            return False
        return max(*self._speeds, speed) - min(*self._speeds, speed) <= _CRUISE_SHARE * speed

    def _speed_asked(self) -> float:
        """Return the speed of the motion under way, in axis unit/s: an axis that speeds up goes on doing so."""
        return abs(self._axis.cruise_velocity) if self._axis.state in COMMANDED else 0.0

    def _set_bound(self) -> None:
        certain = travel_bound(self._axis.design, self._speed, self.factor)
        if (self._gain, self._pole) != (1.0, 1.0):
            certain *= _HIDDEN_SHARE if self._is_hidden else _OFF_MODEL_SHARE
        self._bound = certain if self._is_certain else math.inf

    def _accuracy(self, speed: float) -> float:
        """How well an axis knows its place that was told it at rest or has found it at its slow homing speed.

        Its last sample may be as old as the limit for that.
        """
        settings, design = self._axis.settings, self._axis.design
        homed = 3.0 * settings.homing.slow_velocity * design.period_s
        moved = speed * (settings.limits.stale_feedback_ms / 1e3 + _SAMPLE_AGE_TICKS * design.period_s)
        return settings.window.position + settings.limits.innovation_gate + homed + moved
