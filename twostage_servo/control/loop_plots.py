"""Nyquist and step plots of a law's loops, as a figure of matplotlib."""

from collections.abc import Mapping
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twostage_servo.control.loop_analysis import LoopAnalysis

_COLOURS: Final = ("#c0392b", "#1f6fb2", "#6b6b6b", "#8c6d1f", "#7d5ba6", "#3a9d5d")
_REACH: Final = 2.5
"""How far a Nyquist plot reaches to the left: what matters lies around -1."""
_STEP_S: Final = 3.0


def loops_figure(loops: Mapping[str, LoopAnalysis], title: str) -> Figure:
    """Draw the open loops around -1, and how the closed ones answer a step.

    Parameters
    ----------
    loops
        Loops by what they are called.
    title
        Of the figure.
    """
    with mpl.rc_context():
        mpl.rcdefaults()
        figure = Figure(figsize=(10.0, 4.8), layout="constrained")
        nyquist, step = figure.subplots(1, 2)
        figure.suptitle(title)
        nyquist_plot(nyquist, loops)
        step_plot(step, loops)
    return figure


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
    axes.grid(visible=True, linewidth=0.3)
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
    axes.grid(visible=True, linewidth=0.3)
    axes.legend(loc="lower right")
