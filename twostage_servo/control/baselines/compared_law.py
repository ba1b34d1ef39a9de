"""The face that every law shows to whoever runs it."""

from typing import Protocol


class ComparedLaw(Protocol):
    """From position samples to efforts, one per sampling period.

    A drive that answers over a bus delivers a sample one period late; equations (14)-(19) of the paper take it at once.
    Each law therefore says how old a sample it is made for, and whoever runs it hands it just that one.
    """

    @property
    def sample_age(self) -> int:
        """Age of the sample that :meth:`step` takes, in periods: 0 for ``y(k)``, 1 for ``y(k-1)``."""

    @property
    def velocity(self) -> float:
        """Velocity that the last effort was made with, axis unit/s: measured, differentiated, modelled or estimated."""

    @property
    def changeovers(self) -> int:
        """Number of changes from the speed to the position stage so far."""

    def set_target(self, target: float, velocity: float) -> None:
        """Set a set-point in axis unit and its cruise velocity in axis unit/s; single-stage laws ignore the latter."""

    def step(self, sample: float) -> float:
        """Process a position sample in axis unit; return the effort in effort unit for the period that begins now."""
