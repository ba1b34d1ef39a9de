"""Measure what each part of the adaptive law buys: the move of the demo, with one part off at a time.

``python -m tools.law_parts`` prints the table of docs/adaptive-law.md; with ``--write`` it stands there afterwards. All
runs are in simulated time, and the same each time; they take some minutes.
"""

import argparse
import contextlib
import csv
import io
import itertools
import json
import statistics
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from tools.write_tables import replaced
from twostage_servo.cli.main import main as command

_PAGE: Final = Path(__file__).parents[1] / "docs" / "adaptive-law.md"
_ADAPTIVE: Final = "axis.law.type=adaptive"
_SEEDS: Final = range(1, 8)
_OFF: Final = 0.3
_LONGEST_S: Final = 10.0
"""What a move that does not settle counts in a mean."""


@dataclass(frozen=True)
class Outcome:
    """What becomes of a move.

    Attributes
    ----------
    settling_s
        Until it stays within a thousandth of its length, or the position window, in s; None if it does not.
    overshoot
        In mm.
    peak_effort
        Largest magnitude, in V.
    """

    settling_s: float | None
    overshoot: float
    peak_effort: float


@dataclass(frozen=True)
class Row:
    """A law to measure: what it is called, and the keys that are set."""

    name: str
    keys: tuple[str, ...]


def _without(*parts: str) -> tuple[str, ...]:
    return (_ADAPTIVE, *(f"axis.law.adaptive.{part}=false" for part in parts))


PARTS: Final = (
    "planned_braking",
    "placed_poles",
    "identification",
    "delay",
    "caution",
    "departure",
    "friction",
    "root",
)

ROWS: Final = (
    Row("all of them", (_ADAPTIVE,)),
    *(Row(f"without `{part}`", _without(part)) for part in PARTS),
    Row("planned braking alone", _without(*PARTS[1:])),
    Row("none: the paper's law", _without(*PARTS)),
)


def demo(keys: Iterable[str], *options: str) -> Outcome:
    """Run the demo in simulated time with some keys set, and return what becomes of its move."""
    text = io.StringIO()
    with TemporaryDirectory() as folder, contextlib.redirect_stdout(text), contextlib.redirect_stderr(io.StringIO()):
        trace = Path(folder) / "trace.csv"
        set_keys = [part for key in keys for part in ("--set", key)]
        command(["demo", "--fast", "--json", "--trace", str(trace), *options, *set_keys])
        with trace.open(encoding="utf-8") as file:
            peak = max(abs(float(row["effort"])) for row in csv.DictReader(file))
    found = json.loads(text.getvalue())
    settled = found["moves"][-1]["settling_time_s"] if found["failure"] is None else None
    return Outcome(settled, found["overshoot"], peak)


def off_model() -> Iterator[tuple[str, ...]]:
    """Yield the plants that are 30 % off the model of the demo."""
    for gain, pole in itertools.product((1.0 - _OFF, 1.0 + _OFF), repeat=2):
        yield f"simulation.gain={180.0 * gain:g}", f"simulation.pole={14.0 * pole:g}"


def worst(outcomes: Iterable[Outcome]) -> Outcome:
    """Return the worst of each figure."""
    found = list(outcomes)
    times = [one.settling_s for one in found]
    return Outcome(
        None if None in times else max(filter(None, times)),
        max(one.overshoot for one in found),
        max(one.peak_effort for one in found),
    )


def _cells(outcome: Outcome) -> str:
    settled = "does not settle" if outcome.settling_s is None else f"{outcome.settling_s:.2f} s"
    return f"{settled}, {outcome.overshoot:.3f} mm"


def _late(keys: tuple[str, ...]) -> str:
    return _cells(demo((*keys, "simulation.delay_ms=10")))


def _stuck(keys: tuple[str, ...]) -> str:
    return f"{demo((*keys, 'simulation.coulomb_friction=23')).peak_effort:.1f} V at most"


def _rubs(keys: tuple[str, ...]) -> str:
    """Return the mean over some seeds of the noise, of a third move of 100 mm, to 0.1 mm."""
    rough = (*keys, "simulation.noise_std=0.0316", "simulation.coulomb_friction=1", "axis.window.position=0.1")
    times = [demo((*rough, f"simulation.seed={seed}"), "--to", "100", "--moves", "3").settling_s for seed in _SEEDS]
    return f"{statistics.fmean(_LONGEST_S if one is None else one for one in times):.2f} s"


def _pushed(keys: tuple[str, ...]) -> str:
    load = ("simulation.load=6", "simulation.load_at_s=4", "axis.limits.effort_rate=400")
    return _cells(demo((*keys, *load)))


CASES: Final = (
    ("delay", "effort acts a tick late", _late),
    ("departure", "axis that is stuck (friction of 23 V): effort until it trips", _stuck),
    ("friction", "friction of 1 V, noise of 0.0316 mm: a third move of 100 mm, to 0.1 mm (mean of seven)", _rubs),
    ("root", "load of 6 V as the axis brakes, effort rate of 400 V/s", _pushed),
)
"""Parts that a quiet axis without a load has no use for, and where they tell."""


def line(row: Row) -> str:
    """Measure a law; return its line of the table."""
    corners = worst(demo((*row.keys, *plant)) for plant in off_model())
    return f"| {row.name} | {_cells(demo(row.keys))} | {_cells(corners)} |"


def table() -> str:
    """Measure all of them."""
    lines = ["| parts | on the model | worst of ±30 % |", "|---|---|---|", *(line(row) for row in ROWS)]
    lines += ["", "| part | where it tells | with it | without it |", "|---|---|---|---|"]
    for part, where, measure in CASES:
        lines.append(f"| `{part}` | {where} | {measure(_without())} | {measure(_without(part))} |")
    return "\n".join(lines)


def main() -> int:
    """Print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="put the table into the docs")
    options = parser.parse_args()
    made = table()
    if options.write:
        _PAGE.write_text(replaced(_PAGE.read_text("utf-8"), "law-parts", made), "utf-8")
    print(made)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
