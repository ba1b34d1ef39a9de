"""What is taken to be true of a plant now, to read and not to write."""

from typing import Protocol


class Estimate(Protocol):
    """Position, velocity and disturbance; it goes on with whatever makes it."""

    @property
    def position(self) -> float:
        """In axis unit."""

    @property
    def velocity(self) -> float:
        """In axis unit/s."""

    @property
    def disturbance(self) -> float:
        """What acts beside the effort, in effort unit."""
