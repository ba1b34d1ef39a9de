"""The PID controller of the introduction, whose overshoot grows with the set-point."""

from twostage_servo.control.baselines.velocity import Differentiator
from twostage_servo.control.optimal import ServoGains


class Pid:
    """Discrete PID: ``u(k) = Kp e(k) + Ki T_s sum(e(0)..e(k-1)) - Kd (y(k) - y(k-1)) / T_s``.

    The derivative acts on the output alone, as in every industrial PID, so that a step of the set-point does not kick.

    The paper names no gains. These are the optimal servo's own numbers, so nothing is tuned in anybody's favour:
    ``Kp = f11``, ``Ki = f22 / T_s``, ``Kd = f12``. The loop, and with it the poles, are then those of section II with a
    differentiated velocity; but the proportional part sees the set-point, which adds a zero, and with it overshoot.

    Parameters
    ----------
    gains
        f11, f12, f22.
    period_s
        T_s in s.
    """

    sample_age = 0

    def __init__(self, gains: ServoGains, period_s: float) -> None:
        self._f11, self._f12, self._f22 = gains.f11, gains.f12, gains.f22
        self._differentiate = Differentiator(period_s)
        self._sum = 0.0
        self._target = 0.0
        self.velocity = 0.0
        self.changeovers = 0

    def set_target(self, target: float, velocity: float) -> None:  # noqa: ARG002 - the face of every law
        """Set a set-point in axis unit; a PID drives there as fast as its gains make it."""
        self._target = target

    def step(self, sample: float) -> float:
        """Process ``y(k)`` in axis unit; return the effort ``u(k)`` in effort unit."""
        error = self._target - sample
        self.velocity = self._differentiate(sample)
        effort = self._f11 * error + self._sum - self._f12 * self.velocity
        self._sum += self._f22 * error
        return effort
