"""Write what in the docs comes from the code: errata, states, trips, the JSON schemas, and the fault matrices.

``python -m tools.write_tables`` after a change of what they say; with ``--faults`` the fault campaign on each shipped
configuration as well, which takes some minutes. ``--check`` writes nothing, and fails if a table is not what the code
says, or if a fault cell is missed. With ``--share TEXT`` it runs ``demo.toml`` whole, and of each other configuration
one cell in sixteen: the text, such as the hash of a commit, decides on which.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from twostage_servo.api.schema import schema_of_requests, schema_of_status
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

SCHEMAS: dict[str, Callable[[], dict[str, object]]] = {
    "requests.schema.json": schema_of_requests,
    "status.schema.json": schema_of_status,
}
"""Files of their own in the docs: what crosses the control socket."""

_CONFIGURATIONS = Path(__file__).parents[1] / "config"


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
    parser.add_argument("--only", metavar="NAME", action="append", help="of this configuration; may be repeated")
    parser.add_argument("--share", metavar="TEXT", help="with --check: the cells that this decides on")
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    options = parser.parse_args()
    if options.share is not None and not options.check:
        parser.error("--share compares some cells: it goes with --check")
    different = []
    for name, (file, make) in TABLES.items():
        path = _DOCS / file
        page = path.read_text("utf-8")
        fresh = replaced(page, name, make())
        if fresh == page:
            continue
        different.append(f"docs/{file}: {name}")
        if not options.check:
            path.write_text(fresh, "utf-8")
    for file, schema in SCHEMAS.items():
        path = _DOCS / file
        fresh = json.dumps(schema(), indent=1) + "\n"
        if path.exists() and path.read_text("utf-8") == fresh:
            continue
        different.append(f"docs/{file}")
        if not options.check:
            path.write_text(fresh, "utf-8")
    if options.faults:
        different += matrices(options.only or shipped(), check=options.check, share=options.share)
    verb = "not what the code says" if options.check else "written"
    print("\n".join(f"{one} {verb}" for one in different) or "every table is what the code says")
    return 1 if options.check and different else 0


def shipped() -> list[str]:
    """Return the names of the shipped configurations, demo.toml first."""
    return sorted((path.stem for path in _CONFIGURATIONS.glob("*.toml")), key=lambda name: (name != "demo", name))


def matrices(names: Sequence[str], *, check: bool, share: str | None) -> list[str]:
    """Run the campaign on configurations, and write or compare their matrices; return which are different.

    Raises
    ------
    SystemExit
        If a cell is missed.
    """
    from tools.faults.matrix import compare, run  # noqa: PLC0415 - the others need no campaign

    different = []
    missed: list[str] = []
    for name in names:
        part = share if name != "demo" else None
        matrix = run(_CONFIGURATIONS / f"{name}.toml", part)
        missed += matrix.missed
        mark, path = f"faults {name}", _DOCS / ("faults.md" if name == "demo" else "faults-of-other-configurations.md")
        page = path.read_text("utf-8")
        if part is not None:
            different += [f"{path.name}, {name}: {what}" for what in compare(page, mark, matrix)]
        elif (fresh := replaced(page, mark, matrix.text)) != page:
            different.append(f"docs/{path.name}: {mark}")
            if not (check or matrix.missed):
                path.write_text(fresh, "utf-8")
    if missed:
        again = f"; again with: python -m tools.write_tables --faults --check --share {share}" if share else ""
        sys.exit("\n".join([f"missed{again}:", *missed]))
    if share and different:
        print(f"again with: python -m tools.write_tables --faults --check --share {share}")
    return different


if __name__ == "__main__":
    sys.exit(main())
