"""The true plant: second order, friction and hard stops, solved exactly for effort that is constant between calls."""

from math import copysign, expm1, inf, isfinite, log1p

from twostage_servo.simulation.coupling import Coupling, Glide


class TruePlant:
    """Plant ``G(s) = gain / (s (s + pole))`` from effort to position, with Coulomb friction and stiction.

    In motion, with direction ``s = sign(gain velocity)``::

        velocity' = -pole velocity + gain (effort - coulomb_friction s)

    At rest it stays there while ``|effort| <= coulomb_friction``. A hard stop is rigid and takes all the energy: the
    axis that meets it is at rest on it, and leaves it when the effort pulls it away.

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
    stop_minimum, stop_maximum : float, optional
        Positions of the hard stops, position unit; infinite for none. The start lies between them.
    coupling : Coupling, optional
        Through which it moves a load, which it tells of each of its motions; None for a load that is fixed to it.

    Attributes
    ----------
    position : float
        Position, position unit; with a coupling that of the drive's side.
    velocity : float
        Velocity, position unit / s, of the same. Exactly 0.0 at rest.

    Raises
    ------
    ValueError
        If a parameter is out of its range.
    """

    __slots__ = (
        "_coulomb_friction",
        "_coupling",
        "_gain",
        "_pole",
        "_stop_maximum",
        "_stop_minimum",
        "position",
        "velocity",
    )

    def __init__(
        self,
        gain: float,
        pole: float,
        coulomb_friction: float = 0.0,
        position: float = 0.0,
        stop_minimum: float = -inf,
        stop_maximum: float = inf,
        coupling: Coupling | None = None,
    ) -> None:
        self.change(gain, pole, coulomb_friction)
        if not (isfinite(position) and stop_minimum <= position <= stop_maximum):
            raise ValueError(
                f"plant at position {position}: must be finite and between its stops {stop_minimum} and {stop_maximum}"
            )
        self._stop_minimum = stop_minimum
        self._stop_maximum = stop_maximum
        self._coupling = coupling
        self.position = position
        self.velocity = 0.0

    def change(self, gain: float, pole: float, coulomb_friction: float) -> None:
        """Go on with other parameters from where it is, at the velocity that it has.

        Raises
        ------
        ValueError
            If a parameter is out of its range. Nothing has then changed.
        """
        if not (isfinite(gain) and gain != 0 and isfinite(pole) and pole > 0):
            raise ValueError(f"plant with gain {gain} and pole {pole}: gain must not be 0, pole must be above 0")
        if not (isfinite(coulomb_friction) and coulomb_friction >= 0):
            raise ValueError(f"plant with friction {coulomb_friction}: must be finite and not negative")
        self._gain = gain
        self._pole = pole
        self._coulomb_friction = coulomb_friction

    def halt(self) -> None:
        """Stand still at once, where it is."""
        self.velocity = 0.0
        if self._coupling is not None:
            self._coupling.halt()

    def advance(self, duration_s: float, effort: float) -> float:
        """Move on by `duration_s` at constant effort. Exact for any duration: there is no step size to choose.

        Parameters
        ----------
        duration_s : float
            Time to pass, s; not negative.
        effort : float
            Net effort (what the drive gives less the load), effort unit.

        Returns
        -------
        float
            Where it first stopped on the way, by itself or by a hard stop; where it is now, if it never did. From its
            start to there and from there to its present position it moved in one direction each.

        Raises
        ------
        ValueError
            If the duration is negative, or either is not finite. The state is then unchanged.
        """
        if not (isfinite(duration_s) and duration_s >= 0 and isfinite(effort)):
            raise ValueError(f"cannot advance the plant by {duration_s} s at effort {effort}")
        first_stop = None
        # Until it rests or meets a stop; from there by the effort, which may bring it to the other stop; no further.
        while duration_s > 0.0 and (direction := self._direction(effort)):
            position, velocity = self.position, self.velocity
            acceleration = self._gain * (effort - copysign(self._coulomb_friction, self._gain * direction))
            until_rest_s = self._time_to_rest(acceleration)
            passed_s = min(until_rest_s, duration_s)
            self._glide(passed_s, acceleration)
            hard_stop = self._stop_maximum if direction > 0 else self._stop_minimum
            if (self.position - hard_stop) * direction >= 0.0:
                self.position, self.velocity = position, velocity
                passed_s = self._time_to(hard_stop, passed_s, acceleration, direction)
                self.position = hard_stop
            elif until_rest_s > duration_s:
                if self._coupling is not None:
                    glide = Glide(position, velocity, acceleration, self._pole)
                    self._coupling.follow(glide, duration_s, self.position)
                return self.position if first_stop is None else first_stop
            if self._coupling is not None:
                self._coupling.follow(Glide(position, velocity, acceleration, self._pole), passed_s, self.position)
            self.velocity = 0.0
            duration_s -= passed_s
            if first_stop is None:
                first_stop = self.position
        if self._coupling is not None:
            self._coupling.rest(duration_s, self._pole)
        return self.position if first_stop is None else first_stop

    def _direction(self, effort: float) -> float:
        """Tell which way it moves now: +1 or -1, or 0 when friction or a hard stop holds it."""
        if self.velocity != 0.0:
            return copysign(1.0, self.velocity)
        if abs(effort) <= self._coulomb_friction:
            return 0.0
        direction = copysign(1.0, self._gain * effort)
        held = self.position >= self._stop_maximum if direction > 0 else self.position <= self._stop_minimum
        return 0.0 if held else direction

    def _time_to(self, position: float, latest_s: float, acceleration: float, direction: float) -> float:
        """Find when it gets to a position, at the latest at `latest_s`; by bisection, down to neighbouring floats."""
        early_s, late_s = 0.0, latest_s
        while early_s < (middle_s := (early_s + late_s) / 2) < late_s:
            if (self.position + self._distance(middle_s, acceleration) - position) * direction < 0.0:
                early_s = middle_s
            else:
                late_s = middle_s
        return late_s

    def _time_to_rest(self, acceleration: float) -> float:
        """Solve ``velocity exp(-pole t) + acceleration / pole (1 - exp(-pole t)) = 0`` for t; infinity if never."""
        if self.velocity == 0.0:  # it sets out, and does not stop again while the effort stays as it is
            return inf
        if acceleration == 0.0 or (acceleration > 0) == (self.velocity > 0):
            return inf
        return log1p(-self._pole * self.velocity / acceleration) / self._pole

    def _glide(self, duration_s: float, acceleration: float) -> None:
        """Zero-order-hold solution of ``velocity' = -pole velocity + acceleration`` with the direction unchanged."""
        self.position += self._distance(duration_s, acceleration)
        self.velocity += (acceleration - self._pole * self.velocity) * self._effective_s(duration_s)

    def _distance(self, duration_s: float, acceleration: float) -> float:
        """How far it gets in one direction, without a stop."""
        final_velocity = acceleration / self._pole
        return final_velocity * duration_s + (self.velocity - final_velocity) * self._effective_s(duration_s)

    def _effective_s(self, duration_s: float) -> float:
        """Integral of ``exp(-pole t)`` over the duration."""
        return -expm1(-self._pole * duration_s) / self._pole
