"""Draw what each step from the paper's law to the adaptive one buys, on the simulated axis of the demo.

`.venv/bin/python -m tools.draw_law_steps docs/pictures/law-steps.svg`, with the extra `paper` for matplotlib.
"""

import argparse
import contextlib
import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twostage_servo.cli.main import main as command

ADAPTIVE = "axis.law.type=adaptive"
OFF_MODEL = ("simulation.gain=216", "simulation.pole=11.2", "simulation.coulomb_friction=0.3")
"""A plant with 20 % more gain and 20 % less pole than its model, and dry friction of 0.3 V."""

COLOURS = ("#7f7f7f", "#c55a11", "#1f4e79")


@dataclass(frozen=True)
class Curve:
    """A move to draw.

    Attributes
    ----------
    label
        Of the curve.
    settings
        What is set for the run.
    number
        Which of its moves, from 1 on; all go forward.
    """

    label: str
    settings: tuple[str, ...]
    number: int = 1


@dataclass(frozen=True)
class Move:
    """What a run shows: time from the start of a move in s, distance beyond its set-point in mm, and effort in V."""

    times: list[float]
    beyond: list[float]
    efforts: list[float]


PLANNED = (
    Curve("paper", ()),
    Curve("planned braking, quick estimate", (ADAPTIVE, "axis.law.adaptive.identification=false")),
)
IDENTIFIED = (
    Curve("without identification", (ADAPTIVE, "axis.law.adaptive.identification=false", *OFF_MODEL)),
    Curve("with identification", (ADAPTIVE, *OFF_MODEL)),
)
REMEMBERED = (
    Curve("first move", (ADAPTIVE, *OFF_MODEL)),
    Curve("third move", (ADAPTIVE, *OFF_MODEL), number=3),
)


def run(curve: Curve, folder: Path) -> Move:
    """Run the demo in simulated time, and return the move."""
    trace = folder / "trace.csv"
    settings = [part for setting in curve.settings for part in ("--set", setting)]
    with contextlib.redirect_stdout(io.StringIO()):
        command(["demo", "--fast", "--json", "--moves", str(curve.number), "--trace", str(trace), *settings])
    with trace.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    targets = [float(row["target"]) for row in rows]
    goal = max(targets)
    begins = [index for index in range(1, len(rows)) if targets[index] == goal != targets[index - 1]]
    first = begins[curve.number // 2]
    start = float(rows[first]["time_s"])
    shown = [row for row, target in zip(rows[first:], targets[first:], strict=True) if target == goal]
    return Move(
        [float(row["time_s"]) - start for row in shown],
        [float(row["true_position"]) - goal for row in shown],
        [float(row["effort"]) for row in shown],
    )


def draw_ends(
    axes: Axes, curves: Sequence[Curve], moves: Sequence[Move], title: str, limits: tuple[float, float]
) -> None:
    """Draw how moves end."""
    for curve, move, colour in zip(curves, moves, COLOURS[-len(curves) :], strict=True):
        axes.plot(move.times, move.beyond, label=curve.label, color=colour)
    axes.axhspan(-0.4, 0.4, color="#e2efda", zorder=0)
    axes.set(title=title, xlim=(3.8, 5.8), ylim=limits, ylabel="beyond the set-point (mm)")
    axes.legend(loc="lower right", fontsize=8)


def draw(picture: Path) -> None:
    """Run all moves, and draw them."""
    with TemporaryDirectory() as folder:
        planned, identified, remembered = (
            [run(curve, Path(folder)) for curve in curves] for curves in (PLANNED, IDENTIFIED, REMEMBERED)
        )
    mpl.rcParams["svg.hashsalt"] = "twostage-servo"  # the same moves give the same file
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    (first, effort), (third, fourth) = figure.subplots(2, 2)
    draw_ends(first, PLANNED, planned, "1  Braking is planned", (-12.0, 4.0))
    for curve, move, colour in zip(PLANNED, planned, COLOURS[-2:], strict=True):
        effort.plot(move.times, move.efforts, label=curve.label, color=colour)
    effort.set(title="   The effort of these moves", xlim=(3.0, 5.0), ylabel="effort (V)")
    effort.legend(loc="upper right", fontsize=8)
    draw_ends(third, IDENTIFIED, identified, "2  The plant is identified as it accelerates", (-4.0, 4.0))
    draw_ends(fourth, REMEMBERED, remembered, "3  What was learned is kept", (-1.5, 1.0))
    for axes in (first, effort, third, fourth):
        axes.grid(alpha=0.3)
        axes.set_xlabel("time from the start (s)")
    figure.savefig(picture, metadata={"Date": None} if picture.suffix == ".svg" else None)


def main() -> None:
    """Read the arguments and draw."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("picture", type=Path, help="the SVG or PNG file to write")
    draw(parser.parse_args().picture)


if __name__ == "__main__":
    main()
