"""The axes that a soak runs on: other units, other plants, other ticks and other innovation gates, by seed.

Each of them follows from the demo's by a change of units, :func:`converted`. With positions scaled by s and times by t
(both the new number over the old one), and the effort as it is, ``x'' = gain u - pole x'`` keeps its form if::

    gain -> gain s/t²        pole -> pole/t        velocity -> s/t        acceleration -> s/t²

and a tick of t T samples the same motion. The optimal design (11) weighs ``q (dy² + e²)`` in (axis unit)² against
``du²``, so q -> q/s² gives the same effort. The filter's variances are squares of what they are variances of: position
and measurement s², velocity (s/t)², disturbance 1. All poles in z then stay where they are.

Another tick for the same motion, T' = r T, is no change of units: here the costs and the noise *per second* are kept.
Summed over ticks, ``e²`` counts 1/T and ``du² = (u' T)²`` counts T, so q -> q r². A random walk adds variance in
proportion to the time, process variances -> r; and of measurements, whose number per second falls, one may be by so
much worse for the same result, measurement variance -> 1/r. The poles in s then stay near where they are.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator
from random import Random
from typing import Any

from twostage_servo.app.assembly import design
from twostage_servo.app.build import build_parts
from twostage_servo.axis.detection import detections
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.loader import Config, LoadedConfig, load

GATES = (0.025, 0.1, 0.25, 0.5)
"""Innovation gates at standstill as shares of the position overrun: 0.5, 2, 5 and 10 mm of the demo's 20."""

LEAST_STALE_TICKS = 3
"""Ticks without feedback that an axis on a long tick has to bridge as well: one may be lost, and one be late."""

_DEMO_TICK_S = 0.01

_QUIETER = (1.0, 0.1, 0.01, 1e-3, 1e-4)
"""Shares of the measurement variance that are tried, one after the other."""

_LENGTHS = (
    "position_minimum", "position_maximum", "position_overrun", "following_error_minimum", "innovation_gate",
)  # fmt: skip


@dataclasses.dataclass(frozen=True, slots=True)
class Kind:
    """A kind of axis.

    Attributes
    ----------
    name, unit
        What it is called, and its unit of position.
    length, time
        s and t of this module.
    ticks_ms
        Ticks that it is run on, in ms.
    """

    name: str
    unit: str
    length: float
    time: float
    ticks_ms: tuple[float, ...]


def kind_of(name: str, unit: str, gain: float, pole: float, ticks_ms: tuple[float, ...]) -> Kind:
    """Return the kind of axis that has this plant: gain in axis unit/s²/effort unit, pole in 1/s."""
    plant = load(None).config.axis.plant
    time = plant.pole / pole
    return Kind(name, unit, gain * time**2 / plant.gain, time, ticks_ms)


KINDS = (
    Kind("linear", "mm", 1.0, 1.0, (1.0, 2.0, 5.0, 10.0, 20.0)),
    Kind("metres", "m", 0.001, 1.0, (1.0, 2.0, 5.0, 10.0, 20.0)),
    kind_of("rotary", "deg", 900.0, 6.0, (2.0, 5.0, 10.0, 20.0)),
    kind_of("slow", "m", 0.5, 0.5, (20.0,)),
    kind_of("quick", "mm", 5000.0, 60.0, (1.0,)),
)


@dataclasses.dataclass(frozen=True, slots=True)
class Configuration:
    """A configuration, as overrides of the demo's file.

    Attributes
    ----------
    name
        Kind, tick, gate and what else is random about it.
    overrides
        ``KEY=VALUE`` of each key that differs from the demo's.
    tick_s
        Its tick in s.
    """

    name: str
    overrides: tuple[str, ...]
    tick_s: float

    def load(self, *more: str) -> LoadedConfig[Config]:
        """Load it, with further overrides."""
        return load(None, [*self.overrides, *more])

    def check(self) -> None:
        """Raise what `check` says of it.

        Raises
        ------
        ConfigError
            If it refuses it.
        """
        build_parts(self.load())


def converted(length: float, time: float, tick_s: float, *, same_loop: bool = True) -> dict[str, Any]:
    """Return the keys of the demo's axis after a change of units, on a tick in s.

    Parameters
    ----------
    length, time
        s and t of this module.
    tick_s
        The tick; that which samples the same motion is t times the demo's.
    same_loop
        Whether Q/R and variances are converted to the tick as well; else they are those of the tick that samples the
        same motion, and the loop is as quick as they make it.
    """
    config = load(None).config
    axis, limits, r = config.axis, config.axis.limits, tick_s / (time * _DEMO_TICK_S) if same_loop else 1.0
    observer, speed = axis.observer, length / time
    keys: dict[str, Any] = {
        "service.tick_ms": 1e3 * tick_s,
        "protocol.feedback.position_scale": length,
        "axis.cruise_velocity": axis.cruise_velocity * speed,
        "axis.plant.gain": axis.plant.gain * length / time**2,
        "axis.plant.pole": axis.plant.pole / time,
        "axis.law.type": "paper",
        "axis.law.performance_index_ratio": axis.law.paper.performance_index_ratio / length**2 * r**2,
        "axis.observer.position_variance": observer.position_variance * length**2 * r,
        "axis.observer.velocity_variance": observer.velocity_variance * speed**2 * r,
        "axis.observer.disturbance_variance": observer.disturbance_variance * r,
        "axis.observer.measurement_variance": observer.measurement_variance * length**2 / r,
        "axis.window.position": axis.window.position * length,
        "axis.window.time_ms": axis.window.time_ms * time,
        "axis.homing.velocity": axis.homing.velocity * speed,
        "axis.homing.slow_velocity": axis.homing.slow_velocity * speed,
        "axis.homing.stop_time_ms": axis.homing.stop_time_ms * time,
        "axis.homing.travel": axis.homing.travel * length,
        "axis.approach.distance": axis.approach.distance * length,
        **{f"axis.limits.{name}": getattr(limits, name) * length for name in _LENGTHS},
        **{f"axis.limits.{name}": getattr(limits, name) * speed for name in ("velocity", "overspeed")},
        "axis.limits.acceleration": limits.acceleration * speed / time,
        "axis.limits.quick_stop_deceleration": limits.quick_stop_deceleration * speed / time,
        "axis.limits.effort_rate": limits.effort_rate / time,
        "axis.limits.effort_saturation_ms": limits.effort_saturation_ms * time,
        "axis.limits.following_error_time_s": limits.following_error_time_s * time,
        # By how much dates of samples are off depends on the tick, not on the plant.
        "axis.limits.innovation_time_ms": limits.innovation_time_ms * tick_s / _DEMO_TICK_S,
        "axis.limits.stall_time_ms": limits.stall_time_ms * time,
        "axis.limits.stale_feedback_ms": max(
            limits.stale_feedback_ms * min(time, 1.0), 1e3 * LEAST_STALE_TICKS * tick_s
        ),
    }
    simulation = config.simulation
    return keys | {
        "simulation.gain": simulation.gain * length / time**2,
        "simulation.pole": simulation.pole / time,
        "simulation.quantum": simulation.quantum * length,
        "simulation.cycle_ms": min(1e3 * tick_s, 5.0),
    }


