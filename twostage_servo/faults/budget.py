"""How far the axis may travel after a fault: derived from the limits, the model and what the move would have been.

No figure here comes from a run with a fault in it. A reaction has three parts: what passes unnoticed, until a limit
says that something is wrong; the latency of a tick or two; and coming to rest. Speeds are those of the same move
without the fault.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.motion import IMPLAUSIBLE_SAMPLES
from twostage_servo.control.plant import MODEL_ERROR
from twostage_servo.faults.servo_gains import servo_gains_of
from twostage_servo.faults.world import Sample

_SAMPLE_AGE_TICKS = 2
"""A fault may fall just behind a sample, and a sample is read a tick after it was taken."""


@dataclass(frozen=True, slots=True)
class Reference:
    """The move as it is without the fault.

    Attributes
    ----------
    samples
        One for each tick.
    time_s
        When the fault begins, in s.
    to_go
        Distance to the set-point at that moment, in axis unit.
    closing
        Whether that is in the position stage of a move.
    window_s
        How long before a moment the sample may lie that tells of it, and how long behind, in s.
    """

    samples: Sequence[Sample]
    time_s: float
    to_go: float
    closing: bool
    window_s: float = 0.02

    def peak_speed(self, duration_s: float) -> float:
        """Return the largest speed from the fault on, for a time in s; in axis unit/s."""
        return max(
            (
                abs(s.velocity)
                for s in self.samples
                if self.time_s - self.window_s <= s.time_s <= self.time_s + duration_s + self.window_s
            ),
            default=0.0,
        )

    def effort(self) -> float:
        """Return the magnitude of the effort with which the fault begins, in effort unit."""
        return next((abs(s.effort) for s in reversed(self.samples) if s.time_s <= self.time_s), 0.0)

    def remaining(self) -> float:
        """Return how far it still goes from the fault on, in axis unit."""
        after = [s.position for s in self.samples if s.time_s >= self.time_s - self.window_s]
        return max(abs(position - after[0]) for position in after) if after else 0.0

    def length(self) -> float:
        """Return how far the whole move goes, in axis unit."""
        return max(abs(sample.position - self.samples[0].position) for sample in self.samples)


class Budget:
    """Distances (axis unit) that one fault in one phase may cost.

    Parameters
    ----------
    design
        The axis.
    reference
        The move without the fault.
    command_timeout_s
        After which silence the drive disables itself, in s.
    cycle_s
        How long the drive's firmware may take to read a command, in s.
    """

    def __init__(self, design: AxisDesign, reference: Reference, command_timeout_s: float, cycle_s: float) -> None:
        self.design = design
        self.limits = design.settings.limits
        self.reference = reference
        self.command_timeout_s = command_timeout_s
        self.tick_s = design.period_s
        self._since_s = reference.time_s - reference.window_s
        self._latency_s = cycle_s + design.period_s
        self._pole = design.settings.plant.pole
        self._gain = abs(design.settings.plant.gain)

    def innovation_gate(self, speed: float) -> float:
        """Return how far a sample may lie from its prediction at a speed in axis unit/s."""
        return self.limits.innovation_gate + 1e-3 * self.limits.innovation_time_ms * speed

    # What is tolerated -----------------------------------------------------------------------------------------------

    def unnoticed(self) -> float:
        """Return what could not be told from an ordinary move: the position window."""
        return self.design.settings.window.position

    def bridged(self) -> float:
        """Return what ticks without a sample cost: an estimate off by more than the innovation gate would trip."""
        return self.innovation_gate(self.reference.peak_speed(0.0)) + self.unnoticed()

    def followed(self) -> float:
        """Return what the law has to work off: the following error that is allowed at the move's speed."""
        speed = max(self.reference.peak_speed(60.0), self.design.settings.cruise_velocity)
        return max(self.limits.following_error_minimum, self.limits.following_error_time_s * speed)

    def late(self, share: float) -> float:
        """Return what ticks cost each of which may come late by a share of its period.

        The move begins so much later. Each change of the effort acts so much later, and ends in another place by that
        time, times the change, times the plant's static gain: at most by all changes of the undisturbed move together.
        And the samples that are late by as much are bridged, or would trip.
        """
        late_s = share * self.tick_s
        efforts = [sample.effort for sample in self.reference.samples if sample.time_s >= self._since_s]
        changes = sum(abs(after - before) for before, after in itertools.pairwise(efforts))
        speed = self.reference.peak_speed(60.0)
        return (
            speed * late_s + self._gain / self._pole * changes * late_s + self.innovation_gate(speed) + self.unnoticed()
        )

    # What comes to rest ----------------------------------------------------------------------------------------------

    def detection_s(self, ticks: float) -> float:
        """Return how long a fault that shows in each sample goes on until `ticks` of them have been seen, in s."""
        return (ticks + _SAMPLE_AGE_TICKS) * self.tick_s

    def coasting(self, detected_s: float, extra_speed: float = 0.0) -> float:
        """Return the way unnoticed for a time in s, then without effort: the plant's own friction stops it."""
        speed = self.reference.peak_speed(detected_s) + extra_speed
        return speed * (detected_s + self._latency_s) + speed / (self._pole * (1.0 - MODEL_ERROR)) + self.unnoticed()

    def stopping(self, detected_s: float, deceleration: float, extra_speed: float = 0.0) -> float:
        """Return the way unnoticed for a time in s, then down a ramp, by so much more as the plant is off its model."""
        speed = self.reference.peak_speed(detected_s) + extra_speed
        ramp = self.design.certain_stopping_distance(speed, deceleration)
        return speed * (detected_s + self._latency_s) + ramp + self.unnoticed()

    def quick_stop(self, detected_s: float, extra_speed: float = 0.0) -> float:
        """Return the same as :meth:`stopping`, with the quick stop deceleration."""
        return self.stopping(detected_s, self.limits.quick_stop_deceleration, extra_speed)

    def stale(self) -> float:
        """Return what missing feedback costs: quick stop on the model, after the limit."""
        return self.quick_stop(self.detection_s(self.limits.stale_feedback_ms / (1e3 * self.tick_s)))

    def implausible(self) -> float:
        """Return what samples beyond the innovation gate cost: quick stop on the model, after two."""
        return self.quick_stop(self.detection_s(IMPLAUSIBLE_SAMPLES))

    def blind_encoder(self) -> float:
        """Return what an encoder costs that stands still while its counter lives.

        At a speed whose tick is longer than the innovation gate, samples become implausible at once. Below, the law
        raises the effort until it has changed by the stall effort: by f22 a tick for each unit of speed or distance
        that is missing. The effort may drive the axis by so much faster meanwhile.
        """
        speed = self.reference.peak_speed(0.0)
        if speed * self.tick_s > self.innovation_gate(speed):
            return self.implausible()
        missing = self.reference.to_go if self.reference.closing else self.design.settings.cruise_velocity
        f22 = servo_gains_of(self.design).f22
        ticks = max(
            self.design.ticks(self.limits.stall_time_ms),
            self.limits.stall_effort / (f22 * missing),
        )
        detected_s = self.detection_s(ticks + self.design.ticks(self.limits.stall_time_ms))
        added = self._gain / self._pole * self.limits.stall_effort * (1.0 + MODEL_ERROR)
        return self.quick_stop(detected_s, added)

    def wrong_encoder(self) -> float:
        """Return what a reversed sign costs: it is noticed within ten times the innovation gate at that speed."""
        allowed = 10.0 * self.innovation_gate(self.design.settings.cruise_velocity)
        return allowed + self.quick_stop(self.detection_s(IMPLAUSIBLE_SAMPLES))

    def doubled_scale(self) -> float:
        """Return what an encoder costs that counts twice: the axis goes half as far as it seems until it is noticed."""
        return 0.5 * self.reference.remaining() + self.wrong_encoder()

    def halved_scale(self) -> float:
        """Return what an encoder costs that counts half.

        What it hides is noticed like a reversed sign; meanwhile the axis goes twice as far as it shows, and up to twice
        as fast.
        """
        allowed = 2.0 * 10.0 * self.innovation_gate(self.design.settings.cruise_velocity)
        detected_s = self.detection_s(IMPLAUSIBLE_SAMPLES)
        return allowed + self.quick_stop(detected_s, self.reference.peak_speed(detected_s))

    def hidden_scale(self) -> float:
        """Return what an encoder costs that counts half, and so looks like the model itself: twice the way."""
        return self.reference.remaining() + self.followed()

    def unreachable_speed(self, share: float) -> float:
        """Return what a plant costs that reaches only a share of the velocity limit at the effort limit.

        The speed stage works against it as an integrator around the plant's static gain K, so the effort nears what the
        speed would take, limit/share, by the part ``f22 K / (1 + f12 K)`` of what is missing in a tick. From the
        effort of the moment to the limit that takes the logarithm of how much is missing then and there; beside it
        there are the ramp of the reference and the plant's own lag. Then the limit's time begins.
        """
        limits, gains = self.limits, servo_gains_of(self.design)
        reachable = share * limits.velocity
        static_gain = reachable / limits.effort
        f12, f22 = abs(gains.f12), abs(gains.f22)
        part = f22 * static_gain / (1.0 + f12 * static_gain)
        goal = limits.effort / share
        ticks = math.log((goal - self.reference.effort()) / (goal - limits.effort)) / part
        ramp_s = limits.velocity / limits.acceleration
        saturated_s = ramp_s + 1.0 / self._pole + ticks * self.tick_s
        return self.stopping(
            saturated_s + self.detection_s(self.design.ticks(limits.effort_saturation_ms)), limits.acceleration
        )

    def disarmed(self) -> float:
        """Return what an axis goes when it is disarmed: it brakes, then coasts from what counts as standstill.

        On a plant that is off its model a steep stop swings back, but it never costs more than coasting would.
        """
        rest = self.design.rest_velocity / (self._pole * (1.0 - MODEL_ERROR))
        detected_s = self.detection_s(0)
        return max(self.stopping(detected_s, self.limits.acceleration), self.coasting(detected_s)) + rest

    def moved_while_disabled(self, gates: float) -> float:
        """Return the way of an axis that something moves by so many innovation gates, as far as its plant is known."""
        return gates * self.limits.innovation_gate * (1.0 + MODEL_ERROR) / (1.0 - MODEL_ERROR)

    def contradicted(self) -> float:
        """Return what a heartbeat costs that contradicts the feedback: it is believed after three times its limit."""
        return self.coasting(3.0 * self.limits.heartbeat_ms / 1e3 + self.detection_s(1))

    def runaway(self, detected_s: float) -> float:
        """Return the move's own way, then what the following error allows, then until a braking counts as failed."""
        speed = self.reference.peak_speed(60.0)
        braking_s = 2.0 * self.design.stopping_time_s(speed, self.limits.quick_stop_deceleration)
        return self.reference.remaining() + self.followed() + speed * braking_s + self.coasting(detected_s)
