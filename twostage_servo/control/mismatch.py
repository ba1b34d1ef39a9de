"""Whether the encoder still shows what the plant does, and the plant answers the effort as its model says.

Hypotheses are tested against the model on every tick. Each is a disturbance observer of its own, fed with the same
samples and efforts; under the true one the innovations are smallest. A load step raises all of them equally, so it does
not discriminate: only the answer to the effort does, or a change that no load can make.

*Accepted plants*: the model, the model 30 % off in gain or pole, and each with a tick of transport delay more. What the
best of them is surprised by is what has to be explained: nothing is decided that a healthy axis could have done.

*Another gain*: reversed, cut to less than half, more than doubled. That is an encoder with its sign or its scale wrong
from the start, or a drive whose gain has changed. Squared innovations are summed in an exponential window and compared:
multiple-model estimation (Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, 2001, section 11.6), with a threshold on the ratio in place of its probabilities.

*A change of the encoder*: from some tick on it counts f times as much, -1 turned round, 0 stands still, 0.5 and 2 a
scale. At a constant speed the gain says nothing, since a disturbance explains any constant speed. But the measured
velocity changes by ``(f - 1) v`` from one sample to the next, which the mass of the axis forbids. Each of these begins
anew, from the model's estimate, for as long as it explains no more than the accepted plants do, and so keeps the most
likely tick of the change: a sequential test with restarts (E. S. Page, *Continuous inspection schemes*, Biometrika 41,
1954). A change comes within a period, so its first sample may show any part of it.

Whichever it is, what the encoder has shown since says nothing of the speed. The model does, run freely from the change
on; :meth:`ModelTest.reckon` gives its state.
"""

from math import inf
from typing import Final, NamedTuple

from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import DiscretePlant, Plant

ACCEPTED: Final = tuple(
    (gain, pole, delay)
    for delay in (0, 1)
    for gain, pole in ((1.0, 1.0), (0.7, 1.0), (1.3, 1.0), (1.0, 0.7), (1.0, 1.3), (1.3, 0.7))
)
"""Gain and pole, as multiples of the model's, and ticks of transport delay more, of plants that are good enough."""

GAIN_FACTORS: Final = (-1.0, 0.45, 2.2)
"""Gains that are not, as multiples of the model's."""

CHANGE_FACTORS: Final = (-1.0, 0.0, 0.5, 2.0)
"""How many times as much the encoder counts after a change."""

FORGETTING: Final = 0.93
"""Weight of the window for each tick of age: a time constant of 14 ticks."""

EVIDENCE: Final = (8.0, 5.0, 5.0)
"""How many times smaller the sum of squares of each of them has to be than that of the best accepted plant."""

STILL_EVIDENCE: Final = 4.0
"""How many times smaller it has to be than that of an encoder that stands still, and shows nothing but noise."""

CHANGE_EVIDENCE: Final = 50.0
"""The same for a change, of what the noise does not explain: a rebound from a collision would have to have 0.7 to 1.3
times the speed before."""

CHANGE_RATIO: Final = 8.0
"""The same with the noise."""

CHANGE_TICKS: Final = 3
"""Samples that a change has to explain: a spike is one, and comes back with the next."""

STANDING_TICKS: Final = 5
"""The same for an encoder that stands still: a load that turns round lets the axis pass standstill within three."""

CHANGE_SHARE: Final = 0.9
"""Share of all surprise in the window that has to have come since the change: it is told only against an estimate that
was right before. A load that has just stepped makes an estimate that is not."""

NOISE_SHARE: Final = 1.25
"""Surprise below which nothing is decided, in standard deviations of the measured position."""

DATE_SHARE: Final = 0.25
"""What is added to it for each axis unit/s of speed, as a share of the time by which dates of samples may be off."""

NOISE_MEMORY: Final = 0.01
"""Share of a sample in the noise that is measured, as half the squared difference of two innovations: what is white
differs from one to the next, what the model does not explain does not."""

