"""Write the tables in the docs that come from the code: errata, states, trips, and the fault matrix.

``python tools/write_tables.py`` after a change of what they say; with ``--faults`` the fault campaign as well, which
takes a minute or two. ``--check`` writes nothing, and fails if a table is not what the code says, or if a fault cell is
missed.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from twostage_servo.axis.state import transition_table
from twostage_servo.axis.trips import trip_table
from twostage_servo.paper.errata import errata_table

_DOCS = Path(__file__).parents[1] / "docs"
TABLES: dict[str, tuple[str, Callable[[], str]]] = {
    "errata": ("law.md", errata_table),
    "transitions": ("states.md", transition_table),
    "trips": ("states.md", trip_table),
}
"""Name of the marked place, its page, and what makes the table."""

_SEED = 1


def fault_matrix() -> str:
    """Run the campaign on the shipped configuration.

    Raises
    ------
    SystemExit
        If a cell is missed.
    """
    from twostage_servo.faults.report import as_markdown, describe  # noqa: PLC0415 - the others need no campaign
    from twostage_servo.faults.runner import run_campaign  # noqa: PLC0415

    def report(_: object, done: int, total: int) -> None:
        if done % 25 == 0 or done == total:
            print(f"{done} of {total} cells", flush=True)

    cells = run_campaign(None, (), _SEED, report=report)
    if missed := [describe(cell, "mm") for cell in cells if not cell.met]:
        sys.exit("\n".join(["missed:", *missed]))
    return as_markdown(cells)


def replaced(page: str, name: str, table: str) -> str:
    """Return a page with the table between its two marks."""
    begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->\n"
    before, found, rest = page.partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        sys.exit(f"no marks for the table {name}")
    return f"{before}{begin}{table}\n{end}{after}"


def main() -> int:
    """Write or check the tables; return 0 if all is as it should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", action="store_true", help="run the fault campaign as well")
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    options = parser.parse_args()
    tables = dict(TABLES)
    if options.faults:
        tables["faults"] = ("faults.md", fault_matrix)
    different = []
    for name, (file, make) in tables.items():
        path = _DOCS / file
        page = path.read_text("utf-8")
        fresh = replaced(page, name, make())
        if fresh == page:
            continue
        different.append(f"docs/{file}: {name}")
        if not options.check:
            path.write_text(fresh, "utf-8")
    verb = "not what the code says" if options.check else "written"
    print("\n".join(f"{one} {verb}" for one in different) or "every table is what the code says")
    return 1 if options.check and different else 0


if __name__ == "__main__":
    sys.exit(main())
