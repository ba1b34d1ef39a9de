"""What the law believes of its plant, and the gains that follow."""

from dataclasses import dataclass
from functools import cached_property

from twostage_servo.control.laws.adaptive.placement import Poles, feedback_gains, observer_gain
from twostage_servo.control.laws.adaptive.reference import Ways
from twostage_servo.control.plant import DiscretePlant, Plant, Triple


@dataclass(frozen=True)
class Model:
    """A plant, sampled, with its poles.

    Attributes
    ----------
    plant
        Gain and pole.
    is_late
        Whether an effort acts a tick later than the observer has it anyway.
    poles
        Of the closed loop.
    period_s
        The tick, in s.
    """

    plant: Plant
    is_late: bool
    poles: Poles
    period_s: float

    @cached_property
    def sampled(self) -> DiscretePlant:
        """The plant over a tick."""
        return self.plant.discretise(self.period_s)

    @cached_property
    def ways(self) -> Ways:
        """What a tick's way is made of."""
        return Ways.of(self.sampled)

    @cached_property
    def observer_gain(self) -> Triple:
        """Of the disturbance observer, in predictor form."""
        return observer_gain(self.sampled, self.poles.single, self.poles.observer)

    @cached_property
    def feedback(self) -> tuple[float, float]:
        """f1 and f2."""
        return feedback_gains(self.sampled, self.poles.feedback)
