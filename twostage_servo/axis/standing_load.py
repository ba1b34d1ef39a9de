"""Which part of an axis' disturbance is constant, such as a weight, and which part goes with its speed.

The disturbance that the observer holds in a motion has two parts that look alike there: a load, and what the plant's
friction is off its model by. In a stop they part: the load stays, the friction goes with the speed. At rest the load
alone is left. So it is measured there, and what comes with a speed is taken for friction, as far as an accepted plant
has that much.
"""

from typing import Final

from twostage_servo.axis.design import AxisDesign
from twostage_servo.control.model_monitor.hypotheses import ACCEPTED
from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.per_time import share_in

_SHARE: Final = 0.3
"""Share of the present disturbance in the mean, for each 10 ms: over some 30 ms."""

_CRUISE_EFFORTS: Final = tuple(plant.pole / plant.gain for plant in ACCEPTED)
"""The effort of a cruise on each accepted plant, as a multiple of the model's."""

_LEAST_FRICTION: Final = 1.0 - max(_CRUISE_EFFORTS)
_MOST_FRICTION: Final = 1.0 - min(_CRUISE_EFFORTS)
"""By how much the disturbance may change with the speed, as a multiple of the model's own friction."""


class StandingLoad:
    """Follows the disturbance that does not go with the speed.

    Parameters
    ----------
    design
        The axis.

    Attributes
    ----------
    load
        The part that does not go with the speed, in effort unit.
    """

    __slots__ = ("_friction", "_rest_velocity", "_share", "load")

    def __init__(self, design: AxisDesign) -> None:
        self._friction = design.settings.plant.pole / design.settings.plant.gain  # of the model, effort per speed
        self._rest_velocity = design.rest_velocity
        self._share = share_in(_SHARE, design.period_s)
        self.start()

    def start(self) -> None:
        """Begin afresh, without a load."""
        self.load = 0.0  # in effort unit

    def update(self, observer: DisturbanceObserver) -> None:
        """Account for a tick under position control: what friction does not explain at the present speed is load."""
        disturbance = observer.disturbance
        rest = disturbance - self.load - self._likeliest(observer.velocity, disturbance) * observer.velocity
        self.load += self._share * rest

    def friction(self, velocity: float, disturbance: float) -> float:
        """Return by how much the disturbance changes with the speed, in effort unit s/axis unit.

        Parameters
        ----------
        velocity
            In axis unit/s; at rest nothing of the disturbance is friction.
        disturbance
            All of it, in effort unit.
        """
        return self._likeliest(velocity, disturbance) if abs(velocity) > self._rest_velocity else 0.0

    def _likeliest(self, velocity: float, disturbance: float) -> float:
        """Return the friction of an accepted plant that explains the most."""
        model = self._friction
        cruise_effort = velocity * model
        if not cruise_effort:
            return 0.0
        factor = (disturbance - self.load) / cruise_effort
        return model * min(max(factor, _LEAST_FRICTION), _MOST_FRICTION)
