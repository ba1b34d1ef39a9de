"""Baselines with parameters that an optimiser may choose: what each declares, and what whoever runs it needs.

They are built for a :class:`~twostage_servo.control.laws.law.ControlTask` and keep its limits of effort and effort
rate. They take the sample of the period before, as the product's laws do. They know no stop, no lost sample and no
change of the target in mid-move.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from twostage_servo.control.laws.law import Controller, ControlTask


class TunableLaw(Protocol):
    """From position samples to efforts within the limits of effort and effort rate, one per sampling period."""

    def set_target(self, target: float, velocity: float) -> None:
        """Set a set-point in axis unit and the magnitude of its cruise velocity in axis unit/s, from rest."""

    def step(self, sample: float) -> float:
        """Process ``y(k-1)`` in axis unit; return the effort ``u(k)`` in effort unit."""

    def controller(self) -> Controller:
        """Return what it is at rest near its set-point, without its limits."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number that an optimiser may choose; it is searched on a logarithmic scale.

    Attributes
    ----------
    low, start, high
        Bounds, and the value to begin with; all greater than 0.
    meaning
        With its unit.
    """

    low: float
    start: float
    high: float
    meaning: str


Values = Mapping[str, float]
"""A value for each parameter by its name."""


@dataclass(frozen=True, slots=True)
class TunableLawType:
    """A baseline and its parameters.

    Attributes
    ----------
    parameters
        By their names.
    build
        Makes the law for a task with a value for each parameter.
    """

    parameters: Mapping[str, Parameter]
    build: Callable[[ControlTask, Values], TunableLaw]

    def start(self) -> dict[str, float]:
        """Return the values to begin with."""
        return {name: parameter.start for name, parameter in self.parameters.items()}
