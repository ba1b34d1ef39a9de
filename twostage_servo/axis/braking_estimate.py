"""The speed and the disturbance on which an axis brakes, where its model is wrong or its last samples are in doubt.

An observer whose plant is off its model settles on a wrong speed and a wrong disturbance, which its corrections make up
for in each tick: a standing innovation. As soon as nothing corrects it any more, or the axis is to brake by it, the
wrong speed would count in full. So what the corrections do in a tick is taken into the estimate itself.
"""

from twostage_servo.axis.design import AxisDesign
from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.per_time import share_in

_SHARE = 0.2
"""Share of the present innovation in the standing one, for each 10 ms: a mean over some 50 ms."""


class BrakingEstimate:
    """Follows the standing innovation, and runs the model on from the last estimate without a sample in doubt.

    Parameters
    ----------
    design
        The axis.
    """

    __slots__ = ("_disturbance", "_effort", "_gain1", "_gain2", "_plant", "_share", "_standing", "_velocity")

    def __init__(self, design: AxisDesign) -> None:
        self._plant = design.plant
        self._gain1, self._gain2, _ = design.kalman.predictor
        self._share = share_in(_SHARE, design.period_s)
        self._standing = 0.0  # in axis unit
        self._velocity = self._disturbance = self._effort = 0.0  # of the model that runs on

    def start(self, observer: DisturbanceObserver, effort: float) -> None:
        """Begin afresh from an estimate, and the effort (effort unit) that acts."""
        self._standing = 0.0
        self._velocity, self._disturbance, self._effort = observer.velocity, observer.disturbance, effort

    def update(self, observer: DisturbanceObserver, effort: float, *, corrected: bool, sure: bool) -> None:
        """Account for a tick.

        Parameters
        ----------
        observer
            The estimate at its end.
        effort
            The effort that acts from here on, in effort unit.
        corrected
            Whether a sample has corrected it.
        sure
            Whether that sample was one that an accepted plant would show.
        """
        if corrected:
            self._standing += self._share * (observer.innovation - self._standing)
        if sure:
            self._velocity, self._disturbance = self._without_corrections(observer)
        else:
            plant = self._plant
            self._velocity = plant.a22 * self._velocity + plant.b2 * (self._effort + self._disturbance)
        self._effort = effort

    def apply(self, observer: DisturbanceObserver, *, in_doubt: bool) -> None:
        """Put into the estimate what its corrections compensated for.

        Parameters
        ----------
        observer
            The estimate.
        in_doubt
            Whether the last samples are: then the model goes on from what was known before them.
        """
        if in_doubt:
            observer.correct(self._velocity, self._disturbance)
        else:
            observer.correct(*self._without_corrections(observer))
        self._standing = 0.0

    def _without_corrections(self, observer: DisturbanceObserver) -> tuple[float, float]:
        """Return speed and disturbance with which the estimate would go on as it does, were it corrected no more.

        What a plant off its model leaves standing goes with the speed. More than that is what late samples and commands
        have left, and says nothing of how the axis goes on.
        """
        plant = self._plant
        most = abs(observer.velocity * plant.a12 / self._gain1)
        standing = min(max(self._standing, -most), most)
        change = self._gain1 * standing / plant.a12
        velocity = observer.velocity + change
        return velocity, observer.disturbance + (self._gain2 * standing + (1.0 - plant.a22) * change) / plant.b2
