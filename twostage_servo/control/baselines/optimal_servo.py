"""The optimal servo of section II: one stage, state feedback and a summed error, equations (1)-(13)."""

from twostage_servo.control.baselines.velocity import VelocitySource
from twostage_servo.control.optimal import ServoGains


class OptimalServo:
    """Incremental state feedback, equation (12) with the sign of erratum 2.

    ``u(k) = u(k-1) - f11 (y(k) - y(k-1)) - f12 (x2(k) - x2(k-1)) + f22 e(k-1)``. A step of the set-point reaches the
    effort through the sum alone; how fast the axis then runs follows from the distance, nothing limits it.

    Parameters
    ----------
    gains
        f11, f12, f22.
    velocity_source
        Measures x2; section II takes the whole state as known.
    """

    sample_age = 0

    def __init__(self, gains: ServoGains, velocity_source: VelocitySource) -> None:
        self._f11, self._f12, self._f22 = gains.f11, gains.f12, gains.f22
        self._measure = velocity_source
        self._effort = self._error = self._sample = self._target = 0.0
        self._started = False
        self.velocity = 0.0
        self.changeovers = 0

    def set_target(self, target: float, velocity: float) -> None:  # noqa: ARG002 - the face of every law
        """Set a set-point in axis unit; the servo drives there as fast as its gains make it."""
        self._target = target

    def step(self, sample: float) -> float:
        """Process ``y(k)`` in axis unit; return the effort ``u(k)`` in effort unit."""
        velocity = self._measure(sample)
        if self._started:
            self._effort += (
                -self._f11 * (sample - self._sample) - self._f12 * (velocity - self.velocity) + self._f22 * self._error
            )
        self._started = True
        self._sample, self.velocity, self._error = sample, velocity, self._target - sample
        return self._effort
