"""Time one control step, observer and law, beside the same equations in numpy matrices, in one run and in both orders.

`python tools/bench/control_step.py [--json]`. The budget is 2 µs a step.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable

import numpy as np

from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, extended_model, kalman_gain
from twostage_servo.control.optimal import servo_gains
from twostage_servo.control.plant import Plant
from twostage_servo.control.two_stage import TwoStageLaw

_PERIOD_S = 0.01
_STEPS = 20_000
_ROUNDS = 10


def ours(target: float) -> Callable[[float], float]:
    """Return the step of the law, in the position stage for a near target and in the speed stage for a far one."""
    plant = Plant(180.0, 14.0).discretise(_PERIOD_S)
    observer = DisturbanceObserver(plant, kalman_gain(plant, NoiseModel()).predictor)
    law = TwoStageLaw(observer, servo_gains(plant, 5e-5), _PERIOD_S, acceleration_limit=2000.0, effort_limit=24.0)
    law.set_target(target, 100.0)
    return law.step


def in_matrices() -> Callable[[float], float]:
    """Return the speed stage written with numpy arrays."""
    plant = Plant(180.0, 14.0).discretise(_PERIOD_S)
    state, effort_column, output = extended_model(plant, 1.0)
    gain = np.array(kalman_gain(plant, NoiseModel()).predictor).reshape(3, 1)
    gains = servo_gains(plant, 5e-5)
    estimate = np.zeros((3, 1))
    total = effort = 0.0

    def step(sample: float) -> float:
        nonlocal estimate, total, effort
        estimate = state @ estimate + effort_column * effort + gain * (sample - output @ estimate)
        velocity = float(estimate[1, 0])
        effort = total - gains.f12 * velocity
        total += gains.f22 * (100.0 - velocity)
        return effort

    return step


def microseconds(step: Callable[[float], float]) -> float:
    """Return the mean time of a step over one round."""
    begun = time.perf_counter()
    for _ in range(_STEPS):
        step(0.5)
    return 1e6 * (time.perf_counter() - begun) / _STEPS


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    as_json = parser.parse_args().json
    contenders = {"speed_stage": ours(1e9), "position_stage": ours(1.0), "numpy": in_matrices()}
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for round_number in range(_ROUNDS):
        for name in list(contenders)[:: 1 if round_number % 2 else -1]:
            times[name].append(microseconds(contenders[name]))
    result = {
        name: {"p50": round(statistics.median(values), 3), "min": round(min(values), 3), "max": round(max(values), 3)}
        for name, values in times.items()
    }
    if as_json:
        print(json.dumps({"control_step_us": result}))
        return
    for name, values in result.items():
        print(f"{name:16} median {values['p50']:7.3f} µs, from {values['min']:.3f} to {values['max']:.3f}")


if __name__ == "__main__":
    main()
