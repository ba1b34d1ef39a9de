"""What the paper claims, and what we claim of it, each held against the runs."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from twostage_servo.paper.examples import EXAMPLE_1, EXAMPLE_2, EXAMPLES, PERIOD_S, VELOCITY
from twostage_servo.paper.frames import FramesComparison
from twostage_servo.paper.methods import CONVENTIONAL
from twostage_servo.paper.studies import LOAD, Comparison, Curve, Studies, steady_error

NO_ERROR: Final = 0.02
"""Final error in mm that counts as none: Example 1's noise leaves 0.006."""
COMPARED_TICKS: Final = 400
"""Fewest ticks that a comparison over frames must have: 4 s, to beyond the change-over."""
SETTLED_SPEED: Final = 200.0
"""Shortest set-point in mm for which the speed stage has settled before the change-over, about 1 s after the start."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim: what is claimed, what was measured, and whether that bears it out."""

    claim: str
    measured: str
    holds: bool


def check_claims(studies: Studies, frames: Mapping[str, FramesComparison]) -> list[Claim]:
    """Hold every claim against the runs; `frames` by the example's name."""
    example1, example2 = studies.comparisons
    return [
        *_gains(),
        _noise(example1),
        *_wrong_plant(example2),
        *_loads(studies),
        *_set_points(studies),
        _hand_over(example2),
        *_behind_frames(frames),
    ]


def _gains() -> Iterator[Claim]:
    for example, printed, distance in (
        (EXAMPLE_1, ("3.78e-01", "2.32e-02", "6.9e-03"), "54.5"),
        (EXAMPLE_2, ("1.430", "0.0689", "0.0663"), "21.6"),
    ):
        gains = example.gains
        forms = (".2e", ".2e", ".1e") if example is EXAMPLE_1 else (".3f", ".4f", ".4f")
        ours = tuple(format(gain, form) for gain, form in zip((gains.f11, gains.f12, gains.f22), forms, strict=True))
        source = "as (36) prints them" if example is EXAMPLE_1 else "which the paper does not print"
        yield Claim(
            f"{example.short_title}: f11, f12, f22 are {', '.join(printed)}, {source}; p is {distance} mm",
            f"{gains.f11:.6g}, {gains.f12:.6g}, {gains.f22:.6g}; {example.changeover_distance:.5g} mm",
            ours == printed and f"{example.changeover_distance:.1f}" == distance,
        )


def _noise(example1: Comparison) -> Claim:
    conventional = _number(example1.scores[CONVENTIONAL].velocity_noise_rms)
    proposed = _number(example1.scores["proposed"].velocity_noise_rms)
    return Claim(
        "Example 1: the velocity that the proposed law uses has at most a tenth of the noise of the differentiated one",
        f"{proposed:.3g} against {conventional:.3g} mm/s, 1 : {conventional / proposed:.3g}",
        10.0 * proposed <= conventional,
    )


def _wrong_plant(example2: Comparison) -> Iterator[Claim]:
    conventional, proposed = example2.scores[CONVENTIONAL], example2.scores["proposed"]
    printed = example2.scores["proposed_as_printed"]
    yield Claim(
        "Example 2: the proposed law overshoots by at most a tenth of what the conventional one does",
        f"{proposed.overshoot:.3g} against {conventional.overshoot:.3g} mm",
        10.0 * proposed.overshoot <= conventional.overshoot,
    )
    yield Claim(
        "Example 2: it settles sooner",
        f"{_seconds(proposed.settling_time_s)} against {_seconds(conventional.settling_time_s)}",
        proposed.settling_time_s is not None
        and (conventional.settling_time_s is None or proposed.settling_time_s < conventional.settling_time_s),
    )
    yield Claim(
        "Example 2: it cruises steadily at 100 mm/s; with the observer as printed (erratum 5) it does not",
        f"at {_velocity(proposed.cruise_velocity)}; as printed it swings up to "
        f"{_velocity(VELOCITY + printed.speed_overshoot)}, then runs at {_velocity(printed.cruise_velocity)}",
        _number(proposed.velocity_error_rms) < 0.1 and _number(printed.velocity_error_rms) > 10.0,
    )


