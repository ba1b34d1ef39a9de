"""The true plant: second order with Coulomb friction, solved exactly for effort that is constant between calls."""

from math import copysign, expm1, isfinite, log1p


class TruePlant:
    """Plant ``G(s) = gain / (s (s + pole))`` from effort to position, with Coulomb friction and stiction.

    In motion, with direction ``s = sign(gain velocity)``::

        velocity' = -pole velocity + gain (effort - coulomb_friction s)

    At rest it stays there while ``|effort| <= coulomb_friction``.

    Parameters
    ----------
    gain : float
        Gain, position unit / (effort unit s²); finite, not 0; negative for a drive mounted the other way round.
    pole : float
        Pole, 1/s; finite, greater than 0.
    coulomb_friction : float, optional
        Friction, effort unit; finite, not negative.
    position : float, optional
        Position at the start; the velocity is 0.

    Attributes
    ----------
    position : float
        Position, position unit.
    velocity : float
        Velocity, position unit / s. Exactly 0.0 at rest.

    Raises
    ------
    ValueError
        If a parameter is out of its range.
    """

    __slots__ = ("_coulomb_friction", "_gain", "_pole", "position", "velocity")

    def __init__(self, gain: float, pole: float, coulomb_friction: float = 0.0, position: float = 0.0) -> None:
        if not (isfinite(gain) and gain != 0 and isfinite(pole) and pole > 0):
            raise ValueError(f"plant with gain {gain} and pole {pole}: not 0 and above 0 are needed")
        if not (isfinite(coulomb_friction) and coulomb_friction >= 0 and isfinite(position)):
            raise ValueError(
                f"plant with friction {coulomb_friction}, position {position}: both must be finite, friction >= 0"
            )
        self._gain = gain
        self._pole = pole
        self._coulomb_friction = coulomb_friction
        self.position = position
        self.velocity = 0.0

    def advance(self, duration_s: float, effort: float) -> None:
        """Move on by `duration_s` at constant effort. Exact for any duration: there is no step size to choose.

        Parameters
        ----------
        duration_s : float
            Time to pass, s; not negative.
        effort : float
            Net effort (what the drive gives less the load), effort unit.

        Raises
        ------
        ValueError
            If the duration is negative, or either is not finite. The state is then unchanged.
        """
        if not (isfinite(duration_s) and duration_s >= 0 and isfinite(effort)):
            raise ValueError(f"cannot advance the plant by {duration_s} s at effort {effort}")
        if self.velocity != 0.0:
            acceleration = self._gain * (effort - copysign(self._coulomb_friction, self._gain * self.velocity))
            until_rest_s = self._time_to_rest(acceleration)
            if until_rest_s > duration_s:
                self._glide(duration_s, acceleration)
                return
            self._glide(until_rest_s, acceleration)
            self.velocity = 0.0
            duration_s -= until_rest_s
        if abs(effort) > self._coulomb_friction:
            # From rest it follows the effort, and cannot come to rest again while the effort stays as it is.
            self._glide(duration_s, self._gain * (effort - copysign(self._coulomb_friction, effort)))

    def _time_to_rest(self, acceleration: float) -> float:
        """Solve ``velocity exp(-pole t) + acceleration / pole (1 - exp(-pole t)) = 0`` for t; infinity if never."""
        if acceleration == 0.0 or (acceleration > 0) == (self.velocity > 0):
            return float("inf")
        return log1p(-self._pole * self.velocity / acceleration) / self._pole

    def _glide(self, duration_s: float, acceleration: float) -> None:
        """Zero-order-hold solution of ``velocity' = -pole velocity + acceleration`` with the direction unchanged."""
        effective_s = -expm1(-self._pole * duration_s) / self._pole  # integral of exp(-pole t) over the duration
        final_velocity = acceleration / self._pole
        self.position += final_velocity * duration_s + (self.velocity - final_velocity) * effective_s
        self.velocity += (acceleration - self._pole * self.velocity) * effective_s
