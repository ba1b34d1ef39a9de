"""Does the plant still answer the effort as its model says? A test of four models against each other.

Each hypothesis is a disturbance observer for a plant of another gain, fed with the same samples and efforts: the model
itself, and the model with its gain reversed, cut to less than half, and more than doubled. That is what an encoder with
its sign inverted or its scale wrong looks like from outside, or a drive whose gain has changed. Under the true
hypothesis the innovations are smallest. A load that steps surprises all hypotheses alike, so it decides nothing; only
the answer to the effort tells them apart. In an exponential window their squares are summed and compared:
multiple-model estimation (Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, 2001, section 11.6), with a threshold on the ratio in place of its probabilities.

An encoder whose sign turns round in mid-move is a case of its own. At a constant speed it surprises all of them alike:
they all expect the axis to go on. So a further hypothesis expects, from each tick anew, the mirrored motion on a
mirrored plant, and is kept for as long as it explains more than the model does. Nothing else mirrors a motion from one
sample to the next: not a load, which takes its time, and not a collision, whose rebound is slower.
"""

from typing import Final

from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

GAIN_FACTORS: Final = (-1.0, 0.45, 2.2)
"""Gains that the model is tested against, as multiples of its own: a plant that is 30 % off stays nearer to 1."""

FORGETTING: Final = 0.93
"""Weight of the window for each tick of age: a time constant of 14 ticks."""

EVIDENCE: Final = 8.0
"""How many times smaller another hypothesis' sum of squares has to be."""

LEAST_SURPRISE: Final = 0.25
"""Root of the model's sum of squared innovations, as a share of the limit for a single one, below which nothing is
decided: what quantisation and dates leave. A scale needs twice as much: a pole that is off looks like one while the
axis settles."""


MIRRORED_EVIDENCE: Final = 50.0
"""Likewise for the mirrored motion: a rebound from a collision would have to have 0.7 to 1.3 times the speed before."""

MIRRORED_TICKS: Final = 3
"""Samples that a mirrored motion has to explain: a spike is one, and comes back with the next."""


class ModelTest:
    """Compares the model with the hypotheses; give it each tick once.

    Parameters
    ----------
    plant
        The model.
    period_s
        T_s in s.
    noise
        What the observers assume; the same for all.

    Attributes
    ----------
    surprise
        Root of the model's own sum of squared innovations in the window, in axis unit.
    """

    __slots__ = (
        "_limit", "_mirrored", "_mirrored_sum", "_mirrored_ticks", "_observers", "_sum", "_sum_since", "_sums", "_way",
        "surprise",
    )  # fmt: skip

    def __init__(self, plant: Plant, period_s: float, noise: NoiseModel) -> None:
        self._observers = []
        for factor in GAIN_FACTORS:
            sampled = Plant(factor * plant.gain, plant.pole).discretise(period_s)
            gain = kalman_gain(sampled, noise).predictor
            self._observers.append(DisturbanceObserver(sampled, gain, noise.disturbance_memory))
            if factor == -1.0:
                self._mirrored = DisturbanceObserver(sampled, gain, noise.disturbance_memory)
        self._way = 2.0 * self._mirrored.plant.a12
        self._limit = 0.0
        self._sums = [0.0] * len(GAIN_FACTORS)
        self._sum = 0.0
        self.surprise = 0.0
        self._mirrored_sum = self._sum_since = 0.0
        self._mirrored_ticks = 0

    def start(self, observer: DisturbanceObserver) -> None:
        """Begin afresh from the estimate of the law's observer."""
        for hypothesis in self._observers:
            hypothesis.continue_from(observer)
        self._sums = [0.0] * len(GAIN_FACTORS)
        self._sum = self.surprise = 0.0
        self._mirror(observer)

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        for hypothesis in self._observers:
            hypothesis.position += distance
        self._mirrored.position += distance

    def predict(self, effort: float) -> None:
        """Account for a period without a sample, in which `effort` (effort unit) acted."""
        for hypothesis in self._observers:
            hypothesis.predict(effort)
        self._mirrored.predict(effort)

    def update(self, sample: float, effort: float, model: DisturbanceObserver, limit: float) -> None:
        """Take what is known of a tick.

        Parameters
        ----------
        sample, effort
            ``y(k-1)`` in axis unit and ``u(k-1)`` in effort unit.
        model
            The model's own observer, which has taken the sample already.
        limit
            What it may be at the present speed, in axis unit: the test is decided in shares of that.
        """
        innovation = model.innovation
        self._limit = limit
        self._sum = FORGETTING * self._sum + innovation * innovation
        self.surprise = self._sum**0.5
        sums = self._sums
        for index, hypothesis in enumerate(self._observers):
            hypothesis.update(sample, effort)
            sums[index] = FORGETTING * sums[index] + hypothesis.innovation * hypothesis.innovation
        mirrored = self._mirrored
        mirrored.update(sample, effort)
        self._mirrored_sum = FORGETTING * self._mirrored_sum + mirrored.innovation * mirrored.innovation
        self._sum_since = FORGETTING * self._sum_since + innovation * innovation
        self._mirrored_ticks += 1
        if self._sum_since <= self._mirrored_sum:
            self._mirror(model)

    def _mirror(self, model: DisturbanceObserver) -> None:
        """Expect from here on that the axis goes back as it came; the plant is mirrored, its load is not."""
        mirrored = self._mirrored
        mirrored.continue_from(model)
        mirrored.position -= self._way * model.velocity
        mirrored.velocity = -model.velocity
        self._mirrored_sum = self._sum_since = 0.0
        self._mirrored_ticks = 0

    @property
    def better_gain_factor(self) -> float | None:
        """The gain, as a multiple of the model's, of a hypothesis that explains the window far better; else None."""
        if self.surprise <= LEAST_SURPRISE * self._limit:
            return None
        if self._mirrored_ticks >= MIRRORED_TICKS and self._sum_since > MIRRORED_EVIDENCE * self._mirrored_sum:
            return -1.0
        best = min(range(len(GAIN_FACTORS)), key=self._sums.__getitem__)
        factor = GAIN_FACTORS[best]
        enough = factor < 0.0 or self.surprise > 2.0 * LEAST_SURPRISE * self._limit
        return factor if enough and self._sum > EVIDENCE * self._sums[best] else None
