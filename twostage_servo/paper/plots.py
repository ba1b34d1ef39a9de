"""The figures: those of the paper in its own form, and those that the paper does not have."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from typing import Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twostage_servo.control.loop_plots import nyquist_plot, step_plot
from twostage_servo.paper.examples import EXAMPLES, SET_POINT, VELOCITY
from twostage_servo.paper.experiment import Run
from twostage_servo.paper.loops import loops_of
from twostage_servo.paper.methods import CONVENTIONAL, METHODS
from twostage_servo.paper.studies import LOAD, Comparison, Curve

_SHOWN_S: Final = 8.0
_INK: Final = "#1f3d5c"
_COLOURS: Final = {
    "pid": "#8c6d1f",
    "optimal": "#6b6b6b",
    "conventional_two_output": "#d98c5f",
    "conventional_differentiated": "#c0392b",
    "conventional_model_difference": "#7d5ba6",
    "proposed": "#1f6fb2",
    "proposed_as_printed": "#3a9d5d",
}


@dataclass(frozen=True, slots=True)
class Picture:
    """A finished figure: name of its files, caption, and the bytes of both forms."""

    name: str
    caption: str
    svg: bytes
    png: bytes


@contextmanager
def our_style() -> Iterator[None]:
    """Draw alike everywhere, whatever matplotlibrc the user has."""
    with mpl.rc_context():
        mpl.rcdefaults()
        yield


def papers_figures(example1: Comparison, example2: Comparison) -> list[Picture]:
    """Draw Fig. 2 (a), (b) and Fig. 3 (a), (b), (c)."""
    noisy, wrong = example1.runs, example2.runs
    measured = "velocity of the conventional method: differentiated, and from the change-over on the model's"
    estimated = "estimated velocity of the proposed method"
    return [
        _velocity("fig2a", f"Fig. 2 (a): Example 1, {measured}", noisy[CONVENTIONAL], (-20.0, 130.0)),
        _velocity("fig2b", f"Fig. 2 (b): Example 1, {estimated}", noisy["proposed"], (-20.0, 130.0)),
        _outputs(
            "fig3a",
            "Fig. 3 (a): Example 2, controlled output: (1) conventional, (2) proposed; right: the last 10 mm",
            {"(1) conventional": wrong[CONVENTIONAL], "(2) proposed": wrong["proposed"]},
        ),
        _velocity("fig3b", f"Fig. 3 (b): Example 2, {measured}", wrong[CONVENTIONAL], (-60.0, 240.0)),
        _velocity("fig3c", f"Fig. 3 (c): Example 2, {estimated}", wrong["proposed"], (-60.0, 240.0)),
    ]


def printed_speed_stage(example2: Comparison) -> Picture:
    """Draw what erratum 5 does in Example 2."""
    figure, axes = _figure()
    for name, label in (
        ("proposed_as_printed", "as printed: lower right entry of A_o is 0"),
        ("proposed", "corrected: 1"),
    ):
        run = example2.runs[name]
        axes.plot(run.time_s, run.velocity, color=_COLOURS[name], label=label)
    axes.axhline(VELOCITY, color="black", linewidth=0.6, linestyle=":")
    _label(axes, "time (s)", "true velocity (mm/s)")
    axes.set_xlim(0.0, 5.0)
    axes.legend(loc="upper right")
    return _picture(
        figure,
        "printed_speed_stage",
        "Example 2 with the observer as printed: the same swing at first, and then the wrong speed",
    )


def disturbance(comparisons: Iterable[Comparison]) -> Picture:
    """Draw the approach to the set-point under a constant load."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axes, comparison in zip(figure.subplots(1, 2), comparisons, strict=True):
        shown = ("conventional_differentiated", "conventional_model_difference", "proposed")
        for name in shown:
            run = comparison.runs[name]
            errors = [position - run.set_point for position in run.position]
            axes.plot(run.time_s, errors, color=_COLOURS[name], label=METHODS[name].title)
        axes.axhline(0.0, color="black", linewidth=0.6, linestyle=":")
        axes.set_ylim(-12.0, 8.0)
        axes.set_xlim(3.0, 10.0)
        axes.set_title(comparison.example.short_title, fontsize=10)
        _label(axes, "time (s)", "position - set-point (mm)")
    axes.legend(loc="lower right", fontsize=8)
    return _picture(
        figure, "disturbance", f"A constant load of {LOAD:g} V: the conventional law keeps an error, the others do not"
    )


