"""The hypothesis that the encoder counts otherwise since some tick: turned round, standing still, or another scale.

At a constant speed the gain says nothing, since a disturbance explains any constant speed. But the measured velocity
changes by ``(f - 1) v`` from one sample to the next, which the mass of the axis forbids. Each hypothesis begins anew
for as long as it explains no more than the accepted plants do, and so keeps the most likely tick of the change: a
sequential test with restarts (E. S. Page, *Continuous inspection schemes*, Biometrika 41, 1954). A change comes within
a period, so its first sample may show any part of it.

It begins from the model's estimate, or from that of the plant that has explained the samples best: while an axis that
is off its model speeds up, the model's own estimate of its speed may be off by half. An encoder that stands still
begins from the model's alone: where it stands from rest on, what explains it best is the plant that moves least.
"""

from typing import Final, NamedTuple

from twostage_servo.control.model_monitor.hypotheses import (
    ACCEPTED,
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

JUMP_SHARE: Final = 0.5
"""Share of the surprise below which nothing is decided that a change has to make within the nominal tick. For an
encoder that stands still twice as much: what moves slowly comes to rest by friction or a load just as well, and only
the effort can tell (axis.limits.jam_effort)."""


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


class Surprise(NamedTuple):
    """What a sample has come to, as the accepted plants see it.

    Attributes
    ----------
    least_square
        The smallest squared innovation of them, in (axis unit)².
    opening_square
        What that has to be for a first sample to show a part of a change.
    model
        The law's own estimate.
    origin
        The estimate of the one that explains the samples best.
    likeliest
        Its index in :data:`~twostage_servo.control.model_monitor.hypotheses.ACCEPTED`.
    """

    least_square: float
    opening_square: float
    model: DisturbanceObserver
    origin: DisturbanceObserver
    likeliest: int


class _Branch:
    """The hypothesis on one of the accepted plants."""

    __slots__ = ("deviation", "nominal_step", "observer", "step", "truth")

    def __init__(self, factor: float, deviation: Deviation, model: Plant, period_s: float, noise: NoiseModel) -> None:
        plant = deviating(model, deviation)
        sampled = plant.discretise(period_s)
        self.deviation = deviation
        if factor:
            self.observer = slow_observer(deviating(model, deviation, factor), period_s, noise)
        else:  # what stands still has neither velocity nor an answer to the effort; its place may be off by noise
            gain = kalman_gain(model.discretise(period_s), noise).current[0]
            self.observer = DisturbanceObserver(DiscretePlant(period_s, 0.0, 0.0, 0.0, 0.0), (gain, 0.0, 0.0))
        self.truth = DisturbanceObserver(sampled, NO_CORRECTION)
        self.step = (1.0 - factor) * sampled.a12
        self.nominal_step = (1.0 - factor) * plant.discretise(max(NOMINAL_S, period_s)).a12


class EncoderChange:
    """The hypothesis that the encoder counts `factor` times as much since a tick of its own choosing.

    Parameters
    ----------
    factor
        -1 turned round, 0 stands still, others a scale.
    model
        The model of the plant.
    period_s
        The tick, in s.
    noise
        What the law's observer assumes.
    follows_likeliest
        Whether it begins from the accepted plant that explains the samples best, and goes on with that one, or with the
        model.

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
        "_branch", "_branches", "_follows_likeliest", "_forgetting", "_friction", "_in_part", "_jump", "_jump_share",
        "_least_ticks", "accepted_sum", "factor", "own_sum", "ticks",
    )  # fmt: skip

    def __init__(
        self, factor: float, model: Plant, period_s: float, noise: NoiseModel, *, follows_likeliest: bool = False
    ) -> None:
        self.factor = factor
        self._follows_likeliest = follows_likeliest
        self._forgetting = forgetting(period_s)
        self._friction = model.pole / model.gain
        self._branches = [
            _Branch(factor, deviation, model, period_s, noise)
            for deviation in (ACCEPTED if follows_likeliest else ACCEPTED[:1])
        ]
        self._jump_share = JUMP_SHARE if factor else 2.0 * JUMP_SHARE
        self._least_ticks = CHANGE_TICKS if factor else samples_in(STANDING_S, period_s, STANDING_TICKS)
        self.begin(self._branches[0].truth, 0)

    def begin(self, origin: DisturbanceObserver, likeliest: int) -> None:
        """Suppose that the change comes with the next sample; the plant and its load go on as before."""
        branch = self._branch = self._branches[likeliest]
        observer, velocity = branch.observer, origin.velocity
        observer.continue_from(origin)
        branch.truth.continue_from(origin)
        self._jump = branch.nominal_step * velocity
        observer.position -= branch.step * velocity
        observer.velocity = self.factor * velocity
        self.own_sum = self.accepted_sum = 0.0
        self.ticks = 0
        self._in_part = False

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self._branch.observer.position += distance
        self._branch.truth.position += distance

    def predict(self, effort: float, late_effort: float) -> None:
        """Account for a period without a sample, in which an effort acted, or a late one on a delayed plant."""
        branch = self._branch
        acting = late_effort if branch.deviation.is_delayed else effort
        branch.observer.predict(acting)
        branch.truth.predict(acting)

    def update(self, sample: float, effort: float, late_effort: float, lag_s: float, surprise: Surprise) -> None:
        """Take a sample, and the effort that acted, or the late one that acted on a delayed plant."""
        branch = self._branch
        observer = branch.observer
        acting = late_effort if branch.deviation.is_delayed else effort
        dated = sample + observer.velocity * lag_s
        if self.factor and not self.ticks and surprise.least_square > surprise.opening_square:
            self._open(dated)
        observer.update(dated, acting)
        branch.truth.predict(acting)
        own = self.own_sum = self._forgetting * self.own_sum + observer.innovation * observer.innovation
        accepted = self.accepted_sum = self._forgetting * self.accepted_sum + surprise.least_square
        self.ticks += 1
        if accepted <= own:
            if self._follows_likeliest:
                self.begin(surprise.origin, surprise.likeliest)
            else:
                self.begin(surprise.model, 0)

    def _open(self, sample: float) -> None:
        """Suppose that the change has come a little later: the first sample shows a part of it.

        Within a period; or, where a drive that sends by a clock of its own does so less often, before its next frame.
        """
        observer = self._branch.observer
        distance = sample - observer.position
        if min(0.0, self._jump) < distance < max(0.0, self._jump):
            observer.position = sample
            self._in_part = True

    def evidence(self) -> float:
        """Return by how much it explains more than the accepted plants, in (axis unit)²."""
        return self.accepted_sum - self.own_sum

    def is_certain(self, least: float, window_sum: float, noise_square: float) -> bool:
        """Whether nothing else explains the samples, and the change has been one from one sample to the next.

        Parameters
        ----------
        least, window_sum, noise_square
            As for :meth:`explains`.
        """
        return (
            self.ticks - PART_TICKS * self._in_part >= self._least_ticks
            and abs(self._jump) > self._jump_share * least
            and self.explains(least, window_sum, noise_square)
        )

    def explains(self, least: float, window_sum: float, noise_square: float) -> bool:
        """Whether nothing else explains the samples.

        Parameters
        ----------
        least
            The surprise that it takes, in axis unit.
        window_sum
            The whole surprise in the window, squared.
        noise_square
            What a sample's noise adds to that, as it was before.
        """
        return (
            self.evidence() > least * least
            and self.accepted_sum > CHANGE_EVIDENCE * (self.own_sum - self._noise_sum(noise_square))
            and self.accepted_sum > CHANGE_RATIO * self.own_sum
            and self.accepted_sum > CHANGE_SHARE * window_sum
        )

    def _noise_sum(self, noise_square: float) -> float:
        """Return what the noise alone makes of the sum of squares, in (axis unit)²; a scale scales it as well."""
        kept = self._forgetting
        return max(1.0, self.factor * self.factor) * noise_square * (1.0 - kept**self.ticks) / (1.0 - kept)

    def reckon(self) -> Reckoning:
        """Return the speed and what disturbs the *model* at it: a load, and the friction that it does not have."""
        truth, plant = self._branch.truth, self._branch.deviation
        missing_friction = (1.0 - plant.pole / plant.gain) * self._friction
        return Reckoning(truth.velocity, truth.disturbance + missing_friction * truth.velocity)
