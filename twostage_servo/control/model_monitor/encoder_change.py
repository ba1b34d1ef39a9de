"""The hypothesis that the encoder counts otherwise since some tick: turned round, standing still, or another scale.

At a constant speed the gain says nothing, since a disturbance explains any constant speed. But the measured velocity
changes by ``(f - 1) v`` from one sample to the next, which the mass of the axis forbids. Each hypothesis begins anew
for as long as it explains no more than the accepted plants do, and so keeps the most likely tick of the change: a
sequential test with restarts (E. S. Page, *Continuous inspection schemes*, Biometrika 41, 1954). A change comes within
a period, so its first sample may show any part of it.

An encoder that turns round while the axis stands, or nearly so, makes no jump. It is told by the answer to the effort,
which takes longer: the axis runs away from whatever should bring it back.

A hypothesis belongs to one accepted plant, and begins from that plant's own estimate of speed and load. While an axis
that is off its model speeds up or slows down, the model's estimate of its speed may be off by half; and where it has
only begun to, nothing tells yet which plant is the true one. An encoder that stands still is supposed of the model
alone: where it stands from rest on, what explains it best is the plant that moves least.
"""

from math import inf
from typing import Final, NamedTuple

from twostage_servo.control.model_monitor.hypotheses import (
    Deviation,
    deviating,
    forgetting,
    slow_observer,
)
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.per_time import NOMINAL_S, samples_in
from twostage_servo.control.plant import DiscretePlant, Plant

CHANGE_EVIDENCE: Final = 50.0
"""How many times smaller the sum of squares of a change has to be than that of the accepted plants, of what the noise
does not explain: a rebound from a collision would have to have 0.7 to 1.3 times the speed before."""

CHANGE_RATIO: Final = 8.0
"""The same with the noise."""

NOISE_RATIO: Final = 8.0
"""How many times smaller what the noise alone makes has to be. Behind a noisy encoder a load has looked like half the
scale, 48 times better, while all that this did not explain was put down to the noise."""

CHANGE_TICKS: Final = 3
"""Samples that a change has to explain, however soon they come: a spike is one, and comes back with the next."""

STANDING_TICKS: Final = 5
STANDING_S: Final = 0.05
"""The same for an encoder that stands still: a load that turns round lets the axis pass standstill within 30 ms."""

PART_TICKS: Final = 3
"""Samples more that a change has to explain whose first sample shows a part of it: that one is explained by anything,
as by a load that has stepped."""

CHANGE_SHARE: Final = 0.9
"""Share of all surprise in the window that has to have come since the change: it is told only against an estimate that
was right before. A load that has just stepped makes an estimate that is not."""

BEYOND_DOUBT: Final = 300.0
BEYOND_DOUBT_TICKS: Final = 6
BEYOND_DOUBT_SURPRISE: Final = 3.0
"""How many times smaller the sum of squares of a change has to be, with noise and all, in how many samples, and the
surprise that this takes, as a multiple of the one below which nothing is decided, to be told against any estimate. On
500 healthy axes under heavy loads it was 108 times smaller at most, and 35 times but for one of them."""

ANSWER_S: Final = 0.05
ANSWER_SURPRISE: Final = 4.0
"""Time after which an encoder that turned round near standstill, where nothing jumps, is told by the answer to the
effort alone, and the surprise that this takes, as a multiple of the one below which nothing is decided. A load that
turns the axis round against its effort surprises as well, but by less in that time."""

RUNAWAY_S: Final = 0.14
RUNAWAY_SURPRISE: Final = 10.0
"""Time after which an encoder that turned round needs no more evidence than that ratio, and the surprise that this
takes, as such a multiple. A load that changed just before spoils the evidence for as long as the axis runs away ever
faster. A load alone of up to 15 V, three times what acts against it, looks the same for up to 100 ms."""

PATIENCE: Final = 3.0
"""By how much, as a multiple of that surprise squared, an encoder that turned round may explain *less* than the
accepted plants without beginning anew. Near standstill one or the other of those explains each of the first samples,
and a hypothesis that began anew until none of them does would begin from a speed that they have adapted to what is
wrong. On 500 healthy axes under heavy loads 13 were taken for reversed ones, and 17 with 0.3 in place of 3: where it
begins anew less often, a load looks like a reversal less often."""

JUMP_SHARE: Final = 0.5
"""Share of the surprise below which nothing is decided that a change has to make within the nominal tick. For an
encoder that stands still twice as much: what moves slowly comes to rest by friction or a load just as well, and only
the effort can tell (axis.limits.stall_effort)."""


class Reckoning(NamedTuple):
    """Where the model says the axis is, without what the encoder has shown since it is in doubt.

    Attributes
    ----------
    velocity
        In axis unit/s, by the scale that the encoder should have.
    disturbance
        Of the model, in effort unit.
    """

    velocity: float
    disturbance: float