JUMP_SHARE: Final = 0.5
"""Share of that surprise which a change has to make in its first sample. For an encoder that stands still twice as
much: what moves slowly comes to rest by friction or a load just as well, and only the effort can tell
(axis.limits.jam_effort)."""


OPENING_DEVIATIONS: Final = 3.0
"""Standard deviations of the measured noise from which a first sample is taken to show a part of a change."""

PART_TICKS: Final = 3
"""Samples more that such a change has to explain: its first is explained by anything, as by a load that has stepped."""

OPENING_SHARE: Final = 0.4
"""Share of the surprise below which nothing is decided, from which it is: what is less may be the model's error."""

PROCESS_SHARE: Final = 0.1
"""Share of the observer's process variances that the hypotheses assume. The law's observer forgets quickly, to follow
every load; what is slower keeps the difference between two plants in sight for longer."""


class Reckoning(NamedTuple):
    """Where the model says the axis is, without what the encoder has shown since it is in doubt.

    Attributes
    ----------
    velocity
        In axis unit/s, by the scale that the encoder should have.
    disturbance
        In effort unit.
    """

    velocity: float
    disturbance: float


class _Change:
    """The hypothesis that the encoder counts `factor` times as much since a tick of its own choosing."""

    __slots__ = (
        "_in_part", "_jump_share", "_least_ticks", "_offset", "_step", "_truth", "accepted_sum", "factor",
        "observer", "own_sum", "ticks",
    )  # fmt: skip

    def __init__(self, factor: float, plant: Plant, period_s: float, noise: NoiseModel) -> None:
        self.factor = factor
        model = plant.discretise(period_s)
        if factor:
            self.observer = _observer(factor, plant, period_s, noise)
        else:  # what stands still has neither velocity nor an answer to the effort; its place may be off by noise
            gain = kalman_gain(model, noise).current[0]
            self.observer = DisturbanceObserver(DiscretePlant(period_s, 0.0, 0.0, 0.0, 0.0), (gain, 0.0, 0.0))
        self._truth = DisturbanceObserver(model, NO_CORRECTION)
        self._step = (1.0 - factor) * model.a12
        self._jump_share = JUMP_SHARE if factor else 2.0 * JUMP_SHARE
        self._least_ticks = CHANGE_TICKS if factor else STANDING_TICKS
        self.begin(self._truth)

    def begin(self, model: DisturbanceObserver) -> None:
        """Suppose that the change comes with the next sample; the plant and its load go on as before."""
        observer = self.observer
        observer.continue_from(model)
        self._offset = self._step * model.velocity
        observer.position -= self._offset
        observer.velocity = self.factor * model.velocity
        self._truth.continue_from(model)
        self.own_sum = self.accepted_sum = 0.0
        self.ticks = 0
        self._in_part = False

    def shift(self, distance: float) -> None:
        self.observer.position += distance

    def predict(self, effort: float) -> None:
        self.observer.predict(effort)
        self._truth.predict(effort)

    def update(
        self,
        sample: float,
        effort: float,
        model: DisturbanceObserver,
        least_square: float,
        lag_s: float,
        opening_square: float,
    ) -> None:
        """Take a sample.

        The smallest squared innovation of the accepted plants, and what it has to be for a first sample to show a part
        of the change, are in (axis unit)².
        """
        observer = self.observer
        dated = sample + observer.velocity * lag_s
        if self.factor and not self.ticks and least_square > opening_square:
            self._open(dated)
        observer.update(dated, effort)
        self._truth.predict(effort)
        own = self.own_sum = FORGETTING * self.own_sum + observer.innovation * observer.innovation
        accepted = self.accepted_sum = FORGETTING * self.accepted_sum + least_square
        self.ticks += 1
        if accepted <= own:
            self.begin(model)

    def _open(self, sample: float) -> None:
        """Suppose that the change has come within the period: the first sample shows a part of it."""
        distance = sample - self.observer.position
        if min(0.0, self._offset) < distance < max(0.0, self._offset):
            self.observer.position = sample
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
            and abs(self._offset) > self._jump_share * least
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
        return max(1.0, self.factor * self.factor) * noise_square * (1.0 - FORGETTING**self.ticks) / (1.0 - FORGETTING)

    def reckon(self) -> Reckoning:
        return Reckoning(self._truth.velocity, self._truth.disturbance)


