"""The campaign's result as text, as a table for the docs, and as a page."""

import html
import math
from collections.abc import Sequence
from typing import Any

from twostage_servo.faults.campaign import Cell
from twostage_servo.faults.table import ALL, MEANINGS, PROCESS_FAULTS, SEARCHING, TABLE

_NOTES = {fault.name: fault.note for fault in TABLE if fault.note}


def rows(cells: Sequence[Cell]) -> list[tuple[int, str, dict[str, Cell]]]:
    """Return number, name and the cells by phase, a row a fault, in the order of the numbers."""
    table: dict[tuple[int, str], dict[str, Cell]] = {}
    for cell in cells:
        table.setdefault((cell.fault, cell.name), {})[cell.phase] = cell
    return [(number, name, phases) for (number, name), phases in sorted(table.items(), key=lambda row: row[0][0])]


def as_json(cells: Sequence[Cell], seed: int, unit: str, not_applicable: Sequence[str]) -> dict[str, Any]:
    """Return the result as one JSON object."""
    return {
        "seed": seed,
        "unit": unit,
        "met": sum(cell.met for cell in cells),
        "missed": sum(not cell.met for cell in cells),
        "cells": [
            {
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
            }
            for cell in cells
        ],
        "not_applicable": list(not_applicable),
    }


def as_text(cells: Sequence[Cell], unit: str) -> str:
    """Return a table for a terminal: the reaction in each phase, and the largest travel with its bound."""
    width = max((len(cell.name) for cell in cells), default=10)
    phases = _columns(cells)
    lines = [f"{'':4}{'fault':{width}}  {'  '.join(f'{phase:>12}' for phase in phases)}"]
    for number, name, by_phase in rows(cells):
        lines.append(f"{number:3} {name:{width}}  {'  '.join(_short(by_phase.get(phase)) for phase in phases)}")
    lines.append("")
    lines += [f"{letter}  {meaning}" for letter, meaning in MEANINGS.items()]
    lines.append(f"Each cell: reaction, and travel after the fault / largest that is allowed, in {unit}. ! is a miss.")
    lines += [f"MISSED {describe(cell, unit)}" for cell in cells if not cell.met]
    return "\n".join(lines)


def describe(cell: Cell, unit: str) -> str:
    """Return a line that says what a cell came to."""
    text = f"{cell.fault} {cell.name}, {cell.phase}: expected {cell.expected}, observed {cell.observed}"
    if cell.trip:
        text += f" ({cell.trip})"
    text += f", travel {cell.travel:.3f} of {cell.bound:.3f} {unit}"
    return text + (f"; {cell.wrong}" if cell.wrong else "")


def as_markdown(cells: Sequence[Cell]) -> str:
    """Return the matrix as it stands in the docs. Travel and bound are rounded up."""
    phases = _columns(cells)
    lines = ["| | fault | " + " | ".join(phases) + " |", "|---" * (len(phases) + 2) + "|"]
    for number, name, by_phase in rows(cells):
        note = f" *({_NOTES[name]})*" if name in _NOTES else ""
        columns = [_rounded(by_phase.get(phase)) for phase in phases]
        lines.append(f"| {number} | {name}{note} | " + " | ".join(columns) + " |")
    return "\n".join(lines)


def as_page(result: dict[str, Any], cells: Sequence[Cell], what: str) -> str:
    """Return a self-contained page: the matrix, each travel drawn against its bound, and what the letters mean."""
    unit = html.escape(result["unit"])
    phases = _columns(cells)
    body = []
    for number, name, by_phase in rows(cells):
        columns = "".join(_cell_html(by_phase.get(phase), result["unit"]) for phase in phases)
        note = f"<small>{html.escape(_NOTES[name])}</small>" if name in _NOTES else ""
        body.append(f"<tr><th>{number}</th><th>{html.escape(name)}{note}</th>{columns}</tr>")
    verdict = f"{result['met']} cells met, {result['missed']} missed"
    legend = "".join(f"<dt class='{key}'>{key}</dt><dd>{html.escape(text)}</dd>" for key, text in MEANINGS.items())
    missing = "".join(f"<li>{html.escape(text)}</li>" for text in result["not_applicable"])
    header = "".join(f"<th>{phase}</th>" for phase in phases)
    return _PAGE.format(
        what=html.escape(what), verdict=verdict, seed=result["seed"], unit=unit, header=header, rows="".join(body),
        legend=legend, missing=f"<h2>Not on this axis</h2><ul>{missing}</ul>" if missing else "",
        state="good" if result["missed"] == 0 else "bad",
    )  # fmt: skip


