"""How long a move takes, from the designed response: what lets several axes arrive together."""

from twostage_servo.axis.design import AxisDesign

_HALVINGS = 60


class MoveDuration:
    """The duration of a move from rest until the position window is entered for good.

    Parameters
    ----------
    design
        The axis.
    """

    def __init__(self, design: AxisDesign) -> None:
        self._window = design.settings.window.position
        self._law = design.law

    def duration_s(self, distance: float, velocity: float) -> float:
        """Return how long a move takes, in s.

        Parameters
        ----------
        distance
            Length of the move in axis unit, not negative.
        velocity
            Cruise velocity in axis unit/s, greater than 0.
        """
        if distance <= self._window:
            return 0.0
        return self._law.move_duration_s(distance, velocity, self._window)

    def velocity_for(self, distance: float, duration_s: float, fastest: float) -> float:
        """Return the cruise velocity in axis unit/s, `fastest` at most, with which a move takes so long, in s."""
        if distance <= self._window or self.duration_s(distance, fastest) >= duration_s:
            return fastest
        low, high = 0.0, fastest
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if self.duration_s(distance, middle) > duration_s:
                low = middle
            else:
                high = middle
        return high
