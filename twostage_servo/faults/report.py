"""The campaign's result as text, as a table for the docs, and as a page."""

import math
from collections.abc import Sequence

from twostage_servo.api.fields import JsonObject
from twostage_servo.faults.cell import Cell, NotApplicable
from twostage_servo.faults.phase import ALL, BRAKED, SEARCHING
from twostage_servo.faults.runner import Result
from twostage_servo.faults.table import MEANINGS, PROCESS_FAULTS, TABLE
from twostage_servo.html_pages import page

_NOTES = {fault.name: fault.note for fault in TABLE if fault.note}


def rows(cells: Sequence[Cell]) -> list[tuple[int, str, dict[str, Cell]]]:
    """Return number, name and the cells by phase, a row a fault, in the order of the numbers."""
    table: dict[tuple[int, str], dict[str, Cell]] = {}
    for cell in cells:
        table.setdefault((cell.fault, cell.name), {})[cell.phase] = cell
    return [(number, name, phases) for (number, name), phases in sorted(table.items(), key=lambda row: row[0][0])]


def by_axis(result: Result) -> list[tuple[str, list[Cell]]]:
    """Return the axes' names with their cells; what is of no axis goes to the only one."""
    first = next(iter(result.units))
    return [(name, [cell for cell in result.cells if (cell.axis or first) == name]) for name in result.units]


def as_json(result: Result, seed: int) -> JsonObject:
    """Return the result as one JSON object."""
    cells, first = result.cells, next(iter(result.units))
    return {
        "seed": seed,
        "unit": result.units[first],
        "units": result.units,
        "met": sum(cell.met for cell in cells),
        "missed": sum(not cell.met for cell in cells),
        "cells": [
            {
                "axis": cell.axis or first,
                "fault": cell.fault,
                "name": cell.name,
                "phase": cell.phase,
                "expected": cell.expected,
                "observed": cell.observed,
                "trip": cell.trip,
                "travel": _finite(cell.travel),
                "bound": _finite(cell.bound),
                "met": cell.met,
                "wrong": cell.wrong,
                "limit": cell.limit,
            }
            for cell in cells
        ],
        "not_applicable": [
            {"axis": one.axis, "fault": one.fault, "name": one.name, "phase": one.phase, "reason": one.reason}
            for one in result.not_applicable
        ],
    }


def as_text(result: Result) -> str:
    """Return a table for a terminal: the reaction in each phase, and the largest travel with its bound."""
    several = len(result.units) > 1
    parts = []
    for axis, cells in by_axis(result):
        unit = result.units[axis]
        parts += [f"Axis {axis}, in {unit}"] if several else []
        parts += [_matrix_text(cells), ""]
    parts += [f"{letter}  {meaning}" for letter, meaning in MEANINGS.items()]
    units = ", ".join(dict.fromkeys(result.units.values()))
    parts.append(f"Each cell: reaction, and travel after the fault / allowed travel, in {units}. ! marks a miss.")
    parts += [f"NOT APPLICABLE {line}" for line in _why_not(result.not_applicable)]
    for axis, cells in by_axis(result):
        parts += [f"LIMIT {describe(cell, result.units[axis])}" for cell in cells if cell.met and cell.limit]
        parts += [f"MISSED {describe(cell, result.units[axis])}" for cell in cells if not cell.met]
    return "\n".join(parts)


def _matrix_text(cells: Sequence[Cell]) -> str:
    width = max((len(cell.name) for cell in cells), default=10)
    phases = _columns(cells)
    lines = [f"{'':4}{'fault':{width}}  {'  '.join(f'{phase:>12}' for phase in phases)}"]
    for number, name, by_phase in rows(cells):
        lines.append(f"{number:3} {name:{width}}  {'  '.join(_short(by_phase.get(phase)) for phase in phases)}")
    return "\n".join(lines)


def _why_not(not_applicable: Sequence[NotApplicable]) -> list[str]:
    """Return a line for each fault that there cannot be, or only in some of its phases, with the reason."""
    phases: dict[tuple[str, int, str, str], list[str]] = {}
    for one in not_applicable:
        phases.setdefault((one.axis, one.fault, one.name, one.reason), []).append(one.phase)
    everywhere = {(fault.number, fault.name): len(fault.phases) for fault in TABLE}
    lines = []
    for (axis, number, name, reason), where in phases.items():
        all_of_them = len(where) == everywhere.get((number, name), len(where))
        what = " ".join(filter(None, (str(number), name))) + ("" if all_of_them else f", {', '.join(where)}")
        several = len({one.axis for one in not_applicable if one.axis}) > 1
        lines.append(f"{f'{axis}: ' if several and axis else ''}{what}: {reason}")
    return lines


def describe(cell: Cell, unit: str) -> str:
    """Return a line that says what a cell came to."""
    text = f"{cell.axis}: " if cell.axis else ""
    text += f"{cell.fault} {cell.name}, {cell.phase}: expected {cell.expected}, observed {cell.observed}"
    if cell.trip:
        text += f" ({cell.trip})"
    text += f", travel {cell.travel:.3f} of {cell.bound:.3f} {unit}"
    return text + "".join(f"; {more}" for more in (cell.limit, cell.wrong) if more)


