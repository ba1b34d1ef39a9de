"""The speed and the disturbance on which an axis brakes, where its model is wrong or its last samples are in doubt.

An observer whose plant is off its model settles on a wrong speed and a wrong disturbance, which its corrections make up
for in each tick: a standing innovation. As soon as nothing corrects it any more, or the axis is to brake by it, the
wrong speed would count in full. So what the corrections do in a tick is taken into the estimate itself.
"""

from collections import deque

from twostage_servo.axis.design import AxisDesign
from twostage_servo.control.observer import DisturbanceObserver

_SHARE = 0.2
"""Share of the present innovation in the standing one: a mean over some five ticks."""

_DOUBTED_TICKS = 10
"""How far back an estimate lies that samples in doubt have not touched."""


class BrakingEstimate:
    """Follows the standing innovation, and remembers what the estimate was a while ago.

    Parameters
    ----------
    design
        The axis.
    """

    __slots__ = ("_gain1", "_gain2", "_past", "_plant", "_standing")

    def __init__(self, design: AxisDesign) -> None:
        self._plant = design.plant
        self._gain1, self._gain2, _ = design.kalman.predictor
        self._standing = 0.0  # in axis unit
        self._past: deque[tuple[float, float, float]] = deque(maxlen=_DOUBTED_TICKS)

    def start(self) -> None:
        """Begin afresh."""
        self._standing = 0.0
        self._past.clear()

    def note(self, observer: DisturbanceObserver, effort: float, *, corrected: bool) -> None:
        """Account for a tick.

        Parameters
        ----------
        observer
            The estimate at its end.
        effort
            The effort that acts from here on, in effort unit.
        corrected
            Whether a sample has corrected it.
        """
        if corrected:
            self._standing += _SHARE * (observer.innovation - self._standing)
        self._past.append((*self._without_corrections(observer), effort))

    def apply(self, observer: DisturbanceObserver, *, in_doubt: bool) -> None:
        """Take into the estimate what its corrections made up for.

        Parameters
        ----------
        observer
            The estimate.
        in_doubt
            Whether the last samples are: then the model goes on from what was known before them.
        """
        if in_doubt and len(self._past) == _DOUBTED_TICKS:
            (velocity, disturbance, _), plant = self._past[0], self._plant
            for *_, effort in list(self._past)[:-1]:
                velocity = plant.a22 * velocity + plant.b2 * (effort + disturbance)
            observer.velocity, observer.disturbance = velocity, disturbance
        elif not in_doubt:
            observer.velocity, observer.disturbance = self._without_corrections(observer)
        self._standing = 0.0

    def _without_corrections(self, observer: DisturbanceObserver) -> tuple[float, float]:
        """Return speed and disturbance with which the estimate would go on as it does, were it corrected no more."""
        plant, standing = self._plant, self._standing
        change = self._gain1 * standing / plant.a12
        velocity = observer.velocity + change
        return velocity, observer.disturbance + (self._gain2 * standing + (1.0 - plant.a22) * change) / plant.b2
