"""The two examples of section V, as data, and what follows from them."""

from dataclasses import dataclass, field
from typing import Final

from twostage_servo.control.observer import KalmanGain, NoiseModel, kalman_gain
from twostage_servo.control.optimal import ServoGains, servo_gains
from twostage_servo.control.plant import DiscretePlant, Plant

PERIOD_S: Final = 0.01
"""T_s."""
MODEL: Final = Plant(180.0, 14.0)
"""Equation (35)."""
NOISE: Final = NoiseModel()
"""Equation (37), read as in errata 5 and 8."""
SET_POINT: Final = 400.0
VELOCITY: Final = 100.0


@dataclass(frozen=True, slots=True)
class Example:
    """One example.

    Attributes
    ----------
    name
        Its key in the JSON: ``example1`` or ``example2``.
    title
        For people.
    ratio
        Performance index ratio Q/R.
    true_plant
        The plant that is driven; the laws are designed for :data:`MODEL`.
    noise_variance
        Of the white noise on the measured position, in mm² (erratum 9).
    """

    name: str
    title: str
    ratio: float
    true_plant: Plant
    noise_variance: float
    model: DiscretePlant = field(init=False)
    gains: ServoGains = field(init=False)
    kalman: KalmanGain = field(init=False)

    def __post_init__(self) -> None:
        model = MODEL.discretise(PERIOD_S)
        object.__setattr__(self, "model", model)
        object.__setattr__(self, "gains", servo_gains(model, self.ratio))
        object.__setattr__(self, "kalman", kalman_gain(model, NOISE))

    @property
    def short_title(self) -> str:
        """Its title without what it is about: ``Example 1``."""
        return self.title.partition(":")[0]

    @property
    def changeover_distance(self) -> float:
        """Equation (19) for :data:`VELOCITY`, in mm."""
        return VELOCITY * self.gains.changeover_time_s(PERIOD_S)


EXAMPLE_1: Final = Example("example1", "Example 1: white noise on the output", 5.0e-5, MODEL, 1.0e-3)
EXAMPLE_2: Final = Example(
    "example2", "Example 2: errors of 30 % in the plant's parameters", 5.0e-3, Plant(180.0 * 1.3, 14.0 * 0.7), 0.0
)
EXAMPLES: Final = (EXAMPLE_1, EXAMPLE_2)