def _loads(studies: Studies) -> Iterator[Claim]:
    for comparison in studies.under_load:
        name = comparison.example.short_title
        predicted = steady_error(comparison.example, LOAD)
        measured = _number(comparison.scores[CONVENTIONAL].final_error)
        yield Claim(
            f"{name}, load {LOAD:g} V: the conventional law keeps an error, by theory {predicted:+.4g} mm",
            f"{measured:+.4g} mm",
            abs(measured - predicted) < NO_ERROR,
        )
        others = [_number(comparison.scores[key].final_error) for key in ("conventional_model_difference", "proposed")]
        yield Claim(
            f"{name}, load {LOAD:g} V: with the model difference, and with the proposed law, less than {NO_ERROR:g} mm",
            ", ".join(f"{error:+.2g}" for error in others) + " mm",
            all(abs(error) < NO_ERROR for error in others),
        )


def _set_points(studies: Studies) -> Iterator[Claim]:
    for comparison, curves, (exact, printed) in zip(
        studies.comparisons, studies.by_set_point, studies.by_phase, strict=True
    ):
        name = comparison.example.short_title
        pid, proposed = (next(curve for curve in curves if curve.name == key) for key in ("pid", "proposed"))
        shares = [overshoot / r for overshoot, r in zip(pid.overshoots, pid.set_points, strict=True)]
        long_moves = [
            overshoot
            for overshoot, r in zip(proposed.overshoots, proposed.set_points, strict=True)
            if r >= SETTLED_SPEED
        ]
        yield Claim(
            f"{name}: the PID's overshoot grows with the set-point; the proposed law's does not, from "
            f"{SETTLED_SPEED:g} mm on",
            f"PID {pid.overshoots[0]:.3g} mm at {pid.set_points[0]:g} to {pid.overshoots[-1]:.3g} mm at "
            f"{pid.set_points[-1]:g}; proposed {min(long_moves):.4g} to {max(long_moves):.4g} mm",
            max(shares) - min(shares) < 1e-3 * max(shares)
            and max(long_moves) - min(long_moves) < 5e-3 * max(long_moves),
        )
        yield Claim(
            f"{name}: nor does it depend on where within a tick the change-over falls, with M = -x_o1",
            f"varies by {100.0 * _spread(exact):.2g} %; with the printed M by {100.0 * _spread(printed):.2g} %",
            _spread(exact) < 5e-3 < _spread(printed),
        )


def _hand_over(example2: Comparison) -> Claim:
    exact, printed = example2.scores["proposed"], example2.scores["proposed_as_printed"]
    slope = example2.example.gains.f22 * VELOCITY * PERIOD_S
    return Claim(
        "Example 2: the effort goes through the change-over without a step; as printed it has one. The next "
        f"tick changes it by at most f22 v T_s = {slope:.3f} V, the position stage's own beginning",
        f"{exact.changeover_effort_step:.1e} V into the tick, {exact.following_effort_step:.3f} V out of it; as "
        f"printed {printed.changeover_effort_step:.3g} V into it",
        exact.changeover_effort_step < 1e-6
        and exact.following_effort_step <= 1.001 * slope
        and printed.changeover_effort_step > slope,
    )


def _behind_frames(frames: Mapping[str, FramesComparison]) -> Iterator[Claim]:
    for example in EXAMPLES:
        pair = frames[example.name]
        yield Claim(
            f"{example.short_title}: behind CAN frames it is the same law; the frames' rounding is all the difference",
            f"over {pair.ticks} ticks positions differ by {1e3 * pair.position_difference:.2g} µm; with the same "
            f"rounding the efforts differ by {pair.effort_difference_unexplained:.1g} V",
            pair.ticks >= COMPARED_TICKS
            and pair.position_difference < 5.0 * pair.position_quantum
            and pair.effort_difference_unexplained < 1e-9,
        )


def _velocity(value: float | None) -> str:
    return "no speed" if value is None else f"{value:.1f} mm/s"


def _number(value: float | None) -> float:
    """Return a figure; of a run that was given up, one that no claim holds for."""
    return math.nan if value is None else value


def _spread(curve: Curve) -> float:
    return (max(curve.overshoots) - min(curve.overshoots)) / max(curve.overshoots)


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.2f} s"
