"""The tables of a run, for a terminal and for the docs."""

from collections.abc import Mapping, Sequence
from typing import Any

_HEADINGS = (
    "law", "nominal s", "overshoot mm", "Ms", "delay margin ticks", "load step mm",
    "excess ms: median", "p95", "p99", "max", "overshoot mm: p95", "max",
)  # fmt: skip


def rows_of(result: Mapping[str, Any], noise: str, ordinal: str) -> list[tuple[str, ...]]:
    """Return the rows of one table, the smallest 95th percentile of excess first."""
    laws: Mapping[str, Any] = result["laws"]
    ordered = sorted(laws, key=lambda name: laws[name]["noise"][noise][ordinal]["excess_ms"]["p95"])
    return [_row(name, laws[name], laws[name]["noise"][noise][ordinal]) for name in ordered]


def _row(name: str, law: Mapping[str, Any], moves: Mapping[str, Any]) -> tuple[str, ...]:
    excess, overshoot = moves["excess_ms"], moves["overshoot"]
    return (
        name,
        _number(law["nominal_s"], 3), _number(law["nominal_overshoot"], 3), _number(law["peak_sensitivity"], 2),
        _number(law["delay_margin_ticks"], 2), _number(law["load_step_peak"], 3),
        *(f"{excess[key]:.0f}" for key in ("median", "p95", "p99", "max")),
        *(f"{overshoot[key]:.3f}" for key in ("p95", "max")),
    )  # fmt: skip


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def markdown(rows: Sequence[Sequence[str]], headings: Sequence[str] = _HEADINGS) -> str:
    """Return a table for the docs."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def text(result: Mapping[str, Any]) -> str:
    """Return the tables for a terminal."""
    parts = []
    for noise in next(iter(result["laws"].values()))["noise"]:
        for ordinal in ("first", "third"):
            parts.append(f"noise {noise} mm, {ordinal} move on each of {result['suite']['plants']} plants")
            parts.append(_aligned([_HEADINGS, *rows_of(result, noise, ordinal)]))
    return "\n\n".join(parts)


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) if place == 0 else cell.rjust(width) for place, (cell, width) in enumerate(pairs))
        for pairs in (list(zip(row, widths, strict=True)) for row in rows)
    )
