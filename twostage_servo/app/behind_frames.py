"""The paper's examples through the whole service, over CAN frames in simulated time, beside the law alone."""

import asyncio

from twostage_servo.api.fields import JsonObject
from twostage_servo.app.demonstration import Demonstration, demonstrate
from twostage_servo.axis.state import MOVING, State
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.loader import load
from twostage_servo.paper.examples import SET_POINT, VELOCITY, Example
from twostage_servo.paper.experiment import Run, simulate
from twostage_servo.paper.frames import EXTRA_DELAY_MS, FramesComparison
from twostage_servo.paper.methods import METHODS
from twostage_servo.timing.virtual_clock import VirtualClockLoop


def compare_with_frames(example: Example) -> FramesComparison:
    """Run the example's shipped configuration over frames and the law alone, and compare tick by tick.

    Raises
    ------
    RuntimeError
        If the axis trips or does not arrive.
    """
    quiet = _demonstrate(example, "simulation.noise_std=0")
    position_quantum, effort_quantum = quiet.traits.position_quantum or 0.0, quiet.traits.effort_quantum or 0.0
    alone = simulate(METHODS["proposed"].build, example, noise_variance=0.0)
    rounded = simulate(
        METHODS["proposed"].build,
        example,
        noise_variance=0.0,
        position_quantum=position_quantum,
        effort_quantum=effort_quantum,
    )
    position_difference, effort_difference, ticks = _differences(quiet, alone)
    _, unexplained, _ = _differences(quiet, rounded)
    return FramesComparison(
        position_quantum=position_quantum,
        effort_quantum=effort_quantum,
        position_difference=position_difference,
        effort_difference=effort_difference,
        effort_difference_unexplained=unexplained,
        ticks=ticks,
        frames=_figures(_demonstrate(example)),
        delayed=_figures(_demonstrate(example, f"simulation.delay_ms={EXTRA_DELAY_MS}")),
    )


def _demonstrate(example: Example, *overrides: str) -> Demonstration:
    loaded = load(shipped_configuration(f"{example.name}.toml"), list(overrides))
    with asyncio.Runner(loop_factory=VirtualClockLoop) as runner:
        demonstration = runner.run(demonstrate(loaded, SET_POINT, VELOCITY))
    if demonstration.failure is not None:
        raise RuntimeError(f"{example.name}.toml over frames{[*overrides] or ''}: {demonstration.failure}")
    return demonstration


def _differences(demonstration: Demonstration, run: Run) -> tuple[float, float, int]:
    """Return the largest differences of position (mm) and effort (V) over the move, and the number of its ticks.

    The drive samples when a command arrives, and the loop reads that sample at the next tick.
    """
    samples = demonstration.samples
    start = next(index for index, sample in enumerate(samples) if sample.sample.state in MOVING)
    position = effort = 0.0
    ticks = 0
    for now, after, alone_position, alone_effort in zip(
        samples[start:], samples[start + 1 :], run.position, run.effort, strict=False
    ):
        if after.sample.state not in MOVING | {State.HOLDING}:
            break
        assert after.sample.measured_position is not None  # noqa: S101 - every tick of a move has its sample, in simulated time
        position = max(position, abs(after.sample.measured_position - alone_position))
        effort = max(effort, abs(now.sample.effort - alone_effort))
        ticks += 1
    return position, effort, ticks


def _figures(demonstration: Demonstration) -> JsonObject:
    result = demonstration.result()
    figures = {name: result[name] for name in ("overshoot", "settling_time_s", "final_error")}
    return {**figures, "speed_overshoot": max(0.0, result["peak_velocity"] - VELOCITY)}
