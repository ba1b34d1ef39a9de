"""The plants and encoders that the test of the model compares, and the times that it counts in.

All that a hypothesis is judged by has a unit of time, never of ticks: an axis is as well known on a tick of 2 ms as on
one of 20 ms. What one tick of :data:`NOMINAL_S` is told by, shorter ones tell by together.
"""

from typing import Final, NamedTuple

from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.per_time import NOMINAL_S, kept_in
from twostage_servo.control.plant import Plant


class Deviation(NamedTuple):
    """A plant beside the model.

    Attributes
    ----------
    gain, pole
        As multiples of the model's.
    is_delayed
        Whether the effort acts later than the model says.
    """

    gain: float
    pole: float
    is_delayed: bool = False


class OtherGain(NamedTuple):
    """What is not accepted: an encoder that counts otherwise from the start, or a plant that answers otherwise.

    Attributes
    ----------
    factor
        How many times as much it shows of the motion.
    plant
        Whose motion that is.
    evidence
        How many times smaller its sum of squares has to be than that of the best accepted plant.
    """

    factor: float
    plant: Deviation
    evidence: float


_PLANTS: Final = (
    Deviation(1.0, 1.0), Deviation(0.7, 1.0), Deviation(1.3, 1.0),
    Deviation(1.0, 0.7), Deviation(1.0, 1.3), Deviation(1.3, 0.7),
)  # fmt: skip

ACCEPTED: Final = (*_PLANTS, *(plant._replace(is_delayed=True) for plant in _PLANTS))
"""Plants that are good enough: the model first."""

OTHER_GAINS: Final = (
    OtherGain(-1.0, Deviation(1.0, 1.0), evidence=8.0),
    OtherGain(-1.0, Deviation(1.3, 0.7), evidence=8.0),
    OtherGain(-1.0, Deviation(0.7, 1.0), evidence=8.0),
    OtherGain(0.3, Deviation(1.0, 1.0), evidence=5.0),
    OtherGain(0.45, Deviation(1.0, 1.0), evidence=5.0),
    OtherGain(0.5, Deviation(1.0, 1.0), evidence=30.0),
    OtherGain(2.0, Deviation(1.0, 1.0), evidence=8.0),
    OtherGain(2.2, Deviation(1.0, 1.0), evidence=5.0),
)
"""Gains that are not. A sign is told from as little as it takes on a plant that is off its model too. A factor of two,
either way, is what a wrong setting of a decoder or a gear makes; beyond that come 0.45, 0.3 and 2.2. The smallest is
near to an axis that hardly answers: half the scale on a plant of a third of the gain, or a drive that keeps its effort
while it should brake. Twice the gain takes as much as a sign: a load that sets in while an axis begins to move, and
helps, looks like it 5 times. Half the gain takes more: while a plant with 30 % less gain and a pole 30 % higher speeds
up, it explains that up to 23 times better than each accepted plant does."""

CHANGE_FACTORS: Final = (-1.0, 0.0, 0.5, 2.0)
"""How many times as much the encoder counts after a change."""

CHANGE_PLANTS: Final = range(len(_PLANTS))
"""Accepted plants of which a change is supposed, by their indices: each whose effort is not delayed. What lies half-way
between two of them is near enough to one. An encoder that stands still is supposed of the model alone."""

_FORGETTING: Final = 0.93
"""Weight of the window for each :data:`NOMINAL_S` of age: a time constant of 138 ms."""

_PROCESS_SHARE: Final = 0.1
"""Share of the observer's process variances that the hypotheses assume, on the nominal tick. The law's observer forgets
quickly, to follow every load; what is slower keeps the difference between two plants in sight for longer."""

_LEAST_DELAY_S: Final = 0.005
_LARGEST_DELAY_S: Final = 0.01
"""How much later than the model says an effort may act: a tick; on shorter ticks as many of them as come nearest to the
cycle of a usual drive's firmware, and no more than what a bus and two such cycles make."""


def forgetting(period_s: float) -> float:
    """Return the weight of the window for each tick of age."""
    return kept_in(_FORGETTING, period_s)


def slow_observer(plant: Plant, period_s: float, noise: NoiseModel) -> DisturbanceObserver:
    """Return the observer of a hypothesis.

    Parameters
    ----------
    plant
        What the samples and efforts are supposed to belong to.
    period_s
        The tick, in s.
    noise
        What the law's observer assumes. On a short tick the variances are a smaller share, since more of them add up.
    """
    share = _PROCESS_SHARE * min(1.0, period_s / NOMINAL_S)
    position, velocity, disturbance = (share * variance for variance in noise.process_variance)
    slower = NoiseModel((position, velocity, disturbance), noise.measurement_variance, noise.disturbance_memory)
    sampled = plant.discretise(period_s)
    return DisturbanceObserver(sampled, kalman_gain(sampled, slower).predictor, noise.disturbance_memory)


def deviating(model: Plant, deviation: Deviation, factor: float = 1.0) -> Plant:
    """Return the plant that the samples seem to belong to where its encoder counts `factor` times as much."""
    return Plant(factor * deviation.gain * model.gain, deviation.pole * model.pole)


class LateEffort:
    """The effort that acts on a plant with delay.

    Parameters
    ----------
    period_s
        The tick, in s.
    """

    __slots__ = ("_efforts", "_next", "_share")

    def __init__(self, period_s: float) -> None:
        self._efforts = [0.0] * max(1, round(_LEAST_DELAY_S / period_s))
        self._share = min(1.0, _LARGEST_DELAY_S / period_s)
        self._next = 0

    def start(self, effort: float) -> None:
        """Suppose that an effort (effort unit) has acted for long."""
        self._efforts = [effort] * len(self._efforts)

    def delay(self, effort: float) -> float:
        """Record the effort of a tick; return the delayed one that acts in it (mean over the tick), in effort unit."""
        before, self._efforts[self._next] = self._efforts[self._next], effort
        self._next = (self._next + 1) % len(self._efforts)
        return effort + self._share * (before - effort)