class EncoderChange:
    """The hypothesis that the encoder counts `factor` times as much since a tick of its own choosing.

    Parameters
    ----------
    factor
        -1 turned round, 0 stands still, others a scale.
    deviation
        Of which accepted plant that is supposed; one whose effort is not delayed.
    model
        The model of the plant.
    period_s
        The tick, in s.
    noise
        What the law's observer assumes.

    Attributes
    ----------
    factor
        As given.
    ticks
        Samples since the change.
    own_sum, accepted_sum
        Squared innovations of this hypothesis, and the smallest ones of the accepted plants, since then, in
        (axis unit)².
    """

    __slots__ = (
        "_answer_ticks", "_disturbance", "_forgetting", "_has_explained_less", "_has_set_out", "_in_part",
        "_jump_share", "_least_ticks", "_missing_friction", "_noise_before", "_nominal_step", "_observer", "_patience",
        "_position", "_runaway_ticks", "_step", "_truth", "_velocity", "accepted_sum", "factor", "own_sum", "ticks",
    )  # fmt: skip

    def __init__(self, factor: float, deviation: Deviation, model: Plant, period_s: float, noise: NoiseModel) -> None:
        self.factor = factor
        plant = deviating(model, deviation)
        sampled = plant.discretise(period_s)
        if factor:
            self._observer = slow_observer(deviating(model, deviation, factor), period_s, noise)
        else:  # what stands still has neither velocity nor an answer to the effort; its place may be off by noise
            gain = kalman_gain(model.discretise(period_s), noise).current[0]
            self._observer = DisturbanceObserver(DiscretePlant(period_s, 0.0, 0.0, 0.0, 0.0), (gain, 0.0, 0.0))
        self._truth = DisturbanceObserver(sampled, NO_CORRECTION)
        self._step = (1.0 - factor) * sampled.a12
        self._nominal_step = (1.0 - factor) * plant.discretise(max(NOMINAL_S, period_s)).a12
        self._missing_friction = (1.0 - deviation.pole / deviation.gain) * model.pole / model.gain
        self._forgetting = forgetting(period_s)
        self._jump_share = JUMP_SHARE if factor else 2.0 * JUMP_SHARE
        self._least_ticks = CHANGE_TICKS if factor else samples_in(STANDING_S, period_s, STANDING_TICKS)
        self._answer_ticks = samples_in(ANSWER_S, period_s, STANDING_TICKS) if factor < 0.0 else inf
        self._runaway_ticks = samples_in(RUNAWAY_S, period_s, STANDING_TICKS) if factor < 0.0 else inf
        self._patience = PATIENCE if factor < 0.0 else 0.0
        self.begin(self._truth)

    def begin(self, origin: DisturbanceObserver) -> None:
        """Suppose that the change comes with the next sample; the plant and its load go on as `origin` has them."""
        self._position, self._velocity, self._disturbance = origin.position, origin.velocity, origin.disturbance
        self.own_sum = self.accepted_sum = 0.0
        self.ticks = 0
        self._noise_before = 0.0
        self._in_part = self._has_set_out = self._has_explained_less = False

    def _set_out(self) -> None:
        """Let the observers go on from where the change begins.

        While it begins anew with each sample, which is nearly always, they would do so for nothing.
        """
        position, velocity, disturbance = self._position, self._velocity, self._disturbance
        self._observer.go_on_from(position - self._step * velocity, self.factor * velocity, disturbance)
        self._truth.go_on_from(position, velocity, disturbance)
        self._has_set_out = True

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self._position += distance
        self._observer.shift(distance)
        self._truth.shift(distance)

    def predict(self, effort: float) -> None:
        """Account for a period without a sample, in which an effort (effort unit) acted."""
        if not self._has_set_out:
            self._set_out()
        self._observer.predict(effort)
        self._truth.predict(effort)

    def update(
        self,
        sample: float,
        effort: float,
        lag_s: float,
        origin: DisturbanceObserver,
        least_square: float,
        opening_square: float,
        least: float,
        noise_square: float,
    ) -> None:
        """Take a sample.

        Parameters
        ----------
        sample, effort
            In axis unit, and the effort that acted, in effort unit.
        lag_s
            How much older than that effort the sample is, in s.
        origin
            The plant's own estimate, which has taken the sample already: where it begins anew.
        least_square
            The smallest squared innovation of the accepted plants, in (axis unit)².
        opening_square
            What that has to be for a first sample to show a part of a change.
        least
            The surprise that it takes to decide anything, in axis unit.
        noise_square
            What the noise of a sample adds to a sum of squares, as it was before this one, in (axis unit)².
        """
        if not self._has_set_out:
            velocity = self._velocity
            expected = self._position - self._step * velocity
            innovation = sample + self.factor * velocity * lag_s - expected
            may_open = self.factor and least_square > opening_square
            if least_square <= innovation * innovation and not may_open:
                self._position, self._velocity, self._disturbance = origin.position, origin.velocity, origin.disturbance
                return
            self._set_out()
        observer = self._observer
        dated = sample + observer.velocity * lag_s
        if self.factor and not self.ticks and least_square > opening_square:
            self._open(dated)
        observer.update(dated, effort)
        self._truth.predict(effort)
        own = self.own_sum = self._forgetting * self.own_sum + observer.innovation * observer.innovation
        accepted = self.accepted_sum = self._forgetting * self.accepted_sum + least_square
        if not self.ticks:
            self._noise_before = noise_square
        self.ticks += 1
        if accepted <= own:
            if accepted + self._patience * least * least <= own:
                self.begin(origin)
            else:
                self._has_explained_less = True

    def _open(self, sample: float) -> None:
        """Suppose that the change has come a little later: the first sample shows a part of it.

        Within a period; or, where a drive that sends by a clock of its own does so less often, before its next frame.
        """
        observer = self._observer
        distance = sample - observer.position
        jump = self._nominal_step * self._velocity
        if min(0.0, jump) < distance < max(0.0, jump):
            observer.place(sample)
            self._in_part = True

    def evidence(self) -> float:
        """Return by how much it explains more than the accepted plants, in (axis unit)²."""
        return self.accepted_sum - self.own_sum

    def jump_velocity(self, least_at_rest: float, date_share_s: float) -> float:
        """Return the speed (axis unit/s) from which on the change is a jump.

        Parameters
        ----------
        least_at_rest, date_share_s
            The surprise that it takes to decide anything, in axis unit, and what is added to it for each axis unit/s.
        """
        shown_s = abs(self._nominal_step) - self._jump_share * date_share_s
        return self._jump_share * least_at_rest / shown_s if shown_s > 0.0 else inf

    def is_certain(self, least: float, window_sum: float, noise_square: float) -> bool:
        """Whether nothing else explains the samples, and the change has been a jump or has been answered for long.

        Parameters
        ----------
        least, window_sum, noise_square
            As for :meth:`explains`.
        """
        if self.ticks - PART_TICKS * self._in_part < self._least_ticks:
            return False
        jumps = abs(self._nominal_step * self._velocity) > self._jump_share * least and not self._has_explained_less
        return (jumps or self._is_answered(least)) and self.explains(least, window_sum, noise_square)

    def _is_answered(self, least: float) -> bool:
        enough = ANSWER_SURPRISE * least
        return self.ticks >= self._answer_ticks and self.accepted_sum > enough * enough

    def explains(self, least: float, window_sum: float, noise_square: float) -> bool:
        """Whether nothing else explains the samples.

        Parameters
        ----------
        least
            The surprise that it takes, in axis unit.
        window_sum
            The whole surprise in the window, squared.
        noise_square
            What the noise of a sample adds to that, by now.
        """
        enough = RUNAWAY_SURPRISE * least
        runs_away = self.ticks >= self._runaway_ticks and self.accepted_sum > enough * enough
        needed = CHANGE_RATIO if runs_away else CHANGE_EVIDENCE
        noise_sum = self._noise_sum(noise_square)
        return (
            self.evidence() > least * least
            and self.accepted_sum > needed * (self.own_sum - noise_sum)
            and self.accepted_sum > NOISE_RATIO * self._noise_sum(self._noise_before)
            and self.accepted_sum > CHANGE_RATIO * self.own_sum
            and (self.accepted_sum > CHANGE_SHARE * window_sum or self._is_beyond_doubt(least))
        )

    def _is_beyond_doubt(self, least: float) -> bool:
        enough = BEYOND_DOUBT_SURPRISE * least
        return (
            self.ticks >= BEYOND_DOUBT_TICKS
            and self.evidence() > enough * enough
            and self.accepted_sum > BEYOND_DOUBT * self.own_sum
        )

    def _noise_sum(self, noise_square: float) -> float:
        """Return what the noise alone makes of the sum of squares, in (axis unit)²; a scale scales it as well."""
        kept = self._forgetting
        return max(1.0, self.factor * self.factor) * noise_square * (1.0 - kept**self.ticks) / (1.0 - kept)

    def reckon(self) -> Reckoning:
        """Return the speed and what disturbs the *model* at it: a load, and the friction that it does not have."""
        if not self._has_set_out:
            self._set_out()
        truth = self._truth
        return Reckoning(truth.velocity, truth.disturbance + self._missing_friction * truth.velocity)
