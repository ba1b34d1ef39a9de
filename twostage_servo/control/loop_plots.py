"""Nyquist and step plots of a law's loops, as a figure of matplotlib."""

from collections.abc import Mapping, Sequence
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twostage_servo.control.loop_analysis import LoopAnalysis

Tick = tuple[float, float, float, float]
"""Time in s, error of the position, velocity, effort."""

_COLOURS: Final = ("#c0392b", "#1f6fb2", "#6b6b6b", "#8c6d1f", "#7d5ba6", "#3a9d5d")
_REACH: Final = 2.5
"""How far a Nyquist plot reaches to the left: what matters lies around -1."""
_STEP_S: Final = 3.0
_ARRIVED: Final = 1e-4
"""Share of a move's length within which it has settled as far as a plot can show."""
_NEAR: Final = 2e-3
"""Share of a move's length that the plot of its error shows."""


def design_figure(
    loops: Mapping[str, LoopAnalysis], moves: Mapping[str, Sequence[Tick]], unit: str, title: str
) -> Figure:
    """Draw the open loops around -1 and how the closed ones answer a step, where there are any, and below them a move.

    Parameters
    ----------
    loops
        Loops by what they are called.
    moves
        The ticks of a move by what they are called: time in s, error of the position and velocity in axis unit, effort.
    unit
        The axis unit.
    title
        Of the figure.
    """
    with mpl.rc_context():
        mpl.rcdefaults()
        figure = Figure(figsize=(10.0, 8.6 if loops else 4.2), layout="constrained")
        figure.suptitle(title)
        if loops:
            above, below = figure.subfigures(2, 1, squeeze=False)[:, 0]
            follows = any(loop.law.follows for loop in loops.values())
            nyquist, *step = above.subplots(1, 2 if follows else 1, squeeze=False)[0]
            nyquist_plot(nyquist, loops)
            for pane in step:
                step_plot(pane, loops)
            move_plot(below.subplots(1, 3), moves, unit)
        else:
            move_plot(figure.subplots(1, 3), moves, unit)
    return figure


def move_plot(panes: Sequence[Axes], moves: Mapping[str, Sequence[Tick]], unit: str) -> None:
    """Draw velocity and effort of a move, and how its error ends, each until the last one has settled."""
    velocity, effort, error = panes
    length = abs(next(iter(moves.values()))[0][1])
    ends_s = [
        max((tick[0] for tick in ticks if abs(tick[1]) > _ARRIVED * length), default=0.0) for ticks in moves.values()
    ]
    until_s = 1.1 * max(ends_s)
    for (name, ticks), colour in zip(moves.items(), _COLOURS, strict=False):
        times_s, errors, velocities, efforts = zip(*ticks, strict=True)
        velocity.plot(times_s, velocities, color=colour, linewidth=0.9, label=name)
        effort.step(times_s, efforts, where="pre", color=colour, linewidth=0.9)
        error.plot(times_s, errors, color=colour, linewidth=0.9)
    error.set_ylim(-_NEAR * length, _NEAR * length)
    arrives_s = min(
        next((tick[0] for tick in ticks if abs(tick[1]) < 5.0 * _NEAR * length), until_s) for ticks in moves.values()
    )
    for pane, label in zip(panes, (f"velocity ({unit}/s)", "effort", f"error ({unit})"), strict=True):
        pane.set_xlim(0.0, until_s)
        pane.set_xlabel("time (s)")
        pane.set_ylabel(label)
        pane.grid(linewidth=0.3)
    error.set_xlim(arrives_s, max(until_s, arrives_s + 0.05))
    velocity.legend(loc="lower center", fontsize="x-small")


def nyquist_plot(axes: Axes, loops: Mapping[str, LoopAnalysis]) -> None:
    """Draw each loop's frequency response; a circle around -1 shows its modulus margin."""
    angles = np.linspace(0.0, 2.0 * np.pi, 181)
    for (name, loop), colour in zip(loops.items(), _COLOURS, strict=False):
        _, response = loop.response()
        axes.plot(response.real, response.imag, color=colour, label=name)
        margin = float(np.min(np.abs(1.0 + response)))
        axes.plot(margin * np.cos(angles) - 1.0, margin * np.sin(angles), ":", color=colour, linewidth=0.8)
    axes.plot([-1.0], [0.0], "+", color="black", markersize=10.0)
    axes.set_xlim(-_REACH, 0.4 * _REACH)
    axes.set_ylim(-0.8 * _REACH, 0.6 * _REACH)
    axes.set_aspect("equal")
    axes.set_xlabel("real part of the loop gain")
    axes.set_ylabel("imaginary part")
    axes.grid(linewidth=0.3)
    axes.legend(loc="lower right", title="dotted: modulus margin")


def step_plot(axes: Axes, loops: Mapping[str, LoopAnalysis]) -> None:
    """Draw how each closed loop answers a unit step of what it follows; those that follow nothing are left out."""
    for (name, loop), colour in zip(loops.items(), _COLOURS, strict=False):
        if loop.law.follows:
            times_s, answer = loop.step_response(_STEP_S)
            axes.step(times_s, answer, where="post", color=colour, label=f"{name}: {loop.law.follows}")
    axes.axhline(1.0, color="black", linewidth=0.6, linestyle=":")
    axes.set_xlabel("time (s)")
    axes.set_ylabel("answer to a unit step, without limits")
    axes.grid(linewidth=0.3)
    axes.legend(loc="lower right")
