"""A plant that the law believes in, and the gains that follow from it."""

from dataclasses import dataclass
from functools import cached_property

from twostage_servo.control.laws.adaptive.placement import Gains
from twostage_servo.control.laws.adaptive.reference import Ways
from twostage_servo.control.plant import DiscretePlant, Plant, Triple


@dataclass(frozen=True)
class Model:
    """A plant, sampled, and where its gains come from; what follows is computed where it is asked for.

    Attributes
    ----------
    plant
        Gain and pole.
    is_late
        Whether an effort acts a tick later than the observer has it anyway.
    gains
        Where its gains come from: the poles of the closed loop, or the paper's design.
    period_s
        The tick, in s.
    """

    plant: Plant
    is_late: bool
    gains: Gains
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
        """L1, L2, L3 of the disturbance observer in predictor form, in 1, 1/s and effort unit per axis unit."""
        return self.gains.observer_gain(self.sampled)

    @cached_property
    def feedback(self) -> tuple[float, float]:
        """f1 and f2 of ``u = -f1 x1 - f2 x2``, in effort unit per axis unit and per axis unit/s."""
        return self.gains.feedback_gains(self.sampled)
