"""The laws that are compared: those of the project by its registry, and the baselines with the values found."""

import functools
import json
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from tools.bench.control_quality.suite import GAIN, PERIOD_S, POLE, SuiteLaw
from tools.bench.control_quality.true_plant import TrueAxis
from twostage_servo.axis.design import AxisDesign, design_axis
from twostage_servo.config.loader import load
from twostage_servo.control.baselines.tunable import TunableLawType, Values
from twostage_servo.control.laws.law import Controller, ControlTask
from twostage_servo.control.laws.registry import LAWS
from twostage_servo.control.observer import NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

_BASELINES: Final = {
    "trapezoid": ("trapezoid", "TRAPEZOID"),
    "jerk_limited": ("jerk_limited", "JERK_LIMITED"),
    "ptos": ("proximate_time_optimal", "PROXIMATE_TIME_OPTIMAL"),
    "cnf": ("composite_nonlinear", "COMPOSITE_NONLINEAR"),
    "initial_value_compensation": ("initial_value", "INITIAL_VALUE"),
    "adrc": ("active_disturbance_rejection", "ACTIVE_DISTURBANCE_REJECTION"),
    "pid": ("profile_pid", "PROFILE_PID"),
}
"""Name, module and attribute of each."""
TUNED: Final = Path(__file__).with_name("tuned.json")
"""Values that the optimiser has found: ``laws``, by law and noise level, beside ``seed`` and ``budget``."""
_NO_LIMIT: Final = 1e9
"""Acceleration in mm/s²: the suite's axes have no limit of it."""


def project_laws() -> list[str]:
    """Return the names of the laws that are installed."""
    return LAWS.names()


def baselines() -> list[str]:
    """Return the names of the baselines whose packages are installed."""
    return [name for name in _BASELINES if _found(name) is not None]


def missing() -> dict[str, str]:
    """Return which package each baseline lacks that cannot be had."""
    return {name: "ruckig" for name in _BASELINES if _found(name) is None}


def baseline(name: str) -> TunableLawType:
    """Return a baseline and its parameters.

    Raises
    ------
    LookupError
        If there is none of this name, or its package is not installed.
    """
    found = _found(name) if name in _BASELINES else None
    if found is None:
        raise LookupError(f"no baseline {name!r} can be had; there are: {', '.join(baselines())}")
    return found


@functools.cache
def _found(name: str) -> TunableLawType | None:
    module, attribute = _BASELINES[name]
    try:
        law_type: TunableLawType = getattr(import_module(f"twostage_servo.control.baselines.{module}"), attribute)
    except ModuleNotFoundError as error:
        if error.name != "ruckig":
            raise
        return None
    return law_type


def law_for(name: str, axis: TrueAxis) -> SuiteLaw:
    """Return a fresh law for an axis of which it knows the limits and the encoder, and the suite's model."""
    if name in _BASELINES:
        return baseline(name).build(task_for(axis.effort_limit, axis.effort_rate), values_of(name, axis.noise))
    return project_design(name, axis.effort_limit, axis.effort_rate, axis.noise).build_law()


def controller_of(name: str, axis: TrueAxis) -> Controller:
    """Return what a law is at rest near its set-point, as a linear system.

    Raises
    ------
    LookupError
        If the law's design does not tell.
    """
    if name in _BASELINES:
        values = values_of(name, axis.noise)
        return baseline(name).build(task_for(axis.effort_limit, axis.effort_rate), values).controller()
    loop = project_design(name, axis.effort_limit, axis.effort_rate, axis.noise).law.loops().get("position")
    if loop is None or loop.controller is None:
        raise LookupError(f"the law {name!r} does not tell its position stage")
    return loop.controller


@functools.cache
def task_for(effort_limit: float, effort_rate: float) -> ControlTask:
    """Return the task of every baseline on the suite's model."""
    plant = Plant(GAIN, POLE)
    sampled = plant.discretise(PERIOD_S)
    return ControlTask(
        plant=plant,
        sampled=sampled,
        period_s=PERIOD_S,
        noise=NoiseModel(),
        kalman=kalman_gain(sampled, NoiseModel()),
        velocity_limit=_NO_LIMIT,
        acceleration_limit=_NO_LIMIT,
        effort_limit=effort_limit,
        effort_rate_limit=effort_rate,
        rest_velocity=0.0,
    )


@functools.cache
def project_design(name: str, effort_limit: float, effort_rate: float, noise: float) -> AxisDesign:  # noqa: ARG001
    """Return the design of the demo's axis with a law, with an axis' own limits of the effort and no other.

    Parameters
    ----------
    name
        Of the law.
    effort_limit, effort_rate
        In V and V/s.
    noise
        Of the encoder, in mm; no law is told of it yet.
    """
    velocity = min(250.0, 0.99 * effort_limit * GAIN / POLE)  # what a valid configuration may ask for
    overrides = (
        f"axis.law.type={name}", f"axis.limits.effort={effort_limit}", f"axis.limits.effort_rate={effort_rate}",
        f"axis.limits.velocity={velocity}", "axis.cruise_velocity=20", f"axis.limits.acceleration={_NO_LIMIT}",
        f"axis.limits.quick_stop_deceleration={_NO_LIMIT}",
    )  # fmt: skip
    return design_axis(load(None, overrides).config.axis, PERIOD_S)


@functools.cache
def _tuned() -> Mapping[str, Any]:
    found: Mapping[str, Any] = json.loads(TUNED.read_text("utf-8")) if TUNED.exists() else {}
    return found


def tuning_budget() -> int:
    """Return the evaluations that each baseline had."""
    return int(_tuned().get("budget", 0))


def values_of(name: str, noise: float) -> Values:
    """Return the values that a baseline runs with at a noise level; those to begin with where it was not tuned."""
    found: Values = _tuned().get("laws", {}).get(name, {}).get(level(noise), {}).get("values", {})
    return {**baseline(name).start(), **found}


def level(noise: float) -> str:
    """Return the name of a noise level."""
    return f"{noise:g}"


Maker = Callable[[TrueAxis], SuiteLaw]
"""From an axis to a fresh law for it."""
