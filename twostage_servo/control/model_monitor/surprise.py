"""How much the samples of a window surprise the best of the accepted plants, and how much of it shows a wrong estimate.

A sample that was late surprises, and what it has made of the estimates surprises for some samples more, though nothing
is the matter with the axis. A model that has not taken that sample is surprised by none of those.
"""

from typing import Final

from twostage_servo.control.observer import DisturbanceObserver

_MADE_GOOD: Final = 0.1
"""Share of the surprise that decides, up to which the estimates with and without the late sample have to come together
again: from there on it makes no difference which of them is asked."""


class Surprise:
    """Sums up squared innovations in an exponential window; give it each sample once.

    Parameters
    ----------
    forgetting
        Weight of the window for each sample of age.
    model
        The slow observer of the model, which has taken each sample already.
    spare
        Another of the same, which nobody else uses.

    Attributes
    ----------
    total
        The sum, in (axis unit)².
    """

    __slots__ = ("_forgetting", "_is_spared", "_lasting", "_model", "_spare", "_spared", "total")

    def __init__(self, forgetting: float, model: DisturbanceObserver, spare: DisturbanceObserver) -> None:
        self._forgetting, self._model, self._spare = forgetting, model, spare
        self.start(0.0)

    def start(self, square: float) -> None:
        """Begin afresh, as if every sample so far had surprised by `square`, in (axis unit)²."""
        self.total = self._lasting = square / (1.0 - self._forgetting)
        self._spared = 0.0
        self._is_spared = False

    @property
    def lasting(self) -> float:
        """The sum, in (axis unit)², without samples that were late and what they have made of the estimates."""
        return self._lasting + self._spared

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self._spare.shift(distance)

    def predict(self, effort: float) -> None:
        """Account for a period without a sample, in which `effort` (effort unit) acted."""
        if self._is_spared:
            self._spare.predict(effort)

    def update(self, square: float, sample: float, effort: float, lag_s: float, least_square: float) -> None:
        """Account for a sample.

        Parameters
        ----------
        square
            The smallest squared innovation of the accepted plants, in (axis unit)².
        sample, effort, lag_s
            As in :meth:`.ModelMonitor.update`.
        least_square
            The square of the surprise below which nothing is decided.
        """
        kept = self._forgetting
        self.total = kept * self.total + square
        if self._is_spared:
            spare = self._spare
            spare.update(sample + spare.velocity * lag_s, effort)
            own = spare.innovation * spare.innovation
            if own <= least_square:  # the sample that was left out was late
                self._spared = 0.0
                self._lasting = kept * self._lasting + min(own, square)
                self._is_spared = square > _MADE_GOOD * _MADE_GOOD * least_square
                return
            self._lasting, self._spared, self._is_spared = self._lasting + self._spared, 0.0, False
        self._lasting *= kept
        if square > least_square:
            self._leave_out(square)
        else:
            self._lasting += square

    def _leave_out(self, square: float) -> None:
        """Go on without the latest sample, until the next ones tell whether it was late."""
        model, (gain1, gain2, gain3) = self._model, self._model.gain
        off = model.innovation
        self._spare.go_on_from(
            model.position - gain1 * off, model.velocity - gain2 * off, model.disturbance - gain3 * off
        )
        self._spared, self._is_spared = square, True