def set_point_dependence(curves: Sequence[Sequence[Curve]]) -> Picture:
    """Draw overshoot against set-point: single-stage laws grow with it, two-stage laws do not."""
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    for axes, example, group in zip(figure.subplots(1, 2), EXAMPLES, curves, strict=True):
        for curve in sorted(group, key=lambda curve: curve.name == "proposed"):  # ours on top of what lies under it
            axes.plot(
                curve.set_points,
                [max(overshoot, 1e-3) for overshoot in curve.overshoots],
                marker="o",
                markersize=3,
                linestyle="--" if curve.name.startswith("conventional") else "-",
                linewidth=3.0 if curve.name in {"optimal", "proposed_as_printed"} else 1.5,
                color=_COLOURS[curve.name],
                label=METHODS[curve.name].title,
            )
        axes.set_yscale("log")
        axes.set_ylim(8e-4, 2e3)
        axes.set_title(example.short_title, fontsize=10)
        _label(axes, "set-point (mm)", "overshoot (mm)")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    return _picture(
        figure,
        "set_points",
        (
            "Overshoot against set-point, without noise. In Example 1 all two-stage laws lie on one line; in "
            "Example 2 the optimal servo and the law of [6] do not overshoot (drawn at the lower edge)"
        ),
    )


def phase_dependence(curves: Sequence[tuple[Curve, Curve]]) -> Picture:
    """Draw overshoot against where within a tick the change-over falls, for both hand-overs."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    for axes, example, pair in zip(figure.subplots(1, 2), EXAMPLES, curves, strict=True):
        for curve, name, label in zip(
            pair,
            ("proposed", "proposed_as_printed"),
            ("M = -x_o1 at the tick (corrected)", "M = -(r - p) (printed)"),
            strict=True,
        ):
            way = [
                100.0 * (r - curve.set_points[0]) / (curve.set_points[-1] - curve.set_points[0])
                for r in curve.set_points
            ]
            axes.plot(way, curve.overshoots, marker="o", markersize=3, color=_COLOURS[name], label=label)
        axes.set_ylim(bottom=0.0, top=1.15 * max(pair[0].overshoots))
        axes.set_title(example.short_title, fontsize=10)
        _label(axes, "shift of the set-point (% of the way of one tick)", "overshoot (mm)")
    axes.legend(loc="lower right", fontsize=8)
    return _picture(
        figure, "phase", "Overshoot against where within a tick the change-over falls: gone with the exact hand-over"
    )


def loops() -> Picture:
    """Draw the loops of both examples around -1, and how they answer a step."""
    figure = Figure(figsize=(9.0, 8.4), layout="constrained")
    for row, example in zip(figure.subplots(2, 2), EXAMPLES, strict=True):
        analyses = loops_of(example)
        nyquist_plot(row[0], analyses)
        step_plot(row[1], analyses)
        row[0].set_title(example.short_title, fontsize=10)
    return _picture(
        figure, "loops", "Nyquist plots of the proposed law's loops, and their answers to a step, on the driven plants"
    )


def _velocity(name: str, caption: str, run: Run, limits: tuple[float, float]) -> Picture:
    figure, axes = _figure()
    axes.plot(run.time_s, run.velocity, color="#d98c5f", linewidth=0.9, label="true velocity")
    axes.plot(run.time_s, run.law_velocity, color=_INK, linewidth=0.9, label="velocity that the law uses")
    axes.set_xlim(0.0, _SHOWN_S)
    axes.set_ylim(*limits)
    if run.changeover is not None:
        axes.axvline(run.time_s[run.changeover], color="black", linewidth=0.6, linestyle=":")
        axes.text(run.time_s[run.changeover], limits[0], " change-over", va="bottom", fontsize=8)
    axes.legend(loc="upper right", fontsize=8)
    _label(axes, "time (s)", "velocity (mm/s)")
    return _picture(figure, name, caption)


def _outputs(name: str, caption: str, runs: dict[str, Run]) -> Picture:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    whole, near = figure.subplots(1, 2, width_ratios=(3, 2))
    for (label, run), style, colour in zip(runs.items(), ("--", "-"), ("#c0392b", "#1f6fb2"), strict=True):
        for axes in (whole, near):
            axes.plot(run.time_s, run.position, color=colour, linestyle=style, label=label)
    for axes in (whole, near):
        axes.axhline(SET_POINT, color="black", linewidth=0.6, linestyle=":")
    whole.set_xlim(0.0, _SHOWN_S)
    near.set_xlim(3.4, 5.6)
    near.set_ylim(SET_POINT - 10.0, SET_POINT + 10.0)
    _label(whole, "time (s)", "position (mm)")
    _label(near, "time (s)", "")
    near.legend(loc="lower right", fontsize=8)
    return _picture(figure, name, caption)


def _figure() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    return figure, figure.subplots()


def _label(axes: Axes, horizontal: str, vertical: str) -> None:
    axes.set_xlabel(horizontal)
    axes.set_ylabel(vertical)
    axes.grid(alpha=0.3)


def _picture(figure: Figure, name: str, caption: str) -> Picture:
    svg, png = BytesIO(), BytesIO()
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "path"}):  # the same runs give the same bytes
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
        figure.savefig(png, format="png", dpi=150, metadata={"Software": None})
    return Picture(name, caption, svg.getvalue(), png.getvalue())
