"""Identification of the plant in the acceleration of a move, from rest.

Integrated twice, ``y'' = b (u - w) - a y'`` becomes linear in what is sought, and needs no derivative of a measured
position::

    y = b II(u) - a I(y) - b w t²/2 + y0

with I the integral from the start, u constant over each tick, and I(y) by the trapezoidal rule with the first term of
the Euler-Maclaurin formula, ``T² (v - v0)/12``. Recursive least squares (L. Ljung, *System Identification*, 1999,
section 11.2) gives gain b, pole a, load w (friction of this direction included) and the place y0, with their spread,
and from them position and velocity.

An effort may act a tick later than the model says: a second fit supposes that it does, and what the two have been
surprised by, as log-likelihoods, tells which is right.
"""

from math import hypot, log, sqrt
from typing import NamedTuple

_SHARE_GROWTH = 1.2
"""Factor by which the spread of gain and pole grows from one move to the next: the plant may have changed."""

_LEAST_SHARE_GROWTH = 0.01
"""Spread that is added to it, as a share of the value: without it the fits would stop learning in the end."""


class Prior(NamedTuple):
    """What is known of a plant before a move; forward is the direction of the move.

    Attributes
    ----------
    gain, pole, load
        b, a and w: in axis unit/s² per effort unit, 1/s and effort unit.
    gain_share, pole_share
        Standard deviations of the first two, as shares.
    load_spread
        Standard deviation of the third, in effort unit.
    """

    gain: float
    pole: float
    load: float
    gain_share: float
    pole_share: float
    load_spread: float


class Acted(NamedTuple):
    """What has acted in a tick, forward.

    Attributes
    ----------
    mean
        The mean effort, in effort unit.
    more_way
        What the axis has gone more than by that mean, where the effort has changed within the tick: as an effort over
        the whole tick, in effort unit.
    """

    mean: float
    more_way: float = 0.0


