"""What lies between the drive and the load: backlash, and behind it a spring with damping.

The drive moves one end, as :class:`~twostage_servo.simulation.plant.TruePlant` has it. The load, with the encoder on
it, hangs on the other end, so that both are inside the loop: a linear scale at the carriage, not an encoder on the
motor's shaft, which sees little of a resonance and nothing of backlash.
"""

from math import copysign, cos, exp, expm1, isfinite, pi, sin, sqrt
from typing import NamedTuple


class Glide(NamedTuple):
    """How the drive moves in one direction: ``velocity' = acceleration - pole velocity``, from position and velocity.

    Attributes
    ----------
    position, velocity
        At its start, in position unit and position unit/s.
    acceleration
        What effort and friction give, in position unit/s².
    pole
        In 1/s.
    """

    position: float
    velocity: float
    acceleration: float
    pole: float

    def velocity_after(self, passed_s: float) -> float:
        """Return the velocity after a time in s, in position unit/s."""
        return self.velocity + self.initial_acceleration * self._effective_s(passed_s)

    def distance(self, passed_s: float) -> float:
        """Return how far it has gone after a time in s, in position unit."""
        final = self.acceleration / self.pole
        return final * passed_s + (self.velocity - final) * self._effective_s(passed_s)

    @property
    def initial_acceleration(self) -> float:
        """The derivative of the velocity at its start, in position unit/s²; it decays with the pole."""
        return self.acceleration - self.pole * self.velocity

    def later(self, passed_s: float) -> "Glide":
        """Return what is left of it after a time in s."""
        return Glide(
            self.position + self.distance(passed_s), self.velocity_after(passed_s), self.acceleration, self.pole
        )

    def _effective_s(self, passed_s: float) -> float:
        return -expm1(-self.pole * passed_s) / self.pole


