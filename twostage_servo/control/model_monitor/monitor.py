"""Whether the encoder still shows what the plant does, and the plant answers the effort as its model says.

Hypotheses are tested against the model on every tick. Each is a disturbance observer of its own, fed with the same
samples and efforts; under the true one the innovations are smallest. A load step raises all of them equally, so it does
not discriminate: only the answer to the effort does, or a change that no load can make.

*Accepted plants*: the model, the model 30 % off in gain or pole, and each with a later effort. What the best of them is
surprised by is what has to be explained: nothing is decided that a healthy axis could have done.

*Another gain*: reversed, cut to less than half, more than doubled. That is an encoder with its sign or its scale wrong
from the start, or a drive whose gain has changed. Squared innovations are summed in an exponential window and compared:
multiple-model estimation (Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, 2001, section 11.6), with a threshold on the ratio in place of its probabilities. A reversed sign
is compared over a short window as well: :mod:`twostage_servo.control.model_monitor.reversal`; and one that has turned
round of late, by plants that begin afresh: :mod:`twostage_servo.control.model_monitor.recent_reversal`.

*A change of the encoder*: :mod:`twostage_servo.control.model_monitor.encoder_change`.

Whichever it is, what the encoder has shown since says nothing of the speed. The model does, run freely from the change
on; :meth:`ModelMonitor.reckon` gives its state.
"""

from math import inf
from typing import Final

from twostage_servo.control.estimate import Estimate
from twostage_servo.control.model_monitor.encoder_change import EncoderChange, Reckoning
from twostage_servo.control.model_monitor.hypotheses import (
    ACCEPTED,
    CHANGE_FACTORS,
    CHANGE_PLANTS,
    OTHER_GAINS,
    LateEffort,
    deviating,
    forgetting,
    slow_observer,
)
from twostage_servo.control.model_monitor.identified_plant import IdentifiedPlant
from twostage_servo.control.model_monitor.recent_reversal import RecentReversal
from twostage_servo.control.model_monitor.reversal import ReversalWatch
from twostage_servo.control.model_monitor.surprise import Surprise
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel
from twostage_servo.control.per_time import NOMINAL_S
from twostage_servo.control.plant import Plant

STILL_EVIDENCE: Final = 4.0
"""How many times smaller the sum of squares of another gain has to be than that of an encoder that stands still, and
shows nothing but noise. How far it moves counts from one nominal tick to the next: on a shorter tick its steps are
smaller, and what a hypothesis is off by is not."""

NOISE_SHARE: Final = 1.25
"""Surprise below which nothing is decided, in standard deviations of the measured position."""

DATE_SHARE: Final = 0.25
"""What is added to it for each axis unit/s of speed, as a share of the time by which dates of samples may be off."""

NOISE_MEMORY: Final = 0.01
"""Share of a sample in the noise that is measured, as half the squared difference of two innovations: what is white
differs from one to the next, what the model does not explain does not."""

OPENING_DEVIATIONS: Final = 3.0
"""Standard deviations of the measured noise from which a first sample is taken to show a part of a change."""

OPENING_SHARE: Final = 0.4
"""Share of the surprise below which nothing is decided, from which it is: what is less may be the model's error."""


LASTING_SHARE: Final = 0.25
"""Share of that surprise which another gain has to have caused before the latest sample. One sample is a spike, and
comes back with the next; and where the window has only just begun, it happens to fit one gain or another."""


