"""The hypothesis that the encoder has been turned round for a little while, and nothing has jumped.

Near standstill an encoder that turns round makes no jump, and while the axis brakes an accepted plant explains it: its
observer takes what it sees for a load. When the axis then runs away, each of these observers is off by what it has
taken so, and so are those of a sign that was wrong from the start. So what explains the samples is asked afresh, of
plants that begin in the same instant: position, speed and acceleration follow from three samples, and what acts beside
the effort from the acceleration, of reversed plants and of each accepted one alike. From there on only what the effort
*changes* tells them apart: a load pushes whatever the effort does, a reversed encoder ever more as the effort grows.

They begin anew for as long as an accepted one explains no less: a sequential test with restarts (E. S. Page,
*Continuous inspection schemes*, Biometrika 41, 1954). They are idle while nothing surprises, and forget at a tick
without a sample: behind a drive that sends less often than the axis ticks they tell nothing.
"""

from typing import Final, NamedTuple

from twostage_servo.control.model_monitor.encoder_change import Reckoning
from twostage_servo.control.model_monitor.hypotheses import ACCEPTED, OTHER_GAINS, Deviation, deviating, slow_observer
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel
from twostage_servo.control.per_time import kept_in, samples_in
from twostage_servo.control.plant import Plant

_FORGETTING: Final = 0.8
"""Weight of the window for each nominal tick of age, as in :mod:`.reversal`."""

_LEAST_S: Final = 0.05
_LEAST_TICKS: Final = 5
"""Time, and samples, for which a reversed plant has to explain more than all others."""

_DECISIONS: Final = ((1.5, 500.0), (2.5, 100.0))
"""What it takes: the surprise of the accepted plants since the beginning, as a multiple of the one below which nothing
is decided, and how many times smaller the sum of squares of the best reversed plant is than that of the best other. Of
1600 healthy moves under steps of the load of up to six times the stall effort none was taken for more than without it;
with twice the surprise and 50 times, six were."""


class _Begun(NamedTuple):
    """A plant that begins afresh."""

    plant: Plant
    observer: DisturbanceObserver
    is_delayed: bool


class _Seen(NamedTuple):
    """A sample, and what acted in the period that it begins: at once, and on a plant with delay."""

    position: float
    effort: float
    late_effort: float


class RecentReversal:
    """Compares reversed plants with the accepted ones, all begun afresh; give it each tick once.

    Parameters
    ----------
    plant
        The model.
    period_s
        The tick, in s.
    noise
        What the law's observer assumes.
    """

    __slots__ = (
        "_accepted", "_accepted_sum", "_forgetting", "_gain", "_least_ticks", "_own_sums", "_period_s", "_reversed",
        "_seen", "_sums", "_ticks",
    )  # fmt: skip

    def __init__(self, plant: Plant, period_s: float, noise: NoiseModel) -> None:
        def begun(deviation: Deviation, factor: float = 1.0) -> _Begun:
            other = deviating(plant, deviation, factor)
            return _Begun(other, slow_observer(other, period_s, noise), deviation.is_delayed)

        self._reversed = [begun(other.plant, other.factor) for other in OTHER_GAINS if other.factor < 0.0]
        self._accepted = [begun(deviation) for deviation in ACCEPTED]
        self._gain = plant.gain
        self._forgetting = kept_in(_FORGETTING, period_s)
        self._least_ticks = samples_in(_LEAST_S, period_s, _LEAST_TICKS)
        self._period_s = period_s
        self.start()

    def start(self) -> None:
        """Know nothing of what has been: after a tick without a sample as well."""
        self._seen: list[_Seen] = []
        self._ticks = 0
        self._forget_sums()

    def _forget_sums(self) -> None:
        self._accepted_sum = 0.0
        self._own_sums = [0.0] * len(self._reversed)
        self._sums = [0.0] * len(self._accepted)

    def update(
        self, sample: float, effort: float, late_effort: float, least_square: float, *, is_surprised: bool
    ) -> None:
        """Take a tick.

        Parameters
        ----------
        sample
            The position at its beginning, in axis unit.
        effort, late_effort
            What acted in it, in effort unit: at once, and on a plant with delay.
        least_square
            By what the sample surprised the best of the accepted plants, squared, in (axis unit)².
        is_surprised
            Whether these are surprised at all of late.
        """
        now = _Seen(sample, effort, late_effort)
        if self._ticks:
            self._compare(now, least_square)
        if not self._explains_more:
            self._ticks = 0
            if is_surprised and len(self._seen) == 2:
                self._begin(now)
        self._seen = [*self._seen[-1:], now]

    def _compare(self, now: _Seen, least_square: float) -> None:
        kept = self._forgetting
        for sums, begun in ((self._own_sums, self._reversed), (self._sums, self._accepted)):
            for index, one in enumerate(begun):
                sums[index] = kept * sums[index] + _square(one, now)
        self._accepted_sum = kept * self._accepted_sum + least_square
        self._ticks += 1

    @property
    def _explains_more(self) -> bool:
        """Whether the best reversed plant has explained more than every other since they have begun, if they have."""
        return self._ticks > 0 and min(self._own_sums) < min(self._accepted_sum, *self._sums)

    def _begin(self, now: _Seen) -> None:
        before, last = self._seen
        period_s = self._period_s
        acceleration = (now.position - 2.0 * last.position + before.position) / (period_s * period_s)
        velocity = (now.position - last.position) / period_s + 0.5 * acceleration * period_s
        for plant, observer, is_delayed in (*self._reversed, *self._accepted):
            acted, acts = (last.late_effort, now.late_effort) if is_delayed else (last.effort, now.effort)
            disturbance = (acceleration + plant.pole * velocity) / plant.gain - acted
            observer.go_on_from(now.position, velocity, disturbance)
            observer.predict(acts)
        self._forget_sums()
        self._ticks = 1

    def is_certain(self, least: float) -> bool:
        """Whether a reversed sign explains what no accepted plant does, whenever it came.

        Parameters
        ----------
        least
            The surprise below which nothing is decided, in axis unit.
        """
        if self._ticks <= self._least_ticks:
            return False
        own, others = min(self._own_sums), min(self._accepted_sum, *self._sums)
        surprise = self._accepted_sum**0.5 / least
        return any(surprise > enough and others > evidence * own for enough, evidence in _DECISIONS)

    def reckon(self) -> Reckoning:
        """Return the speed by the encoder as it should be, and the load."""
        plant, observer, _ = self._reversed[self._own_sums.index(min(self._own_sums))]
        return Reckoning(self._gain / plant.gain * observer.velocity, observer.disturbance)


def _square(one: _Begun, seen: _Seen) -> float:
    """Give a plant a tick, and return its squared innovation in (axis unit)²."""
    observer = one.observer
    observer.update(seen.position, seen.late_effort if one.is_delayed else seen.effort)
    return observer.innovation * observer.innovation
