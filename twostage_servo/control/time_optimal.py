"""The quickest move that an axis is capable of: what the time of any law's move is compared with."""

from dataclasses import dataclass
from math import inf, log, sqrt
from typing import Final

_HALVINGS: Final = 60


@dataclass(frozen=True, slots=True)
class QuickestMove:
    """The quickest move that reaches a band around its set-point and stays in it.

    It accelerates as hard as it can, keeps to the velocity, and brakes as hard as it can, to rest at the far end of the
    band. The rate of the effort and the ticks are left out, so no law is quicker.

    Attributes
    ----------
    accelerating_s, cruising_s, braking_s
        Its parts, until it is at rest.
    in_band_s
        Of the last of these, what it spends in the band.
    """

    accelerating_s: float
    cruising_s: float
    braking_s: float
    in_band_s: float

    @property
    def bound_s(self) -> float:
        """When it reaches the band."""
        return max(0.0, self.accelerating_s + self.cruising_s + self.braking_s - self.in_band_s)


@dataclass(frozen=True, slots=True)
class Capability:
    """What moves an axis: ``v' = up - a v`` while it accelerates, ``v' = -(down + a v)`` while it brakes.

    Attributes
    ----------
    up, down
        Acceleration and deceleration by the whole effort at standstill, in axis unit/s²; greater than 0. A load and
        friction make them differ.
    pole
        a, in 1/s.
    acceleration
        Largest acceleration and deceleration, in axis unit/s².
    """

    up: float
    down: float
    pole: float
    acceleration: float = inf

    def quickest_move(self, distance: float, velocity: float, band: float) -> QuickestMove:
        """Return the quickest move.

        Parameters
        ----------
        distance
            In axis unit, greater than 0.
        velocity
            Largest speed, in axis unit/s, greater than 0.
        band
            Distance from the set-point at which the move counts as done, in axis unit, greater than 0.
        """
        way = distance + band
        low, high = 0.0, min(velocity, self.up / self.pole * (1.0 - 1e-9))
        cruise_s = 0.0
        if self._way(high) > way:
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if self._way(middle) < way else (low, middle)
        else:
            cruise_s = (way - self._way(high)) / high
        (accelerating_s, _), (braking_s, _) = self._accelerate(high), self._brake(high)
        return QuickestMove(accelerating_s, cruise_s, braking_s, self._last_s(min(2.0 * band, way), high))

    def _way(self, velocity: float) -> float:
        """Return the way of an acceleration to a speed and the braking from it."""
        return self._accelerate(velocity)[1] + self._brake(velocity)[1]

    def _accelerate(self, velocity: float) -> tuple[float, float]:
        """Return time and way from rest to a speed: at the limit first, and from where the effort binds, by it."""
        limit, final = self.acceleration, self.up / self.pole
        kept = min(velocity, max(0.0, (self.up - limit) / self.pole)) if limit < self.up else 0.0
        early_s = kept / limit
        late_s = log((final - kept) / (final - velocity)) / self.pole
        return early_s + late_s, 0.5 * kept * early_s + final * late_s - (velocity - kept) / self.pole

    def _brake(self, velocity: float) -> tuple[float, float]:
        """Return time and way from a speed to rest: at the limit while the effort allows more, then by the effort."""
        limit = self.acceleration
        left = min(velocity, max(0.0, (limit - self.down) / self.pole))
        early_s = (velocity - left) / limit
        late_s = log(1.0 + self.pole * left / self.down) / self.pole
        return early_s + late_s, 0.5 * (velocity + left) * early_s + (left - self.down * late_s) / self.pole

    def _last_s(self, way: float, velocity: float) -> float:
        """Return how long the last part of a move takes, at whose end it brakes from a velocity."""
        braking_s, braking_way = self._brake(velocity)
        if braking_way <= way:
            return braking_s + (way - braking_way) / velocity
        low, high = 0.0, sqrt(2.0 * way * min(self.acceleration, self.down))
        while self._brake(high)[1] < way:
            high *= 2.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._brake(middle)[1] < way else (low, middle)
        return self._brake(high)[0]
