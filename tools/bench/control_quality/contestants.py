"""The laws that are compared: those of the project by its registry, and the baselines with the values found."""

import functools
import json
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from tools.bench.control_quality.suite import Case, Model, SuiteLaw
from twostage_servo.axis.design import AxisDesign, design_axis
from twostage_servo.config.loader import load
from twostage_servo.control.baselines.tunable import TunableLaw, TunableLawType, Values
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
    "paper_tuned": ("optimal_two_stage", "OPTIMAL_TWO_STAGE"),
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


def law_for(name: str, case: Case) -> SuiteLaw:
    """Return a fresh law for the axis of a case, of which it knows the model, the limits and the encoder."""
    if name in _BASELINES:
        return _built(name, case)
    return design_for(name, case).build_law()


def controller_of(name: str, case: Case) -> Controller:
    """Return what a law is at rest near its set-point, as a linear system.

    Raises
    ------
    LookupError
        If the law's design does not tell.
    """
    if name in _BASELINES:
        return _built(name, case).controller()
    loop = design_for(name, case).law.loops().get("position")
    if loop is None or loop.controller is None:
        raise LookupError(f"the law {name!r} does not tell its position stage")
    return loop.controller


def design_for(name: str, case: Case) -> AxisDesign:
    """Return the design of a law of the project for the axis of a case."""
    axis = case.axis
    encoder = max(axis.noise, axis.quantum / 3.0)
    return project_design(name, case.model, axis.effort_limit, axis.effort_rate, encoder)


def encoder_keys(name: str, encoder: float) -> list[str]:
    """Return what tells a law of the project the encoder's standard deviation, in mm, if it has a key for it."""
    known = "encoder_noise" in LAWS.get(name).settings.model_fields
    return [f"axis.law.{name}.encoder_noise={encoder}"] if known else []


def _built(name: str, case: Case) -> TunableLaw:
    return baseline(name).build(task_for(case), values_of(name, case.axis.noise))


def task_for(case: Case) -> ControlTask:
    """Return the task of every baseline for a case."""
    return _task(case.model, case.axis.effort_limit, case.axis.effort_rate)


@functools.lru_cache(maxsize=256)
def _task(model: Model, effort_limit: float, effort_rate: float) -> ControlTask:
    plant = Plant(model.gain, model.pole)
    sampled = plant.discretise(model.period_s)
    return ControlTask(
        plant=plant,
        sampled=sampled,
        period_s=model.period_s,
        noise=NoiseModel(),
        kalman=kalman_gain(sampled, NoiseModel()),
        velocity_limit=_NO_LIMIT,
        acceleration_limit=_NO_LIMIT,
        effort_limit=effort_limit,
        effort_rate_limit=effort_rate,
        rest_velocity=0.0,
    )


@functools.lru_cache(maxsize=256)
def project_design(name: str, model: Model, effort_limit: float, effort_rate: float, encoder: float) -> AxisDesign:
    """Return the design of the demo's axis with a law and a model, with an axis' own limits of the effort and no other.

    Parameters
    ----------
    name
        Of the law.
    model
        Gain, pole and tick.
    effort_limit, effort_rate
        In V and V/s.
    encoder
        Standard deviation of a sample, in mm: of its noise, or a third of its quantum where that is more.
    """
    settings = load(None, [f"axis.law.type={name}", *encoder_keys(name, encoder)]).config.axis
    velocity = 0.9 * effort_limit * abs(model.gain) / model.pole  # what a valid configuration may ask for
    limits = {
        "effort": effort_limit, "effort_rate": effort_rate, "acceleration": _NO_LIMIT,
        "quick_stop_deceleration": _NO_LIMIT, "velocity": velocity, "overspeed": 2.0 * velocity,
    }  # fmt: skip
    # Copied, not loaded: the demo's other limits are in mm, and do not matter to a law.
    update = {
        "plant": settings.plant.model_copy(update={"gain": model.gain, "pole": model.pole}),
        "limits": settings.limits.model_copy(update=limits),
    }
    return design_axis(settings.model_copy(update=update), model.period_s)


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
