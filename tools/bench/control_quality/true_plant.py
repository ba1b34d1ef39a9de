"""The plant that a law drives in the suite: that of the simulation, with load, delay, quantum and noise by the tick."""

import random
from dataclasses import dataclass

from twostage_servo.simulation.coupling import Coupling
from twostage_servo.simulation.plant import TruePlant as Drive


@dataclass(frozen=True, slots=True)
class TrueAxis:
    """One axis as it really is.

    Attributes
    ----------
    gain, pole
        b and a, in axis unit/s² per effort unit and 1/s.
    friction, load
        c and w, in effort unit.
    delay_ticks
        How many ticks later than the model says an effort acts.
    effort_limit, effort_rate
        Of the drive, in effort unit and effort unit/s.
    quantum
        Step of the encoder, in axis unit; 0 for none.
    noise
        Standard deviation of the encoder, in axis unit.
    resonance_hz, resonance_damping
        Of the load with the encoder on it, in Hz and as a damping ratio; 0 Hz where it is fixed to the drive.
    backlash
        Between drive and load, in axis unit.
    """

    gain: float
    pole: float
    friction: float = 0.0
    load: float = 0.0
    delay_ticks: int = 0
    effort_limit: float = 10.0
    effort_rate: float = 1000.0
    quantum: float = 0.01
    noise: float = 0.0
    resonance_hz: float = 0.0
    resonance_damping: float = 0.02
    backlash: float = 0.0


class TruePlant:
    """Moves an axis tick by tick.

    Parameters
    ----------
    axis
        What it is like.
    period_s
        The tick, in s.
    seed
        Of the encoder's noise.

    Attributes
    ----------
    axis
        As given.
    load
        As the axis', until it is changed: a load step.
    """

    __slots__ = ("_drive", "_efforts", "_encoder_side", "_period_s", "_random", "axis", "load")

    def __init__(self, axis: TrueAxis, period_s: float, seed: int) -> None:
        self.axis = axis
        self._period_s = period_s
        self._random = random.Random(seed)  # noqa: S311 - no secret
        self._efforts = [0.0] * axis.delay_ticks
        self.load = axis.load
        coupling = None
        if axis.resonance_hz or axis.backlash:
            coupling = Coupling(axis.resonance_hz, axis.resonance_damping, axis.backlash, 0.0)
        self._drive = Drive(axis.gain, axis.pole, axis.friction, coupling=coupling)
        self._encoder_side = self._drive if coupling is None else coupling

    def sample(self) -> float:
        """Return what the encoder shows now, in axis unit."""
        axis, shown = self.axis, self.position
        if axis.noise:
            shown += axis.noise * self._random.gauss(0.0, 1.0)
        return axis.quantum * round(shown / axis.quantum) if axis.quantum else shown

    def advance(self, effort: float) -> None:
        """Let an effort (effort unit) act for a tick."""
        if self._efforts:
            self._efforts.append(effort)
            effort = self._efforts.pop(0)
        self._drive.advance(self._period_s, effort - self.load)

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower; not with a coupling."""
        self._drive.position += distance

    @property
    def position(self) -> float:
        """The truth, in axis unit."""
        return self._encoder_side.position

    @property
    def velocity(self) -> float:
        """The truth, in axis unit/s."""
        return self._encoder_side.velocity

    @velocity.setter
    def velocity(self, velocity: float) -> None:
        self._drive.velocity = self._encoder_side.velocity = velocity
