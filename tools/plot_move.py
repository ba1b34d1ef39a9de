"""Draw a move from the trace of a demo.

`.venv/bin/twostage-servo demo --fast --trace move.csv`, then `.venv/bin/python -m tools.plot_move move.csv move.svg`.
"""

import argparse
import csv
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from twostage_servo.axis.state import State

_STAGES = {State.SPEED_STAGE: ("speed stage", "#dbe9f6"), State.POSITION_STAGE: ("position stage", "#fdebd3")}


def read(path: Path) -> dict[str, list[str]]:
    """Return the columns of a trace."""
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}


def draw(trace: dict[str, list[str]], unit: str, picture: Path) -> None:
    """Draw position, velocity and effort over time, with the stages shaded."""
    times = [float(value) for value in trace["time_s"]]
    mpl.rcParams["svg.hashsalt"] = "twostage-servo"  # the same trace gives the same file
    figure = Figure(figsize=(8.0, 6.4), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    axes[0].plot(times, [float(value) for value in trace["true_position"]], color="#1f4e79")
    axes[0].set_ylabel(f"position ({unit})")
    axes[1].plot(times, [float(value) for value in trace["true_velocity"]], color="#1f4e79", label="true")
    axes[1].plot(
        times,
        [float(value) for value in trace["estimated_velocity"]],
        color="#c55a11",
        linestyle="--",
        label="estimated",
    )
    axes[1].set_ylabel(f"velocity ({unit}/s)")
    axes[1].legend(loc="upper right")
    axes[2].plot(times, [float(value) for value in trace["effort"]], color="#1f4e79")
    axes[2].set_ylabel("effort")
    axes[2].set_xlabel("time (s)")
    for state, (name, colour) in _STAGES.items():
        inside = [time for time, seen in zip(times, trace["state"], strict=True) if seen == state]
        if inside:
            for ax in axes:
                ax.axvspan(inside[0], inside[-1], color=colour, zorder=0)
            axes[0].text(inside[0], axes[0].get_ylim()[1], f" {name}", va="bottom", fontsize=9)
    for ax in axes:
        ax.grid(alpha=0.3)
    figure.savefig(picture, metadata={"Date": None} if picture.suffix == ".svg" else None)


def main() -> None:
    """Read the arguments and draw."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("trace", type=Path, help="CSV file of `demo --trace`")
    parser.add_argument("picture", type=Path, help="picture to write: .svg, .png, .pdf")
    parser.add_argument("--unit", default="mm", help="unit of position (default mm)")
    arguments = parser.parse_args()
    try:
        draw(read(arguments.trace), arguments.unit, arguments.picture)
    except (OSError, KeyError, IndexError) as error:
        parser.error(f"{arguments.trace} is no trace of `demo --trace`, or the picture cannot be written: {error!r}")


if __name__ == "__main__":
    main()
