"""One control step, beside the same equations written otherwise: ``python -m tools.bench.control_step``.

All contenders get the same samples: those of a closed loop that was recorded before. Each has to answer them with the
same efforts, or the measurement ends with an error. The speed stage is timed, and the position stage of the two that
have it, in CPU time of the thread, so that being preempted costs nothing. What is written with matrices has neither
change-over nor limits, which is in its favour.
"""

import argparse
import ctypes
import importlib
import importlib.util
import json
import subprocess
import sysconfig
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from tools.bench.children import json_of, module
from tools.bench.packages import what_is_missing
from tools.bench.plan import PERIOD_S, Plan
from tools.bench.summary import summarise
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, extended_model, kalman_gain
from twostage_servo.control.optimal import ServoGains, servo_gains
from twostage_servo.control.plant import DiscretePlant, Plant

Step = Callable[[float], float]

_SAMPLES: Final = 2000
_FAR: Final = 1e9
_NEAR: Final = 1.0
_VELOCITY: Final = 100.0
_ACCELERATION: Final = 2000.0
_EFFORT_LIMIT: Final = 24.0
_EFFORT_RATE: Final = 1000.0
_TOLERANCE: Final = 1e-6
"""Largest difference from the recorded efforts, in V."""


def measure(plan: Plan, priority: int, note: Callable[[str], None]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the figures of each contender in µs a step, and why others have none."""
    note(f"{plan.step_rounds} rounds")
    told = json_of(module("control_step", "--rounds", plan.step_rounds), 600.0, priority)
    return told["control_step_us"], told["not_measured"]


def design() -> tuple[DiscretePlant, DisturbanceObserver, ServoGains]:
    """Return plant, observer and gains of Example 1 of the paper."""
    plant = Plant(180.0, 14.0).discretise(PERIOD_S)
    observer = DisturbanceObserver(plant, kalman_gain(plant, NoiseModel()).predictor)
    return plant, observer, servo_gains(plant, 5e-5)


def ours(target: float = _FAR) -> Step:
    """Return the step of the law that the service runs."""
    _, observer, gains = design()
    law = TwoStageLaw(
        observer,
        gains,
        PERIOD_S,
        acceleration_limit=_ACCELERATION,
        effort_limit=_EFFORT_LIMIT,
        effort_rate_limit=_EFFORT_RATE,
    )
    law.set_target(target, _VELOCITY)
    return law.step


def compile_c(folder: Path) -> tuple[Callable[..., Step], Callable[..., Step]]:
    """Compile ``control_step.c``; return what makes a step for a set-point, and what makes one called by ctypes.

    One of all these steps works at a time.

    Raises
    ------
    subprocess.CalledProcessError
        If the compiler fails.
    """
    name = "control_step_in_c"
    library = folder / f"{name}.so"
    source = Path(__file__).with_suffix(".c")
    include = sysconfig.get_path("include")
    subprocess.run(  # noqa: S603 - our own words, and no shell
        ["cc", "-O2", "-shared", "-fPIC", f"-I{include}", "-o", str(library), str(source), "-lm"],  # noqa: S607
        check=True,
    )
    specification = importlib.util.spec_from_file_location(name, library)
    assert specification is not None  # noqa: S101 - the file is there
    assert specification.loader is not None  # noqa: S101
    compiled: Any = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(compiled)
    plant, _, gains = design()
    observer_gain = kalman_gain(plant, NoiseModel()).predictor

    plain = ctypes.CDLL(str(library)).control_step
    plain.argtypes, plain.restype = [ctypes.c_double], ctypes.c_double

    def start(target: float) -> None:
        compiled.start(
            plant.a12, plant.a22, plant.b1, plant.b2, *observer_gain, 1.0,
            gains.f11, gains.f12, gains.f22, gains.changeover_time_s(PERIOD_S),
            _ACCELERATION * PERIOD_S, _EFFORT_LIMIT, _EFFORT_RATE * PERIOD_S, target, _VELOCITY,
        )  # fmt: skip

    def make(target: float = _FAR) -> Step:
        start(target)
        step: Step = compiled.step
        return step

    def make_by_ctypes(target: float = _FAR) -> Step:
        start(target)
        return plain

    return make, make_by_ctypes


def in_numpy() -> Step:
    """Return observer and speed stage written with numpy arrays."""
    np: Any = importlib.import_module("numpy")
    plant, _, gains = design()
    state, effort_column, output = extended_model(plant, 1.0)
    gain = np.array(kalman_gain(plant, NoiseModel()).predictor).reshape(3, 1)
    estimate = np.zeros((3, 1))
    total = effort = reference = 0.0

    def step(sample: float) -> float:
        nonlocal estimate, total, effort, reference
        estimate = state @ estimate + effort_column * effort + gain * (sample - output @ estimate)
        velocity = float(estimate[1, 0])
        effort = total - gains.f12 * velocity
        reference = min(_VELOCITY, reference + _ACCELERATION * PERIOD_S)
        total += gains.f22 * (reference - velocity)
        return effort

    return step


def in_filterpy() -> Step:
    """Return observer and speed stage with filterpy's Kalman filter, which begins with its steady-state covariance."""
    np: Any = importlib.import_module("numpy")
    kalman: Any = importlib.import_module("filterpy.kalman")
    solve: Any = importlib.import_module("scipy.linalg").solve_discrete_are
    plant, _, gains = design()
    noise = NoiseModel()
    kalman_filter = kalman.KalmanFilter(dim_x=3, dim_z=1, dim_u=1)
    kalman_filter.F, kalman_filter.B, kalman_filter.H = extended_model(plant, noise.disturbance_memory)
    kalman_filter.Q = np.diag(noise.process_variance)
    kalman_filter.R = np.array([[noise.measurement_variance]])
    kalman_filter.P = solve(kalman_filter.F.T, kalman_filter.H.T, kalman_filter.Q, kalman_filter.R)
    total = effort = reference = 0.0

    def step(sample: float) -> float:
        nonlocal total, effort, reference
        kalman_filter.update(sample)
        kalman_filter.predict(u=effort)
        velocity = float(kalman_filter.x[1, 0])
        effort = total - gains.f12 * velocity
        reference = min(_VELOCITY, reference + _ACCELERATION * PERIOD_S)
        total += gains.f22 * (reference - velocity)
        return effort

    return step


def in_python_control() -> Step:
    """Return observer and speed stage as one state space of python-control, stepped by its output and dynamics.

    Its state is [estimate(k-1) (3), sum(k), u(k-1)], its input [y(k-1), reference(k)], its output u(k).
    """
    np: Any = importlib.import_module("numpy")
    control: Any = importlib.import_module("control")
    plant, _, gains = design()
    state, effort_column, output = extended_model(plant, 1.0)
    gain = np.array(kalman_gain(plant, NoiseModel()).predictor).reshape(3, 1)
    estimate = np.hstack([state - gain @ output, np.zeros((3, 1)), effort_column])  # rows of estimate(k)
    law = np.array([[0.0, 0.0, 0.0, 1.0, 0.0]]) - gains.f12 * estimate[1:2]
    total = np.array([[0.0, 0.0, 0.0, 1.0, 0.0]]) - gains.f22 * estimate[1:2]
    feed_law, feed_total = -gains.f12 * gain[1, 0], -gains.f22 * gain[1, 0]
    system = control.ss(
        np.vstack([estimate, total, law]),
        np.vstack([np.hstack([gain, np.zeros((3, 1))]), [[feed_total, gains.f22]], [[feed_law, 0.0]]]),
        law,
        np.array([[feed_law, 0.0]]),
        PERIOD_S,
    )
    now = np.zeros(5)
    reference = 0.0

    def step(sample: float) -> float:
        nonlocal now, reference
        reference = min(_VELOCITY, reference + _ACCELERATION * PERIOD_S)
        given = np.array([sample, reference])
        effort = float(system.output(0.0, now, given)[0])
        now = system.dynamics(0.0, now, given)
        return effort

    return step


def record(target: float) -> tuple[list[float], list[float]]:
    """Close the loop over the plant; return the samples in µm steps, and the efforts."""
    plant, _, _ = design()
    step = ours(target)
    position = velocity = sample = 0.0
    samples, efforts = [], []
    for _ in range(_SAMPLES):
        samples.append(sample)
        effort = step(sample)
        efforts.append(effort)
        sample = round(position, 3)
        position, velocity = (
            position + plant.a12 * velocity + plant.b1 * effort,
            plant.a22 * velocity + plant.b2 * effort,
        )
    return samples, efforts


def check(name: str, make: Callable[[], Step], samples: Sequence[float], efforts: Sequence[float]) -> None:
    """Compare a contender's efforts with the recorded ones.

    Raises
    ------
    ValueError
        If they differ: then the equations are not the same.
    """
    step = make()
    difference = max(abs(step(sample) - effort) for sample, effort in zip(samples, efforts, strict=True))
    if not difference <= _TOLERANCE:
        raise ValueError(f"{name} does not compute the same effort: the difference is {difference:g} V")


def microseconds(step: Step, samples: Sequence[float]) -> float:
    """Return the mean CPU time of a step over all samples, that of the loop around it included."""
    begun_s = time.thread_time()
    for sample in samples:
        step(sample)
    return 1e6 * (time.thread_time() - begun_s) / len(samples)


def compare(rounds: int, only: Sequence[str] = ()) -> dict[str, Any]:
    """Time all contenders in turns, in both orders; p50 and the others are over the rounds."""
    far, near = record(_FAR), record(_NEAR)
    with tempfile.TemporaryDirectory() as folder:
        made: dict[str, Callable[..., Step]] = {"ours": ours, "ours_position_stage": lambda: ours(_NEAR)}
        not_measured: dict[str, str] = {}
        in_c: list[Callable[..., Step]] = []
        no_c = what_is_missing("c")
        if no_c is None:
            try:
                in_c += compile_c(Path(folder))
            except (OSError, ImportError, subprocess.CalledProcessError) as error:
                no_c = f"the compiler does not do it: {error}"
        others: dict[str, Callable[[], Callable[..., Step]]] = {
            "c": lambda: in_c[0],
            "c_by_ctypes": lambda: in_c[1],
            "numpy": lambda: in_numpy,
            "filterpy": lambda: in_filterpy,
            "python_control": lambda: in_python_control,
        }
        for name, prepare in others.items():
            if only and name not in only:
                continue
            if reason := no_c if name in {"c", "c_by_ctypes"} else what_is_missing(name):
                not_measured[name] = reason
            else:
                made[name] = prepare()
        if "c" in made:
            made["c_position_stage"] = lambda: in_c[0](_NEAR)
        given = {name: near if name.endswith("position_stage") else far for name in made}
        for name, make in made.items():
            check(name, make, *given[name])
        times: dict[str, list[float]] = {name: [] for name in made}
        for round_number in range(rounds):
            for name in list(made)[:: -1 if round_number % 2 else 1]:
                times[name].append(microseconds(made[name](), given[name][0]))
    return {
        "control_step_us": {name: summarise(values) for name, values in times.items()},
        "not_measured": not_measured,
    }


def main() -> None:
    """Time and print JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--only", nargs="*", default=[], help="contenders beside our own")
    options = parser.parse_args()
    print(json.dumps(compare(options.rounds, options.only)))


if __name__ == "__main__":
    main()