class ModelMonitor:
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
        "_accepted", "_changes", "_date_share_s", "_forgetting", "_gains", "_identified",
        "_innovation", "_is_lasting", "_late_effort", "_least", "_least_at_rest", "_next", "_noise_square", "_origins",
        "_recent", "_reversal", "_samples", "_still_sum", "_sums", "_window", "is_sure", "surprise",
    )  # fmt: skip

    def __init__(self, plant: Plant, period_s: float, noise: NoiseModel, date_error_s: float = 0.0) -> None:
        self._forgetting = forgetting(period_s)
        self._late_effort = LateEffort(period_s)
        self._accepted = [
            (slow_observer(deviating(plant, deviation), period_s, noise), deviation.is_delayed)
            for deviation in ACCEPTED
        ]
        self._identified = IdentifiedPlant(self._accepted[0][0], period_s, noise.disturbance_memory)
        self._gains = [
            slow_observer(deviating(plant, other.plant, other.factor), period_s, noise) for other in OTHER_GAINS
        ]
        signs = [one for one, other in zip(self._gains, OTHER_GAINS, strict=True) if other.factor < 0.0]
        self._reversal = ReversalWatch(signs, period_s)
        self._recent = RecentReversal(plant, period_s, noise)
        of_plants = [(factor, index) for index in CHANGE_PLANTS for factor in CHANGE_FACTORS if factor or not index]
        self._changes = [EncoderChange(factor, ACCEPTED[i], plant, period_s, noise) for factor, i in of_plants]
        # The law's own observer is the estimate of the model; it may be another one from tick to tick.
        self._origins = [self._accepted[index][0] if index else None for _, index in of_plants]
        self._least: float = NOISE_SHARE * noise.measurement_variance**0.5
        self._least_at_rest = self._least
        self._date_share_s = DATE_SHARE * date_error_s
        self.is_sure = True
        self._is_lasting = False
        self._samples = [0.0] * max(1, round(NOMINAL_S / period_s))  # of the last nominal tick
        self._next = 0
        self._still_sum = 0.0
        self._innovation: float = 0.0
        self._noise_square: float = 0.0
        self._sums = [0.0] * len(OTHER_GAINS)
        self._window = Surprise(self._forgetting, self._accepted[0][0], slow_observer(plant, period_s, noise))
        self.surprise = 0.0

    def start(self, model: DisturbanceObserver, effort: float = 0.0) -> None:
        """Begin afresh from the estimate of the law's observer, and the effort (effort unit) that has acted.

        A steady innovation hides a velocity that is off by as much: what follows is no surprise, as if it had been so
        for long.
        """
        for observer, _ in self._accepted:
            observer.continue_from(model)
        self._identified.start(model, effort)
        for observer in self._gains:
            observer.continue_from(model)
        for change in self._changes:
            change.begin(model)
        self._late_effort.start(effort)
        self._still_sum = 0.0
        self._samples = [model.position] * len(self._samples)
        self._window.start(model.innovation * model.innovation)
        self._sums = [self._window.total] * len(OTHER_GAINS)
        self.surprise = self._window.total**0.5
        self._reversal.start(model.innovation * model.innovation)
        self._recent.start()

    def accept(self, plant: Plant, estimate: Estimate, *, is_late: bool) -> None:
        """Accept a plant that has been identified as well, in place of one before it.

        Parameters
        ----------
        plant, is_late
            The plant, and whether an effort acts a tick later on it than the model says.
        estimate
            Where it is by this plant, a tick after the last sample.
        """
        self._identified.accept(plant, estimate, is_late=is_late)

    def forget_identified(self) -> None:
        """Accept no plant any more but those that the model allows."""
        self._identified.forget()

    def forget_gains(self, model: DisturbanceObserver) -> None:
        """Compare other gains from here on, from the estimate of the law's observer, as an axis sets out from rest.

        What has not moved may count otherwise since, or answer otherwise. How badly another gain explained the last
        braking, and the load that it made up for it, say nothing of the move that begins.
        """
        for observer in self._gains:
            observer.continue_from(model)
        self._sums = [self._window.total] * len(OTHER_GAINS)
        self._reversal.start(0.0)
        self._recent.start()

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        for observer, _ in self._accepted:
            observer.shift(distance)
        self._identified.shift(distance)
        self._window.shift(distance)
        for observer in self._gains:
            observer.shift(distance)
        for change in self._changes:
            change.shift(distance)
        self._recent.start()
        self._samples = [sample + distance for sample in self._samples]

    def predict(self, effort: float) -> None:
        """Account for a period without a sample, in which `effort` (effort unit) acted."""
        late_effort = self._late_effort.delay(effort)
        for observer, is_delayed in self._accepted:
            observer.predict(late_effort if is_delayed else effort)
        self._identified.predict(effort)
        self._window.predict(effort)
        for observer in self._gains:
            observer.predict(effort)
        for change in self._changes:
            change.predict(effort)
        self._recent.start()

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
        late_effort = self._late_effort.delay(effort)
        least_square = self._compare_accepted(sample, effort, late_effort, lag_s)
        kept, sums = self._forgetting, self._sums
        for index, observer in enumerate(self._gains):
            observer.update(sample + observer.velocity * lag_s, effort)
            sums[index] = kept * sums[index] + observer.innovation * observer.innovation
        step = sample - self._samples[self._next]
        self._samples[self._next] = sample
        self._next = (self._next + 1) % len(self._samples)
        self._still_sum = kept * self._still_sum + step * step
        self._reversal.update(least_square, step * step)
        dated = sample + model.velocity * lag_s
        self._recent.update(dated, effort, late_effort, least_square, is_surprised=self._is_lasting)
        self._least = self._least_at_rest + self._date_share_s * speed
        self.is_sure = least_square <= self._least * self._least
        noise_square = self._noise_square
        self._measure_noise(model.innovation)
        opening_square = self._opening_square()
        for change, origin in zip(self._changes, self._origins, strict=True):
            change.update(
                sample, effort, lag_s, origin or model, least_square, opening_square, self._least, noise_square
            )

    def _compare_accepted(self, sample: float, effort: float, late_effort: float, lag_s: float) -> float:
        """Give the accepted plants a tick, and return their smallest squared innovation in (axis unit)²."""
        least_square = inf
        for observer, is_delayed in self._accepted:
            observer.update(sample + observer.velocity * lag_s, late_effort if is_delayed else effort)
            square = observer.innovation * observer.innovation
            if square < least_square:  # noqa: PLR1730 - `min` takes longer, ten times a tick
                least_square = square
        least_square = min(least_square, self._identified.update(sample, effort, lag_s))
        self._is_lasting = self.surprise > LASTING_SHARE * self._least
        self._window.update(least_square, sample, effort, lag_s, self._least * self._least)
        self.surprise = self._window.total**0.5
        return least_square

    def _measure_noise(self, innovation: float) -> None:
        difference, self._innovation = innovation - self._innovation, innovation
        if self.is_sure:
            self._noise_square += NOISE_MEMORY * (0.5 * difference * difference - self._noise_square)

    def _opening_square(self) -> float:
        deviation: float = OPENING_SHARE * self._least
        noise_square: float = OPENING_DEVIATIONS * OPENING_DEVIATIONS * self._noise_square
        return max(noise_square, deviation * deviation)

    @property
    def better_factor(self) -> float | None:
        """What the encoder counts, or the plant answers, as a multiple of what it should; None while it may be 1.

        0 stands for an encoder, or an axis, that has stopped from one sample to the next.
        """
        if self.surprise <= self._least:
            return None
        if certain := [change for change in self._changes if self._is_certain(change)]:
            return max(certain, key=EncoderChange.evidence).factor
        if not self._is_lasting:
            return None
        if self._reversal.is_certain(self._least, STILL_EVIDENCE) or self._recent.is_certain(self._least):
            return -1.0
        needed = [other.evidence * total for other, total in zip(OTHER_GAINS, self._sums, strict=True)]
        least = min(needed)
        best = needed.index(least)
        if STILL_EVIDENCE * self._sums[best] >= self._still_sum:  # an encoder that stands still explains as much
            return None
        return OTHER_GAINS[best].factor if self._window.total > least else None

    @property
    def least(self) -> float:
        """Surprise below which nothing is decided, in axis unit."""
        return self._least

    @property
    def least_jump_velocity(self) -> float:
        """Speed (axis unit/s) from which on any of the changes that it supposes is a jump, of every plant supposed.

        Infinity where late samples hide as much at any speed.
        """
        return max(change.jump_velocity(self._least_at_rest, self._date_share_s) for change in self._changes)

    def _is_certain(self, change: EncoderChange) -> bool:
        return change.is_certain(self._least, self._window.lasting, self._noise_square)

    @property
    def seems_to_stand(self) -> bool:
        """Whether an encoder that stands still explains the samples by far, however it has come to stand.

        What moved slowly may have come to rest by friction or a load as well: only an effort that has changed by much
        since makes it a stall, or a fault of the encoder.
        """
        likeliest = max(self._changes, key=EncoderChange.evidence)
        return likeliest.factor == 0.0 and likeliest.explains(self._least, self._window.lasting, self._noise_square)

    def reckon(self, factor: float) -> Reckoning:
        """Return what the model says of the axis, where its encoder is in doubt.

        A plant that answers f times as much, and one whose encoder counts f times as much, look the same; and the same
        effort brings both to rest, that for the measured velocity divided by f.

        Parameters
        ----------
        factor
            :attr:`better_factor`, or 0 for an encoder that shows one and the same position.
        """
        if factor == 0.0:
            return next(change for change in self._changes if change.factor == 0.0).reckon()
        if changes := [change for change in self._changes if change.factor == factor and self._is_certain(change)]:
            # What less than it takes to decide anything does not tell apart is likelier of the model.
            enough = max(min(change.own_sum for change in changes), self._least * self._least)
            return next(change for change in changes if change.own_sum <= enough).reckon()
        if factor < 0.0 and self._recent.is_certain(self._least):
            return self._recent.reckon()
        likely = [(self._sums[index], index) for index, other in enumerate(OTHER_GAINS) if other.factor == factor]
        in_short = factor < 0.0 and self._reversal.is_certain(self._least, STILL_EVIDENCE)
        _, best = likely[self._reversal.likeliest] if in_short else min(likely)
        observer, gain = self._gains[best], OTHER_GAINS[best].plant.gain
        return Reckoning(observer.velocity / (factor * gain), observer.disturbance)