def variants() -> Iterator[tuple[Kind, float, float, bool]]:
    """Give each kind on each of its ticks (ms) with each gate, and whether the loop is kept the same."""
    for kind in KINDS:
        for tick_ms in kind.ticks_ms:
            for gate in GATES:
                for same_loop in (True, False) if kind.time == 1.0 else (True,):
                    yield kind, tick_ms, gate, same_loop


def configuration(kind: Kind, tick_ms: float, gate: float, *more: str, same_loop: bool = True) -> Configuration:
    """Return one configuration; `gate` is the innovation gate as a share of the position overrun."""
    keys = converted(kind.length, kind.time, tick_ms / 1e3, same_loop=same_loop)
    keys["axis.limits.innovation_gate"] = gate * keys["axis.limits.position_overrun"]
    overrides = [f'axis.unit="{kind.unit}"', *(f"{key}={value!r}" for key, value in keys.items()), *more]
    loop = "" if same_loop else ", the demo's Q/R and variances"
    name = f"{kind.name} ({kind.unit}), tick {tick_ms:g} ms, gate {gate:g} of the overrun{loop}"
    return Configuration(", ".join([name, *more]), tuple(overrides), tick_ms / 1e3)


@functools.cache
def quieter(kind: Kind, tick_ms: float, gate: float, *, same_loop: bool) -> tuple[str, ...]:
    """Return overrides with which a wrong encoder of this axis is noticed soon enough for `check`.

    The noise that the observer assumes is lowered as far as that takes; the encoders here have next to none. Where the
    position overrun does not do even so, the travel that is needed is stated.
    """
    axis = converted(kind.length, kind.time, tick_ms / 1e3, same_loop=same_loop)
    variance = axis["axis.observer.measurement_variance"]
    tried = configuration(kind, tick_ms, gate, same_loop=same_loop)
    for share in _QUIETER:
        more = () if share == 1.0 else (f"axis.observer.measurement_variance={share * variance!r}",)
        try:
            made = design(tried.load(*more))
        except ConfigError:  # a loop with so quick an observer is fragile
            continue
        travel = max(one.travel for one in detections(made))
        if travel <= made.settings.limits.position_overrun:
            return more
        if math.isfinite(travel):
            return (*more, f"axis.limits.undetected_travel={1.05 * travel!r}")
    raise ValueError(f"no noise makes a wrong encoder of the {kind.name} axis certain on a tick of {tick_ms:g} ms")


def homing_by_switch(kind: Kind) -> list[str]:
    """Return overrides by which an axis homes at a switch that is active from a place down, at its cruise velocity."""
    axis = load(None).config.axis
    speed = axis.cruise_velocity * kind.length / kind.time
    lowest, highest = axis.limits.position_minimum * kind.length, axis.limits.position_maximum * kind.length
    travel = 2.0 * (highest - lowest)
    return [
        'axis.homing.method="switch"',
        f"axis.homing.position={0.8 * lowest!r}",
        f"simulation.home_switch_from={100.0 * lowest!r}",
        f"simulation.home_switch_to={0.8 * lowest!r}",
        f"axis.homing.velocity={speed!r}",
        f"axis.homing.slow_velocity={0.1 * speed!r}",
        f"axis.homing.travel={travel!r}",
    ]


def drawn_by(seed: int) -> tuple[Configuration, Random]:
    """Return the configuration of an episode, and the source of everything else that is random in it."""
    random = Random(seed)  # noqa: S311 - a soak, no secret
    return draw(random), random


def draw(random: Random) -> Configuration:
    """Draw a configuration."""
    kind, tick_ms, gate, same_loop = random.choice(list(variants()))
    more = list(quieter(kind, tick_ms, gate, same_loop=same_loop))
    if random.random() < 0.25:  # a drive that is mounted the other way round
        gain = converted(kind.length, kind.time, tick_ms / 1e3)["axis.plant.gain"]
        more += [f"axis.plant.gain={-gain!r}", f"simulation.gain={-gain!r}"]
    if random.random() < 0.5:
        more += ["axis.homing.required=true", *homing_by_switch(kind)]
    return configuration(kind, tick_ms, gate, *more, same_loop=same_loop)
