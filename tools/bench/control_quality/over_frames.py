"""A sample of the suite through the whole service: CAN frames, supervision and all, in simulated time.

The axis, the move and the way to look at it are those of the suite. What differs are the frames' own resolution, the
drive's own cycle, and the instant within a tick at which the move is asked for.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Final

from structlog.testing import capture_logs

from tools.bench.control_quality import contestants
from tools.bench.control_quality.jobs import run_jobs
from tools.bench.control_quality.suite import (
    GAIN,
    HELD_S,
    LONGEST_EXCESS_S,
    PERIOD_S,
    POLE,
    Case,
    cases,
    quickest_move,
    run,
)
from twostage_servo.app.closed_loop import ClosedLoop, Wires, closed_loop
from twostage_servo.axis.state import MOVING, State
from twostage_servo.config.loader import Config, LoadedConfig, load
from twostage_servo.timing.ticks import Tick
from twostage_servo.timing.virtual_clock import run as simulate

FIRST_SEED: Final = 3_000_000
_LOAD_AT_S: Final = 2.0
"""When the load sets in: the drive has been armed by then, and does not coast away under it."""
_READY_S: Final = 1.5


@dataclass(frozen=True, slots=True)
class FramesJob:
    """One law and one case."""

    law: str
    case: Case


@dataclass(frozen=True, slots=True)
class FramesOutcome:
    """What the first move of a case came to, by the law alone and over frames.

    Attributes
    ----------
    alone_s, frames_s
        Settling times; infinity where it did not settle.
    alone_overshoot, frames_overshoot
        In mm.
    trip
        Code of the trip over frames; empty without one.
    """

    alone_s: float
    frames_s: float
    alone_overshoot: float
    frames_overshoot: float
    trip: str


def valid_cases(count: int, noise: float = 0.0) -> list[Case]:
    """Return cases whose velocity a configuration may ask for: the model reaches it with its effort limit."""
    found: list[Case] = []
    seed = FIRST_SEED
    while len(found) < count:
        (case,) = cases(1, noise, seed)
        if case.velocity <= 0.9 * case.axis.effort_limit * GAIN / POLE:
            found.append(case)
        seed += 1
    return found


def configuration(law: str, case: Case) -> LoadedConfig[Config]:
    """Return the demo's configuration with the axis of a case as its simulated drive."""
    axis, velocity = case.axis, 0.9 * case.axis.effort_limit * GAIN / POLE
    simulation = {
        "gain": axis.gain, "pole": axis.pole, "coulomb_friction": axis.friction, "load": axis.load,
        "load_at_s": _LOAD_AT_S, "delay_ms": 1e3 * PERIOD_S * axis.delay_ticks, "quantum": axis.quantum,
        "noise_std": axis.noise, "seed": case.seed,
    }  # fmt: skip
    limits = {
        "effort": axis.effort_limit, "effort_rate": axis.effort_rate, "velocity": velocity,
        "overspeed": 2.0 * velocity, "acceleration": 1e9, "quick_stop_deceleration": 1e9,
    }  # fmt: skip
    overrides = [f"simulation.{key}={value}" for key, value in simulation.items()]
    overrides += [f"axis.limits.{key}={value}" for key, value in limits.items()]
    overrides += contestants.encoder_keys(law, max(axis.noise, axis.quantum / 3.0))
    return load(None, [f"axis.law.type={law}", f"axis.cruise_velocity={0.5 * velocity}", *overrides])


def outcome_of(job: FramesJob) -> FramesOutcome:
    """Run a case by the law alone and over frames."""
    case = job.case
    alone = run(contestants.law_for(job.law, case), case, 1)[0]
    with capture_logs():  # a trip is a figure here
        positions, trip = simulate(_positions(configuration(job.law, case), case))
    sign = 1.0 if case.distance > 0.0 else -1.0
    return FramesOutcome(
        alone.settling_s,
        inf if trip else _settling_s([abs(position - case.distance) for position in positions], case.band),
        alone.overshoot,
        max(0.0, *(sign * (position - case.distance) for position in positions)),
        trip,
    )


def _settling_s(errors: Sequence[float], band: float) -> float:
    """Return when an error enters the band for good, between ticks as well; infinity if it does not."""
    last = max((tick for tick, error in enumerate(errors) if error > band), default=-1)
    if last + 1 == len(errors):
        return inf
    return (last + (errors[last] - band) / (errors[last] - errors[last + 1])) * PERIOD_S if last >= 0 else 0.0


async def _positions(loaded: LoadedConfig[Config], case: Case) -> tuple[list[float], str]:
    """Return the true position at each tick from the first effort of a move on, and the code of a trip."""
    async with closed_loop(loaded, wires=Wires()) as loop:
        axis_loop = loop.axis_loop()
        axis, drive = axis_loop.axis, loop.axes[axis_loop.name].drive
        positions: list[float] = []

        def on_tick(_: Tick) -> None:
            if positions or axis.state in MOVING:
                positions.append(drive.position)

        await _arm(loop)
        await asyncio.sleep(_LOAD_AT_S + HELD_S)
        if axis.trip is None:
            axis.move_to(case.distance, case.velocity)
            loop.listen(on_tick)
            bound = quickest_move(case.axis, case.axis.load, case.distance, case.velocity).bound_s
            await asyncio.sleep(bound + LONGEST_EXCESS_S)
        return positions or [drive.position], "" if axis.trip is None else axis.trip.code.value


async def _arm(loop: ClosedLoop) -> None:
    """Arm the axis, and wait until it holds."""
    axis = loop.axis_loop().axis
    await _until(lambda: axis.ready_to_arm)
    axis.arm()
    await _until(lambda: axis.state is State.HOLDING or axis.trip is not None)


async def _until(condition: Callable[[], bool]) -> None:
    """Wait for a condition, for some time."""
    for _ in range(round(_READY_S / PERIOD_S)):
        if condition():
            return
        await asyncio.sleep(PERIOD_S)


def measure_frames(
    laws: Sequence[str], count: int, *, workers: int | None = None, show: bool = True
) -> dict[str, list[FramesOutcome]]:
    """Run a sample with each law; return the outcomes by law."""
    sample = valid_cases(count)
    jobs = [FramesJob(law, case) for law in laws for case in sample]
    outcomes: dict[str, list[FramesOutcome]] = {}
    for job, found in zip(jobs, run_jobs(outcome_of, jobs, workers=workers, show=show), strict=True):
        outcomes.setdefault(job.law, []).append(found)
    return outcomes


HEADINGS: Final = (
    "law", "moves", "tripped", "settled alone", "over frames", "largest difference of settling ms", "of overshoot mm",
)  # fmt: skip


def rows_of(outcomes: Mapping[str, Sequence[FramesOutcome]]) -> list[tuple[str, ...]]:
    """Return a row for each law; differences are those of moves that settled both ways, or did not trip."""
    rows: list[tuple[str, ...]] = []
    for law, found in outcomes.items():
        both = [one for one in found if one.alone_s < inf and one.frames_s < inf]
        trips = sorted({one.trip for one in found if one.trip})
        tripped = sum(bool(one.trip) for one in found)
        overshoot = (abs(one.frames_overshoot - one.alone_overshoot) for one in found if not one.trip)
        rows.append((
            law, str(len(found)), f"{tripped} ({', '.join(trips)})" if trips else "0",
            str(sum(one.alone_s < inf for one in found)), str(sum(one.frames_s < inf for one in found)),
            f"{max((1e3 * abs(one.frames_s - one.alone_s) for one in both), default=0.0):.1f}",
            f"{max(overshoot, default=0.0):.4f}",
        ))  # fmt: skip
    return rows
