"""The pictures of a run for the docs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from tools.bench.control_quality import contestants
from tools.bench.control_quality.suite import BAND, HELD_S, PERIOD_S, Rig, nominal

_OURS: Final = "#c55a11"
_OTHERS: Final = "#1f4e79"
_FROM_S, _TO_S = 3.8, 5.2
_LEAST_ERROR: Final = 3e-3
"""In mm, for a logarithmic scale."""
_LEAST_EXCESS_MS: Final = 10.0


def draw_all(result: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw the pictures of a result into a folder; return their paths."""
    mpl.rcParams["svg.hashsalt"] = "twostage-servo"  # the same result gives the same file
    made = {"excess": draw_excess(result), "end": draw_end(list(result["laws"])), "margins": draw_margins(result)}
    paths = []
    for name, figure in made.items():
        paths.append(folder / f"control-quality-{name}.svg")
        figure.savefig(paths[-1], metadata={"Date": None})
    return paths


def draw_excess(result: Mapping[str, Any]) -> Figure:
    """Draw the excess of first moves: a bar from median to p95, a line on to the maximum, for each noise level."""
    levels = list(next(iter(result["laws"].values()))["noise"])
    figure = Figure(figsize=(11.0, 0.9 + 0.36 * len(result["laws"])), layout="constrained")
    for panel, noise in zip(figure.subplots(1, len(levels), sharex=True), levels, strict=True):
        rows = {name: law["noise"][noise]["first"]["excess_ms"] for name, law in result["laws"].items()}
        ordered = sorted(rows, key=lambda name: rows[name]["p95"], reverse=True)
        for height, name in enumerate(ordered):
            _draw_row(panel, height, rows[name], _colour(name))
        panel.set_yticks(range(len(ordered)), ordered)
        panel.set_xscale("log")
        panel.set_xlim(_LEAST_EXCESS_MS, 2000.0)
        _label(panel.xaxis, (10.0, 30.0, 100.0, 300.0, 1000.0))
        panel.set_title(f"encoder noise {noise} mm", fontsize=10, loc="left")
        panel.set_xlabel("settling beyond the time-optimal bound (ms)")
        panel.grid(axis="x", alpha=0.3, which="both")
    return figure


def _draw_row(panel: Axes, height: int, figures: Mapping[str, float], colour: str) -> None:
    median, p95, p99, largest = (max(_LEAST_EXCESS_MS, figures[key]) for key in ("median", "p95", "p99", "max"))
    panel.plot([median, largest], [height, height], color=colour, linewidth=1.0)
    panel.plot([median, p95], [height, height], color=colour, linewidth=7.0, solid_capstyle="butt")
    panel.plot([p99], [height], color=colour, marker="|", markersize=9.0)
    panel.plot([median], [height], color=colour, marker="o", markersize=7.0)


def draw_end(laws: Sequence[str]) -> Figure:
    """Draw how the error of the nominal move dies down with each law."""
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    panel = figure.subplots()
    colours = mpl.colormaps["tab10"]
    for place, name in enumerate(laws):
        times, errors = nominal_errors(name)
        ours = _is_ours(name)
        panel.plot(
            times, errors, label=name, color=_OURS if name != "paper" and ours else colours(place % 10),
            linewidth=2.4 if ours else 1.1, linestyle="--" if name == "paper" else "-",
        )  # fmt: skip
    panel.axhline(BAND, color="grey", linestyle=":")
    panel.text(_TO_S, BAND, "band ", color="grey", ha="right", va="bottom", fontsize=8)
    panel.set_yscale("log")
    panel.set_ylim(_LEAST_ERROR, 30.0)
    panel.set_xlim(_FROM_S, _TO_S)
    panel.set_xlabel("time from the first effort (s)")
    panel.set_ylabel("distance from the set-point (mm)")
    panel.grid(alpha=0.3)
    figure.legend(loc="outside right center", fontsize=8)
    return figure


def nominal_errors(law: str) -> tuple[list[float], list[float]]:
    """Return times in s and distances from the set-point in mm of the nominal move."""
    case = nominal()
    driver = contestants.law_for(law, case)
    rig = Rig(driver, case)
    rig.hold(HELD_S)
    driver.set_target(case.distance, case.velocity)
    errors = []
    for _ in range(round(_TO_S / PERIOD_S)):
        rig.tick()
        errors.append(max(_LEAST_ERROR, abs(rig.plant.position - case.distance)))
    return [(tick + 1) * PERIOD_S for tick in range(len(errors))], errors


def draw_margins(result: Mapping[str, Any]) -> Figure:
    """Draw what a load step does against what a law needs on axes that are off their model."""
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    panel = figure.subplots()
    markers = "osD^vP*Xdh<>p"
    for place, (name, law) in enumerate(result["laws"].items()):
        if law["load_step_peak"] is None:
            continue
        label = f"{name}: Ms {law['peak_sensitivity']:.2f}, delay margin {law['delay_margin_ticks']:.1f} ticks"
        excess = law["noise"]["0"]["first"]["excess_ms"]["p95"]
        panel.plot(
            [law["load_step_peak"]], [excess], color=_colour(name), marker=markers[place % len(markers)],
            markersize=8.0, linestyle="", label=label,
        )  # fmt: skip
    figure.legend(loc="outside right center", fontsize=8)
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlabel("peak after a load step of 1 V (mm)")
    panel.set_ylabel("settling beyond the bound, p95 of first moves (ms)")
    panel.margins(0.1)
    _label(panel.xaxis, (0.1, 0.2, 0.5, 1.0, 2.0))
    _label(panel.yaxis, (30.0, 100.0, 300.0, 1000.0))
    panel.grid(alpha=0.3, which="both")
    return figure


def _label(axis: Axis, ticks: Sequence[float]) -> None:
    """Label a logarithmic axis with plain numbers."""
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.set_minor_formatter(NullFormatter())


def _is_ours(name: str) -> bool:
    return name in contestants.project_laws()


def _colour(name: str) -> str:
    return _OURS if _is_ours(name) else _OTHERS
