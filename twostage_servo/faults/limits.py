"""What one encoder cannot tell, so that a fault may be tolerated there: each with the reason, for the docs."""

from collections.abc import Callable
from typing import NamedTuple

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.detection import slowest_certain_velocity
from twostage_servo.config.loader import Config
from twostage_servo.control.model_monitor.monitor import NOISE_SHARE
from twostage_servo.control.plant import MODEL_ERROR


class Motion(NamedTuple):
    """The motion that a fault falls into, as it is without the fault.

    Attributes
    ----------
    config, design
        The axis.
    speed
        Its largest, in axis unit/s.
    """

    config: Config
    design: AxisDesign
    speed: float


Limit = Callable[[Motion], str]
"""Says what one encoder cannot tell in a motion; empty where it can."""


def either(*limits: Limit) -> Limit:
    """Say what the first of some limits says that says anything."""
    return lambda motion: next(filter(None, (limit(motion) for limit in limits)), "")


def too_slow(motion: Motion) -> str:
    """Say where an axis is slower than the speed from which on `check` says that a change of its encoder shows."""
    certain, unit = slowest_certain_velocity(motion.design), motion.config.axis.unit
    if motion.speed >= certain:
        return ""
    return (
        f"the axis moves at {motion.speed:.3g} {unit}/s at most, and a change of its encoder shows at "
        f"{certain:.3g} {unit}/s or more (`check`, certain_from_velocity)"
    )


def looks_like_the_model(factor: float) -> Limit:
    """Say where a plant off its model looks as if it were not, once the encoder counts so many times as much."""

    def limit(motion: Motion) -> str:
        model, true = motion.config.axis.plant, motion.config.simulation
        share = factor * (true.gain / true.pole) / (model.gain / model.pole)
        if abs(share - 1.0) > MODEL_ERROR:
            return ""
        return (
            f"in a cruise the true plant moves {share / factor:.0%} of what its model predicts, so the encoder shows "
            f"{share:.0%} of it, which is closer to the model than before: one encoder cannot tell"
        )

    return limit


_LOUD_NOISE = 0.1
"""Share of what hides everything, from which noise hides a scale that has no cruise to show in."""


def hidden_by_noise(motion: Motion) -> str:
    """Say where the encoder's noise hides a scale that is another one from rest on."""
    config = motion.config
    noise = config.simulation.noise_std
    hides = NOISE_SHARE * config.axis.observer.measurement_variance**0.5
    if noise < _LOUD_NOISE * hides:
        return ""
    return (
        f"the noise of {noise:g} {config.axis.unit} hides a wrong scale while the axis accelerates, and in a cruise a "
        "scale that was wrong from the start looks like a load: one encoder cannot tell"
    )
