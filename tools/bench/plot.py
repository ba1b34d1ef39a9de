"""Draws the figures of a run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

_OURS: Final = "#c55a11"
_OTHERS: Final = "#1f4e79"
_PANELS: Final = (
    ("tick_lateness_us", "Lateness of a pass (µs)"),
    ("tick_lateness_us_loaded", "the same beside four CPU hogs"),
    ("frame_jitter_us", "Interval of the command frames,\ndeviation from 10 ms (µs)"),
    ("frame_jitter_us_loaded", "the same beside four CPU hogs"),
    ("control_step_us", "Control step (µs)"),
    ("whole_tick_us", "Whole tick by number of axes (µs)"),
    ("clients_lateness_us", "Lateness of a tick beside clients (µs)"),
    ("millisecond_lateness_us", "Lateness of a tick of 1 ms (µs)"),
)


def draw(result: Mapping[str, Any], picture: Path) -> None:
    """Draw one panel for each comparison: a line from p50 to p99, a dot at p90, a thin line on to the maximum."""
    figure = Figure(figsize=(11.0, 11.0), layout="constrained")
    panels = figure.subplots(4, 2).flat
    for (key, title), panel in zip(_PANELS, panels, strict=True):
        rows = dict(result.get(key, {}))
        if "p50" in rows:
            rows = {"ours": rows}
        if key == "whole_tick_us":
            rows |= {f"{axes}, real time": row for axes, row in result.get("whole_tick_real_time_us", {}).items()}
        if key.startswith("frame_jitter"):
            _draw_floor(panel, result.get("frame_jitter_floor_us", {}).get("loaded" if "loaded" in key else "unloaded"))
        _draw_rows(panel, rows)
        panel.set_title(title, fontsize=10, loc="left")
    machine = result.get("machine", {})
    figure.suptitle(
        f"twostage-servo {machine.get('version', '')} on {machine.get('cpus', '?')} CPUs, Python "
        f"{machine.get('python', '?')}, load average {machine.get('load_average_before', '?')} before"
        f"{', quick' if machine.get('quick') else ''}\n"
        "bar from p50 (number) to p99 with a tick at p90, thin line to the maximum; logarithmic; left is better",
        fontsize=10,
    )
    figure.savefig(picture, dpi=110)


def _short(value: float) -> str:
    """Write a number with three digits, and none after the point where it has as many before it."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _draw_floor(panel: Axes, floor: Mapping[str, Any] | None) -> None:
    """Shade what bus and listener add themselves."""
    if floor is not None:
        panel.axvline(float(floor["p50"]), color="grey", linestyle=":")
        panel.text(
            float(floor["p50"]), 0.01, " p50 of bus and listener alone", color="grey", fontsize=7,
            transform=panel.get_xaxis_transform(),
        )  # fmt: skip


def _draw_rows(panel: Axes, rows: Mapping[str, Any]) -> None:
    for height, (name, row) in enumerate(rows.items()):
        is_ours = name.startswith("ours") or name[0].isdigit()
        colour = _OURS if is_ours else _OTHERS
        p50, p90, p99, largest = (max(float(row[key]), 1e-3) for key in ("p50", "p90", "p99", "max"))
        panel.plot([p50, largest], [height, height], color=colour, linewidth=1.0)
        panel.plot([p50, p99], [height, height], color=colour, linewidth=6.0, solid_capstyle="butt")
        panel.plot([p90], [height], color="white", marker="|", markersize=6.0)
        panel.plot([p50], [height], color=colour, marker="o", markersize=7.0)
        panel.annotate(
            _short(p50),
            (p50, height),
            xytext=(-7, 0),
            textcoords="offset points",
            fontsize=8,
            color=colour,
            ha="right",
            va="center",
        )
    panel.set_xscale("log")
    panel.set_xmargin(0.17)  # the leftmost number has to stay within the panel
    panel.set_yticks(range(len(rows)), [name.replace("_", " ") for name in rows])
    panel.set_ylim(len(rows) - 0.4, -0.7)
    panel.grid(axis="x", alpha=0.3)
    if not rows:
        panel.text(0.5, 0.5, "not measured", ha="center", va="center", transform=panel.transAxes)