class Fit:
    """One least-squares fit; positions and efforts are counted forward from where the move began.

    Equations and source are in the module.

    Parameters
    ----------
    prior
        What is known beforehand.
    spread
        Standard deviation of a sample, in axis unit.
    period_s
        The tick, in s.

    Attributes
    ----------
    position
        Estimate at the last sample, in axis unit.
    evidence
        Twice the negative logarithm of the samples' likelihood, but for a constant.
    surprise
        Squared innovation of the last sample, in its own variances: 1 on average.
    misfit
        Sum of these.
    samples
        How many it has had.
    """

    __slots__ = (
        "_effort_once", "_effort_twice", "_period_s", "_position_once", "_prior", "_root", "_sample", "_time_s",
        "_values", "_variance", "evidence", "misfit", "position", "samples", "surprise",
    )  # fmt: skip

    def __init__(self, prior: Prior, spread: float, period_s: float) -> None:
        gain, load = prior.gain, prior.load
        of_gain = prior.gain_share * gain
        self._variance = spread * spread
        self._values = [gain, prior.pole, gain * load, 0.0]
        self._root = [
            [of_gain, 0.0, 0.0, 0.0],
            [0.0, prior.pole_share * prior.pole, 0.0, 0.0],
            [of_gain * load, 0.0, prior.load_spread * gain, 0.0],
            [0.0, 0.0, 0.0, spread],
        ]
        self._prior = prior
        self._period_s = period_s
        self._effort_once = self._effort_twice = self._position_once = self._time_s = self._sample = 0.0
        self.position = self.evidence = self.surprise = self.misfit = 0.0
        self.samples = 0

    def update(self, sample: float | None, acted: Acted, date_error_s: float = 0.0) -> None:
        """Take a tick.

        Parameters
        ----------
        sample
            The measured position at its end, in axis unit; None where it is lost.
        acted
            What has acted in it.
        date_error_s
            By how much the date of the sample may be off, in s.
        """
        period_s, values = self._period_s, self._values
        mean, more_way = acted
        self._effort_twice += self._effort_once * period_s + 0.5 * (mean + more_way) * period_s * period_s
        self._effort_once += mean * period_s
        self._time_s += period_s
        is_lost = sample is None
        if sample is None:
            sample = self._sample + period_s * self.velocity
        self._position_once += 0.5 * period_s * (sample + self._sample)
        self._sample = sample
        regressor = (
            self._effort_twice,
            period_s * period_s / 12.0 * self.velocity - self._position_once,
            -0.5 * self._time_s * self._time_s,
            1.0,
        )
        error = sample - sum(factor * value for factor, value in zip(regressor, values, strict=True))
        if is_lost:
            self.position = sample - error
        else:
            spread = date_error_s * self.velocity
            self._correct(sample, error, regressor, self._variance + spread * spread)
            if spread * spread > self._variance:  # what is wrong with it must not stay in the integral
                self._position_once += 0.5 * period_s * (self.position - sample)
                self._sample = self.position

    def _correct(self, sample: float, error: float, regressor: tuple[float, ...], noise: float) -> None:
        """Learn from a sample, by what it is off the fit (both in axis unit), and by its own variance, squared."""
        values, root = self._values, self._root
        # Potter's form: the root S of the covariance S S', so that it stays one however little is left of it.
        seen = [sum(row[column] * factor for row, factor in zip(root, regressor, strict=True)) for column in range(4)]
        variance = noise + sum(value * value for value in seen)
        weighed = [sum(entry * value for entry, value in zip(row, seen, strict=True)) for row in root]
        share = 1.0 / (variance + sqrt(variance * noise))
        for index, row in enumerate(root):
            values[index] += weighed[index] / variance * error
            for column in range(4):
                row[column] -= share * weighed[index] * seen[column]
        self.surprise = error * error / variance
        self.evidence += self.surprise + log(variance / noise)
        self.misfit += self.surprise
        self.samples += 1
        self.position = sample - error * noise / variance

    def begin_late(self, sample: float) -> None:
        """Take a sample (axis unit) of a tick in which nothing has acted yet: noise alone has moved it."""
        self.evidence += sample * sample / self._variance / 2.0

    @property
    def gain(self) -> float:
        """b, in axis unit/s² per effort unit."""
        return self._values[0]

    @property
    def pole(self) -> float:
        """a, in 1/s."""
        return self._values[1]

    @property
    def load(self) -> float:
        """w, in effort unit."""
        return self._values[2] / self._values[0]

    @property
    def velocity(self) -> float:
        """The speed at the last sample, in axis unit/s: the equation integrated once."""
        gain, pole, push, _ = self._values
        return gain * self._effort_once - pole * self._sample - push * self._time_s

    @property
    def residual(self) -> float:
        """What the samples are off the fit: the sum of squares, in variances of a sample.

        Recursive least squares reaches the least of ``Σ (y - φ θ)²/σ² + (θ - θ0)' P0⁻¹ (θ - θ0)``, and the sum of the
        squared innovations, each in its own variance, is that least. So :attr:`misfit` less what the fit has moved away
        from gain, pole and load of the prior is left: how far it has moved says nothing of how well it fits.
        """
        prior, (gain, pole, push, _) = self._prior, self._values
        of_gain = (gain / prior.gain - 1.0) / prior.gain_share
        of_pole = (pole / prior.pole - 1.0) / prior.pole_share
        of_load = (push / prior.gain - prior.load * (1.0 + prior.gain_share * of_gain)) / prior.load_spread
        return self.misfit - of_gain * of_gain - of_pole * of_pole - of_load * of_load

    @property
    def freedom(self) -> int:
        """Samples less gain, pole and load (the place has a sample's prior): what the residual is on average."""
        return self.samples - 3

    @property
    def gain_share(self) -> float:
        """Standard deviation of the gain, as a share of it."""
        return hypot(*self._root[0]) / abs(self.gain)

    @property
    def pole_share(self) -> float:
        """Standard deviation of the pole, as a share of it."""
        return hypot(*self._root[1]) / abs(self.pole)


def widened(share: float, prior_share: float) -> float:
    """Return the spread with which what has been identified goes into the next move, as a share.

    Parameters
    ----------
    share
        Spread of the fit, as a share.
    prior_share
        Spread of what is configured, as a share: the result is at most that.
    """
    return min(prior_share, hypot(_SHARE_GROWTH * share, _LEAST_SHARE_GROWTH))