class Coupling:
    """Backlash as a play operator, then a spring with damping that carries the load.

    With p the drive's position x as far as the backlash lets it through (it stays while the drive crosses the gap, and
    is half of the gap behind it in contact), the load's position y follows::

        y'' = ω² (p - y) + 2 ζ ω (p' - y')        ω = 2 π resonance_hz, ζ the damping ratio

    Without backlash the transfer function from effort to encoder is ::

        gain / (s (s + pole)) (2 ζ ω s + ω²) / (s² + 2 ζ ω s + ω²)

    That is the form of two masses with the encoder on the load: a rigid mode, the masses against each other, and no
    antiresonance, which only an encoder on the motor sees (G. Ellis, *Control System Design Guide*, 4th ed., 2012,
    chapter 16). So the ratio of the masses is not in it, but for the share that the spring takes from the drive's own
    motion; it is left out here, as with a drive much heavier than its load.

    The play operator is the model for a load whose friction stops it in the gap (M. Nordin, P.-O. Gutman, *Controlling
    mechanical systems with backlash - a survey*, Automatica 38, 2002, section 2). A load that flies through the gap and
    bounces is not modelled.

    Exact for any duration: what y is off p is an oscillator driven by ``-p''``, which is zero in the gap and decays
    with the pole in contact, so its solution is in closed form. A contact or a turn within a call is one more phase.

    Parameters
    ----------
    resonance_hz
        Undamped frequency of the mode, in Hz, finite; 0 for a rigid coupling.
    damping
        Damping ratio of the mode, above 0 and below 1.
    backlash
        Width of the whole gap, in position unit; finite, not negative. The drive begins in the middle of it.
    position
        Of drive and load at the start, in position unit.

    Attributes
    ----------
    position, velocity
        Of the load, in position unit and position unit/s.

    Raises
    ------
    ValueError
        If a parameter is out of its range.
    """

    __slots__ = ("_decay", "_half_gap", "_omega", "_passed", "_ringing", "position", "velocity")

    def __init__(self, resonance_hz: float, damping: float, backlash: float, position: float) -> None:
        if not (isfinite(resonance_hz) and resonance_hz >= 0.0 and 0.0 < damping < 1.0):
            raise ValueError(
                f"coupling with a resonance at {resonance_hz} Hz and a damping of {damping}: the frequency must be "
                "finite and not negative, the damping ratio above 0 and below 1"
            )
        if not (isfinite(backlash) and backlash >= 0.0):
            raise ValueError(f"coupling with a backlash of {backlash}: must be finite and not negative")
        self._omega = 2.0 * pi * resonance_hz
        self._decay = damping * self._omega
        self._ringing = self._omega * sqrt((1.0 - damping) * (1.0 + damping))
        self._half_gap = 0.5 * backlash
        self._passed = position  # p
        self.position = position
        self.velocity = 0.0

    def halt(self) -> None:
        """Let the load stand still at once, where it is."""
        self.velocity = 0.0

    def follow(self, glide: Glide, duration_s: float, end: float) -> None:
        """Follow the drive, which glides in one direction for a time in s, to its position at the end of it."""
        start, half_gap = glide.position, self._half_gap
        pushed_to = min(max(self._passed, end - half_gap), end + half_gap)
        if pushed_to == self._passed:  # it stays in the gap, or stands
            self._swing(duration_s, 0.0, 0.0, glide.pole, pushed_to)
            return
        direction = copysign(1.0, end - start)
        in_gap_s = self._time_to(self._passed + direction * half_gap, glide, duration_s, direction)
        if in_gap_s > 0.0:
            self._swing(in_gap_s, 0.0, 0.0, glide.pole, self._passed)
            glide = glide.later(in_gap_s)
        self._swing(duration_s - in_gap_s, glide.velocity, glide.initial_acceleration, glide.pole, pushed_to)
        if not self._omega:
            self.velocity = glide.velocity_after(duration_s - in_gap_s)

    def rest(self, duration_s: float, pole: float) -> None:
        """Follow the drive, which stands for a time in s; the pole (1/s) is its own."""
        self._swing(duration_s, 0.0, 0.0, pole, self._passed)

    def _time_to(self, position: float, glide: Glide, latest_s: float, direction: float) -> float:
        """Find when the drive gets to a position, at the latest at `latest_s`; by bisection, to neighbouring floats."""
        if (position - glide.position) * direction <= 0.0:
            return 0.0
        early_s, late_s = 0.0, latest_s
        while early_s < (middle_s := (early_s + late_s) / 2) < late_s:
            if (glide.position + glide.distance(middle_s) - position) * direction < 0.0:
                early_s = middle_s
            else:
                late_s = middle_s
        return late_s

    def _swing(self, passed_s: float, velocity: float, acceleration: float, pole: float, end: float) -> None:
        """Move the load while p goes to `end`, from a velocity on and by an acceleration that decays with a pole.

        The deviation d = y - p obeys ``d'' + 2 ζ ω d' + ω² d = -acceleration exp(-pole t)``.
        """
        omega, decay, ringing = self._omega, self._decay, self._ringing
        if not omega:
            self.position = self._passed = end
            self.velocity = 0.0
            return
        forced = -acceleration / ((pole - decay) ** 2 + ringing * ringing)  # pole² - 2 ζ ω pole + ω²
        free = self.position - self._passed - forced
        free_velocity = self.velocity - velocity + pole * forced
        faded, fading = exp(-decay * passed_s), exp(-pole * passed_s)
        cosine, sine = cos(ringing * passed_s), sin(ringing * passed_s)
        of_sine = (free_velocity + decay * free) / ringing
        deviation = faded * (free * cosine + of_sine * sine) + forced * fading
        deviation_velocity = (
            faded * ((of_sine * ringing - decay * free) * cosine - (free * ringing + decay * of_sine) * sine)
            - pole * forced * fading
        )
        # The velocity of p at the end: the integral of its acceleration.
        self.velocity = velocity - acceleration * expm1(-pole * passed_s) / pole + deviation_velocity
        self._passed = end
        self.position = end + deviation
