"""The tables of a run, for a terminal and for the docs."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tools.bench.control_quality import axes, over_frames
from tools.bench.control_quality.contestants import level
from tools.bench.control_quality.measure import (
    ORDINALS,
    Measured,
    figures_of,
    nominal_figures,
    nominal_outcome,
    quantile,
)
from tools.bench.control_quality.suite import EFFORT_LIMITS, NOISES, Outcome
from tools.write_tables import replaced

_HEADINGS: Final = (
    "law", "nominal s", "overshoot mm", "Ms", "delay margin ticks", "load step mm",
    "excess ms: median", "p95", "p99", "p99.9", "max", "not settled", "overshoot mm: p95", "max", "peak speed / v: p95",
)  # fmt: skip
NOMINAL_HEADINGS: Final = (
    "law", "10 V: settled s", "overshoot mm", "peak speed / v", "24 V: settled s", "overshoot mm", "peak speed / v",
)  # fmt: skip
SCENARIO_HEADINGS: Final = (
    "scenario", "law", "excess ms: median", "p95", "max", "overshoot mm: p95", "max", "not settled",
)  # fmt: skip


def rows_of(measured: Measured, noise: float, ordinal: str) -> list[tuple[str, ...]]:
    """Return the rows of one table, the smallest 95th percentile of excess first."""
    place = ORDINALS[ordinal]
    moves = {law: [one[place] for one in found] for (law, at), found in measured.outcomes.items() if at == noise}
    ordered = sorted(moves, key=lambda law: quantile([move.excess_s for move in moves[law]], 0.95))
    return [_row(law, moves[law]) for law in ordered]


def _row(law: str, moves: Sequence[Outcome]) -> tuple[str, ...]:
    told = nominal_figures(law)
    excess = [1e3 * move.excess_s for move in moves]
    overshoot = [move.overshoot for move in moves]
    return (
        law,
        _number(told["nominal_s"], 3), _number(told["nominal_overshoot"], 3), _number(told["peak_sensitivity"], 2),
        _number(told["delay_margin_ticks"], 2), _number(told["load_step_peak"], 3),
        *(f"{quantile(excess, share):.0f}" for share in (0.5, 0.95, 0.99, 0.999, 1.0)),
        str(sum(math.isinf(move.settling_s) for move in moves)),
        *(f"{quantile(overshoot, share):.3f}" for share in (0.95, 1.0)),
        f"{quantile([move.peak_velocity for move in moves], 0.95):.2f}",
    )  # fmt: skip


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def markdown(rows: Sequence[Sequence[str]], headings: Sequence[str] = _HEADINGS) -> str:
    """Return a table for the docs."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def text(measured: Measured) -> str:
    """Return the tables for a terminal."""
    parts = []
    for noise in NOISES:
        for ordinal in ORDINALS:
            parts.append(f"noise {level(noise)} mm, {ordinal} move on each of {measured.plants} plants")
            parts.append(_aligned([_HEADINGS, *rows_of(measured, noise, ordinal)]))
    return "\n\n".join(parts)


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) if place == 0 else cell.rjust(width) for place, (cell, width) in enumerate(pairs))
        for pairs in (list(zip(row, widths, strict=True)) for row in rows)
    )


def scenario_rows(outcomes: Mapping[tuple[str, str], Sequence[Outcome]]) -> list[tuple[str, ...]]:
    """Return a row for each law and scenario: excess and overshoot, and how many did not settle."""
    found = []
    for (law, scenario), moves in outcomes.items():
        figures = figures_of(moves)
        excess, overshoot = figures["excess_ms"], figures["overshoot"]
        found.append((
            scenario, law,
            *(f"{excess[key]:.0f}" for key in ("median", "p95", "max")),
            *(f"{overshoot[key]:.3f}" for key in ("p95", "max")),
            str(sum(math.isinf(move.settling_s) for move in moves)),
        ))  # fmt: skip
    order = list(dict.fromkeys(row[0] for row in found))
    return sorted(found, key=lambda row: (order.index(row[0]), float(row[3]), float(row[2])))


@dataclass(frozen=True, slots=True)
class Further:
    """What the docs show beside the suite.

    Attributes
    ----------
    scenarios
        Outcomes by law and scenario.
    axes
        Figures of other axes, by law.
    frames
        Outcomes over frames, by law.
    """

    scenarios: Mapping[tuple[str, str], Sequence[Outcome]]
    axes: Mapping[str, axes.AxesFigures]
    frames: Mapping[str, Sequence[over_frames.FramesOutcome]]


def write_docs(measured: Measured, further: Further, page: Path) -> None:
    """Write the tables of a run into a page of the docs, between their marks."""
    fresh = page.read_text("utf-8")
    for noise in NOISES:
        for ordinal in ORDINALS:
            table = markdown(rows_of(measured, noise, ordinal))
            fresh = replaced(fresh, f"noise {level(noise)}, {ordinal}", table)
    laws = list(dict.fromkeys(law for law, _ in measured.outcomes))
    fresh = replaced(fresh, "nominal", markdown(nominal_rows(laws), NOMINAL_HEADINGS))
    fresh = replaced(fresh, "scenarios", markdown(scenario_rows(further.scenarios), SCENARIO_HEADINGS))
    fresh = replaced(fresh, "axes", markdown(axes.rows_of(further.axes), axes.HEADINGS))
    fresh = replaced(fresh, "frames", markdown(over_frames.rows_of(further.frames), over_frames.HEADINGS))
    page.write_text(fresh, "utf-8")


def nominal_rows(laws: Sequence[str]) -> list[tuple[str, ...]]:
    """Return a row for each law: the nominal move with the smaller and the larger effort limit."""
    found = []
    for law in laws:
        cells = []
        for limit in EFFORT_LIMITS:
            outcome = nominal_outcome(law, limit)
            cells += [f"{outcome.settling_s:.3f}", f"{outcome.overshoot:.4f}", f"{outcome.peak_velocity:.3f}"]
        found.append((law, *cells))
    return sorted(found, key=lambda row: row[1])
