"""The plant that a law drives in the suite: exact from event to event, with friction, load, delay, quantum and noise.

``y'' = b (u - w - c sign(y')) - a y'``, with Coulomb friction c and load w in effort unit. Where the speed reaches zero
within a tick, that instant is computed: there the plant sticks if the effort cannot overcome the friction, or turns.
"""

import random
from dataclasses import dataclass
from math import copysign, exp, log1p


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
    position, velocity
        The truth, in axis unit and axis unit/s.
    load
        As the axis', until it is changed: a load step.
    """

    __slots__ = ("_efforts", "_period_s", "_random", "axis", "load", "position", "velocity")

    def __init__(self, axis: TrueAxis, period_s: float, seed: int) -> None:
        self.axis = axis
        self._period_s = period_s
        self._random = random.Random(seed)  # noqa: S311 - no secret
        self._efforts = [0.0] * axis.delay_ticks
        self.position = self.velocity = 0.0
        self.load = axis.load

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
        gain, pole, friction = self.axis.gain, self.axis.pole, self.axis.friction
        net, left_s = effort - self.load, self._period_s
        while left_s > 0.0:
            velocity = self.velocity
            if velocity == 0.0:
                if abs(net) <= friction:
                    return
                sign = copysign(1.0, net * gain)
            else:
                sign = copysign(1.0, velocity)
            final = gain / pole * (net - copysign(friction, gain) * sign)  # the speed that it tends to
            step_s = left_s
            if velocity != 0.0 and final * velocity < 0.0:
                stop_s = log1p(-velocity / final) / pole  # until it stands
                step_s = min(left_s, stop_s)
            decay = exp(-pole * step_s)
            stands = step_s < left_s
            self.position += final * step_s + (velocity - final) * (1.0 - decay) / pole
            self.velocity = 0.0 if stands else final + (velocity - final) * decay
            left_s -= step_s
