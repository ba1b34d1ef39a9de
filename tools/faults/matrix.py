"""The matrix of a fault campaign as it stands in the docs, whole or a share of its cells that a text decides on."""

import hashlib
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from twostage_servo.faults.cell import Cell
from twostage_servo.faults.report import as_markdown, describe, rounded
from twostage_servo.faults.runner import run_campaign

SEED = 1

SHARE = 1.0 / 16.0
"""Share of the cells of a configuration that a change has to pass; another one with each commit."""

KNOWN_MISSES: dict[tuple[str, int, str], str] = {}
"""Configuration, number and phase of what is not met yet, and why. Each is shown as missed, and no other may be."""

Place = tuple[str, str, str, str]
"""Axis, number and name of the fault, and phase."""


@dataclass
class Matrix:
    """What a campaign came to.

    Attributes
    ----------
    text
        The whole section of the docs; of a share, only its cells are in it.
    cells
        What stands in each place.
    missed
        A line for each cell that is missed, and not known to be.
    """

    text: str
    cells: dict[Place, str] = field(default_factory=dict)
    missed: list[str] = field(default_factory=list)


def is_in_share(share: str, configuration: str, axis: str, name: str, phase: str) -> bool:
    """Whether a share has a cell: the same text gives the same cells, on every machine."""
    digest = hashlib.sha256("\n".join((share, configuration, axis, name, phase)).encode()).digest()
    return int.from_bytes(digest[:8], "big") < SHARE * 2.0**64


def run(path: Path, share: str | None = None) -> Matrix:
    """Run the campaign on a configuration: demo.toml with real processes, the others in simulated time.

    Parameters
    ----------
    path
        Its file.
    share
        What decides on the cells to run; None for all.
    """
    name = path.stem

    def report(_: Cell, done: int, total: int) -> None:
        if done % 50 == 0 or done == total:
            print(f"{name}: {done} of {total} cells", flush=True)

    result = run_campaign(
        path,
        (),
        SEED,
        processes=name == "demo",
        wanted=lambda axis, fault, phase: share is None or is_in_share(share, name, axis, fault, phase),
        report=report,
    )
    several = len(result.units) > 1
    missed = []
    for cell in (one for one in result.cells if not one.met):
        line = f"{name}: {describe(cell, result.units.get(cell.axis, ''))}"
        if reason := KNOWN_MISSES.get((name, cell.fault, cell.phase)):
            print(f"known, {reason}: {line}", flush=True)
        else:
            missed.append(line)
    return Matrix(as_markdown(result), dict(_places(result.cells, several=several)), missed)


def _places(cells: Iterable[Cell], *, several: bool) -> Iterable[tuple[Place, str]]:
    for cell in cells:
        yield (cell.axis if several else "", str(cell.fault), cell.name, cell.phase), rounded(cell)


def written(page: str, mark: str) -> dict[Place, str]:
    """Return what stands in each place of a section of a page.

    Raises
    ------
    SystemExit
        If there is no such section.
    """
    _, found, rest = page.partition(f"<!-- {mark}: begin -->\n")
    section, closed, _ = rest.partition(f"<!-- {mark}: end -->\n")
    if not (found and closed):
        sys.exit(f"no marks for the table {mark}")
    places: dict[Place, str] = {}
    axis = ""
    phases: list[str] = []
    for line in section.splitlines():
        if line.startswith("Axis "):
            axis = line.removeprefix("Axis ").removesuffix(":")
        elif line.startswith("| | fault |"):
            phases = [column.strip() for column in line.split("|")[3:-1]]
        elif line.startswith("| "):
            number, name, *columns = (column.strip() for column in line.split("|")[1:-1])
            for phase, column in zip(phases, columns, strict=True):
                if column:
                    places[axis, number, name.partition(" *(")[0], phase] = column
    return places


def compare(page: str, mark: str, matrix: Matrix) -> list[str]:
    """Return a line for each cell of a share that stands in the page otherwise, or not at all."""
    there = written(page, mark)
    return [
        f"{' '.join(filter(None, place))} is {text!r}, the page has {there.get(place, 'nothing')!r}:"
        for place, text in matrix.cells.items()
        if there.get(place) != text
    ]