def _columns(cells: Sequence[Cell]) -> list[str]:
    """Return the phases of a move, and those of other motion as far as there are cells of them."""
    there = {cell.phase for cell in cells}
    return [*(phase.value for phase in ALL), *(phase.value for phase in SEARCHING if phase.value in there)]


def _short(cell: Cell | None) -> str:
    if cell is None:
        return f"{'':12}"
    text = f"{cell.observed} {_plain(cell.travel)}/{_plain(cell.bound)}"
    return f"{text + ('' if cell.met else '!'):>12}"


def _rounded(cell: Cell | None) -> str:
    if cell is None:
        return ""
    if cell.fault in PROCESS_FAULTS:  # in real time no two runs are the same
        return cell.expected + ("" if cell.met else " **missed**")
    return f"{cell.expected} {_up(cell.travel)} / {_up(cell.bound)}" + ("" if cell.met else " **missed**")


def _plain(distance: float) -> str:
    """Write three digits, and none behind the thousandth."""
    return f"{distance:.3g}" if distance >= 1.0 else f"{distance:.3f}".rstrip("0").rstrip(".")


def _up(distance: float) -> str:
    """Round up: to a tenth below 1, to a whole below 20, to two digits above."""
    if distance <= 0.0:
        return "0"
    digits = 1 if distance < 1.0 else 0 if distance < 20.0 else -max(0, math.floor(math.log10(distance)) - 1)
    scale = 10.0**digits
    return f"{math.ceil(distance * scale - 1e-9) / scale:g}"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _cell_html(cell: Cell | None, unit: str) -> str:
    if cell is None:
        return "<td class='none'></td>"
    share = min(1.0, cell.travel / cell.bound) if cell.bound > 0.0 else float(cell.travel > 0.0)
    title = html.escape(describe(cell, unit), quote=True)
    return (
        f"<td class='{'' if cell.met else 'missed'}' title='{title}'><b class='{cell.observed}'>{cell.observed}</b>"
        f"<span>{_plain(cell.travel)} / {_plain(cell.bound)}</span>"
        f"<i><u style='width:{100.0 * share:.0f}%'></u></i></td>"
    )


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Fault campaign</title>
<style>
body {{ font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem; padding: 0 1rem; color: #1c2330; }}
table {{ border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }}
th, td {{ border-bottom: 1px solid #dde2ea; padding: .3rem .5rem; text-align: left; vertical-align: top; }}
thead th {{ position: sticky; top: 0; background: #fff; }}
td span {{ margin-left: .4rem; color: #4a5568; white-space: nowrap; }}
td i {{ display: block; height: 4px; margin-top: 3px; background: #edf0f5; border-radius: 2px; }}
td u {{ display: block; height: 4px; background: #6b7a90; border-radius: 2px; }}
td.missed {{ background: #fde8e8; }} td.missed u {{ background: #c53030; }}
small {{ display: block; font-weight: normal; color: #66707f; }}
th {{ font-weight: 600; }}
b, dt {{ display: inline-block; min-width: 1.3em; text-align: center; border-radius: 3px; color: #fff; }}
.T {{ background: #2f855a; }} .R {{ background: #4a5568; }} .H {{ background: #2b6cb0; }} .S {{ background: #6b46c1; }}
.Q {{ background: #b7791f; }} .Z {{ background: #9b2c2c; }}
dl {{ display: grid; grid-template-columns: max-content 1fr; gap: .25rem .7rem; }} dd {{ margin: 0; }}
.good {{ color: #2f855a; }} .bad {{ color: #c53030; }}
.scroll {{ overflow-x: auto; }}
</style></head><body>
<h1>Fault campaign</h1>
<p>{what}. Seed {seed}. <strong class="{state}">{verdict}.</strong></p>
<p>Each cell is one run of the service in simulated time: what it did, and how far the axis travelled after the fault
against the largest distance that the limits allow, in {unit}. Where a fault is tolerated, the travel is the largest
distance from the same move without it. Point at a cell for the details.</p>
<dl>{legend}</dl>
<div class="scroll"><table><thead><tr><th></th><th>fault</th>{header}</tr></thead><tbody>{rows}</tbody></table></div>
{missing}
</body></html>
"""