class ModelTest:
    """Compares the model with the hypotheses; give it each tick once.

    Parameters
    ----------
    plant
        The model.
    period_s
        T_s in s.
    noise
        What the observers assume, the same for all. Its measurement variance is what the encoder's noise is taken for.
    date_error_s
        By how much dates of samples may be off, in s.

    Attributes
    ----------
    surprise
        Root of the sum of the smallest squared innovations of the accepted plants in the window, in axis unit.
    is_sure
        Whether the latest sample surprised an accepted plant by no more than the noise.
    """

    __slots__ = (
        "_accepted", "_changes", "_date_share_s", "_effort_before", "_gains", "_innovation", "_least",
        "_least_at_rest", "_noise_square", "_sample", "_still_sum", "_sum", "_sums", "is_sure", "surprise",
    )  # fmt: skip

    def __init__(self, plant: Plant, period_s: float, noise: NoiseModel, date_error_s: float = 0.0) -> None:
        self._accepted = [
            (_observer(gain, Plant(plant.gain, pole * plant.pole), period_s, noise), delay)
            for gain, pole, delay in ACCEPTED
        ]
        self._gains = [_observer(factor, plant, period_s, noise) for factor in GAIN_FACTORS]
        self._changes = [_Change(factor, plant, period_s, noise) for factor in CHANGE_FACTORS]
        self._least = self._least_at_rest = NOISE_SHARE * noise.measurement_variance**0.5
        self._date_share_s = DATE_SHARE * date_error_s
        self.is_sure = True
        self._sample = self._still_sum = 0.0
        self._innovation = self._noise_square = 0.0
        self._effort_before = 0.0
        self._sums = [0.0] * len(GAIN_FACTORS)
        self._sum = 0.0
        self.surprise = 0.0

    def start(self, model: DisturbanceObserver, effort: float = 0.0) -> None:
        """Begin afresh from the estimate of the law's observer, and the effort (effort unit) that has acted.

        A steady innovation hides a velocity that is off by as much: what follows is no surprise, as if it had been so
        for long.
        """
        for observer, _ in self._accepted:
            observer.continue_from(model)
        for observer in self._gains:
            observer.continue_from(model)
        for change in self._changes:
            change.begin(model)
        self._effort_before = effort
        self._still_sum = 0.0
        self._sample = model.position
        self._sum = model.innovation * model.innovation / (1.0 - FORGETTING)
        self._sums = [self._sum] * len(GAIN_FACTORS)
        self.surprise = self._sum**0.5

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        for observer, _ in self._accepted:
            observer.position += distance
        for observer in self._gains:
            observer.position += distance
        for change in self._changes:
            change.shift(distance)
        self._sample += distance

    def predict(self, effort: float) -> None:
        """Account for a period without a sample, in which `effort` (effort unit) acted."""
        for observer, delay in self._accepted:
            observer.predict(self._effort_before if delay else effort)
        for observer in self._gains:
            observer.predict(effort)
        for change in self._changes:
            change.predict(effort)
        self._effort_before = effort

    def update(
        self, sample: float, effort: float, model: DisturbanceObserver, speed: float, lag_s: float = 0.0
    ) -> None:
        """Take what is known of a tick.

        Parameters
        ----------
        sample, effort
            ``y(k-1)`` in axis unit and ``u(k-1)`` in effort unit.
        model
            The model's own observer, which has taken the sample already.
        speed
            Largest speed of late, in axis unit/s: what dates are off by shows in proportion to it.
        lag_s
            How long before the instant of that effort the sample was taken, in s. Each hypothesis dates it by its own
            velocity: the one that is right by the right one.
        """
        least_square = inf
        for observer, delay in self._accepted:
            observer.update(sample + observer.velocity * lag_s, self._effort_before if delay else effort)
            square = observer.innovation * observer.innovation
            if square < least_square:  # noqa: PLR1730 - `min` takes longer, ten times a tick
                least_square = square
        self._effort_before = effort
        self._sum = FORGETTING * self._sum + least_square
        self.surprise = self._sum**0.5
        self._least = self._least_at_rest + self._date_share_s * speed
        sums = self._sums
        for index, observer in enumerate(self._gains):
            observer.update(sample + observer.velocity * lag_s, effort)
            sums[index] = FORGETTING * sums[index] + observer.innovation * observer.innovation
        step, self._sample = sample - self._sample, sample
        self._still_sum = FORGETTING * self._still_sum + step * step
        difference, self._innovation = model.innovation - self._innovation, model.innovation
        self.is_sure = least_square <= self._least * self._least
        if self.is_sure:
            self._noise_square += NOISE_MEMORY * (0.5 * difference * difference - self._noise_square)
        opening = max(OPENING_DEVIATIONS**2 * self._noise_square, (OPENING_SHARE * self._least) ** 2)
        for change in self._changes:
            change.update(sample, effort, model, least_square, lag_s, opening)

    @property
    def better_factor(self) -> float | None:
        """What the encoder counts, or the plant answers, as a multiple of what it should; None while it may be 1.

        0 stands for an encoder, or an axis, that has stopped from one sample to the next.
        """
        if self.surprise <= self._least:
            return None
        likeliest = max(self._changes, key=_Change.evidence)
        if likeliest.is_certain(self._least, self._sum, self._noise_square):
            return likeliest.factor
        best = min(range(len(GAIN_FACTORS)), key=self._sums.__getitem__)
        if STILL_EVIDENCE * self._sums[best] >= self._still_sum:  # an encoder that stands still explains as much
            return None
        return GAIN_FACTORS[best] if self._sum > EVIDENCE[best] * self._sums[best] else None

    @property
    def seems_to_stand(self) -> bool:
        """Whether an encoder that stands still explains the samples by far, however it has come to stand.

        What moved slowly may have come to rest by friction or a load as well: only an effort that has changed by much
        since makes it a jam, or a fault of the encoder.
        """
        likeliest = max(self._changes, key=_Change.evidence)
        return likeliest.factor == 0.0 and likeliest.explains(self._least, self._sum, self._noise_square)

    def reckon(self, factor: float) -> Reckoning:
        """Return what the model says of the axis, where its encoder is in doubt.

        A plant that answers f times as much, and one whose encoder counts f times as much, look the same; and the same
        effort brings both to rest, that for the measured velocity divided by f.

        Parameters
        ----------
        factor
            :attr:`better_factor`, or 0 for an encoder that shows one and the same position.
        """
        for change in self._changes:
            if change.factor == factor and (
                factor == 0.0 or change.is_certain(self._least, self._sum, self._noise_square)
            ):
                return change.reckon()
        observer = self._gains[GAIN_FACTORS.index(factor)]
        return Reckoning(observer.velocity / factor, observer.disturbance)


def _observer(factor: float, plant: Plant, period_s: float, noise: NoiseModel) -> DisturbanceObserver:
    sampled = Plant(factor * plant.gain, plant.pole).discretise(period_s)
    position, velocity, disturbance = (PROCESS_SHARE * variance for variance in noise.process_variance)
    slower = NoiseModel((position, velocity, disturbance), noise.measurement_variance, noise.disturbance_memory)
    return DisturbanceObserver(sampled, kalman_gain(sampled, slower).predictor, noise.disturbance_memory)