def as_markdown(result: Result) -> str:
    """Return the matrix of each axis as it stands in the docs, with what there is not, and the stated limits."""
    parts = []
    for axis, cells in by_axis(result):
        parts += [f"Axis {axis}:", ""] if len(result.units) > 1 else []
        parts += [matrix(cells), ""]
        if limits := [cell for cell in cells if cell.limit]:
            parts += ["Limits of one encoder:", ""]
            parts += [f"- {cell.fault} {cell.name}, {cell.phase}: {cell.limit}." for cell in limits]
            parts.append("")
    if missing := _why_not(result.not_applicable):
        parts += ["Not applicable:", "", *(f"- {line}." for line in missing), ""]
    return "\n".join(parts).rstrip("\n")


def matrix(cells: Sequence[Cell]) -> str:
    """Return the matrix of one axis. Travel and bound are rounded up."""
    phases = _columns(cells)
    lines = ["| | fault | " + " | ".join(phases) + " |", "|---" * (len(phases) + 2) + "|"]
    for number, name, by_phase in rows(cells):
        note = f" *({_NOTES[name]})*" if name in _NOTES else ""
        columns = [rounded(by_phase.get(phase)) for phase in phases]
        lines.append(f"| {number} | {name}{note} | " + " | ".join(columns) + " |")
    return "\n".join(lines)


def as_page(result: Result, seed: int, what: str) -> str:
    """Return a self-contained page: the matrices, each travel drawn against its bound, and what the letters mean."""
    missed = sum(not cell.met for cell in result.cells)
    return page(
        "faults/report.html.jinja",
        what=what,
        seed=seed,
        verdict=f"{len(result.cells) - missed} cells met, {missed} missed",
        state="good" if missed == 0 else "bad",
        unit=", ".join(dict.fromkeys(result.units.values())),
        legend=MEANINGS,
        axes=[_axis_on_page(name, cells, result.units[name]) for name, cells in by_axis(result)],
        missing=_why_not(result.not_applicable),
    )


def _axis_on_page(name: str, cells: Sequence[Cell], unit: str) -> JsonObject:
    """Return what the page shows of one axis."""
    phases = _columns(cells)
    return {
        "name": name,
        "phases": phases,
        "rows": [
            {
                "number": number,
                "name": fault,
                "note": _NOTES.get(fault, ""),
                "cells": [_cell_on_page(by_phase.get(phase), unit) for phase in phases],
            }
            for number, fault, by_phase in rows(cells)
        ],
    }


def _cell_on_page(cell: Cell | None, unit: str) -> JsonObject | None:
    if cell is None:
        return None
    share = min(1.0, cell.travel / cell.bound) if cell.bound > 0.0 else float(cell.travel > 0.0)
    return {
        "met": cell.met,
        "observed": cell.observed,
        "title": describe(cell, unit),
        "travel": _plain(cell.travel),
        "bound": _plain(cell.bound),
        "percent": f"{100.0 * share:.0f}",
    }


def _columns(cells: Sequence[Cell]) -> list[str]:
    """Return the phases of which there are cells, in their order."""
    there = {cell.phase for cell in cells}
    return [phase.value for phase in (*ALL, *SEARCHING, *BRAKED) if phase.value in there]


def _short(cell: Cell | None) -> str:
    if cell is None:
        return f"{'':12}"
    text = f"{cell.observed} {_plain(cell.travel)}/{_plain(cell.bound)}"
    return f"{text + ('' if cell.met else '!'):>12}"


def rounded(cell: Cell | None) -> str:
    """Return what stands in a place of the matrix."""
    if cell is None:
        return ""
    if cell.fault in PROCESS_FAULTS:  # in real time no two runs are the same
        return cell.expected + ("" if cell.met else " **missed**")
    letter = f"{cell.observed} limit," if cell.limit else cell.expected
    return f"{letter} {_up(cell.travel)} / {_up(cell.bound)}" + ("" if cell.met else " **missed**")


def _plain(distance: float) -> str:
    """Write three digits, and none behind the thousandth."""
    return f"{distance:.3g}" if distance >= 1.0 else f"{distance:.3f}".rstrip("0").rstrip(".")


def _up(distance: float) -> str:
    """Round up: to one digit below 1, to a whole below 20, to two digits above."""
    if distance <= 0.0:
        return "0"
    digits = (
        _digits_below_1(distance)
        if distance < 1.0
        else 0
        if distance < 20.0
        else -max(0, math.floor(math.log10(distance)) - 1)
    )
    scale = 10.0**digits
    return f"{math.ceil(distance * scale - 1e-9) / scale:g}"


def _digits_below_1(distance: float) -> int:
    """Return the decimals that show one digit of a distance, at most a thousandth of the unit."""
    return min(3, max(1, -math.floor(math.log10(distance))))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
