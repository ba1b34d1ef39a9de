"""Draw the rooms of the package and which imports which: ``python -m tools.rooms.draw``, from the imports themselves.

Each arrow is an import. One that follows from others is left out: of a room that imports ``client`` and ``api``, the
arrow to ``client`` alone is drawn. ``--check`` writes nothing, and fails if the picture is not up to date.
"""

import argparse
import sys
import tomllib
from collections.abc import Mapping
from html import escape
from typing import Final

from tools.rooms.imports import PACKAGE, imports_of

PICTURE: Final = PACKAGE.parent / "docs" / "pictures" / "rooms.svg"

_ROW: Final = 38
_BOX: Final = (130, 26)
_TOP: Final = 16
_INK: Final = "#1f3d5c"


def rooms() -> list[str]:
    """Return the rooms that there are, from the top to the bottom, as pyproject.toml has them."""
    tables = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    layers = next(contract["layers"] for contract in tables["contracts"] if contract["id"] == "rooms")
    names = [layer.strip("()") for layer in layers]
    return [name for name in names if (PACKAGE / name / "__init__.py").is_file()]


def arrows(names: list[str]) -> set[tuple[str, str]]:
    """Return which room imports which, without what follows from other imports."""
    direct: dict[str, set[str]] = {name: set() for name in names}
    for one in imports_of(PACKAGE):
        upper, lower = one.importer.partition(".")[0], one.imported.partition(".")[0]
        if upper != lower and {upper, lower} <= direct.keys():
            direct[upper].add(lower)
    return {
        (upper, lower)
        for upper, imported in direct.items()
        for lower in imported
        if not any(_reaches(direct, between, lower) for between in imported - {lower})
    }


def _reaches(direct: Mapping[str, set[str]], start: str, end: str) -> bool:
    seen, left = set(), [start]
    while left:
        room = left.pop()
        if room == end:
            return True
        if room not in seen:
            seen.add(room)
            left.extend(direct[room])
    return False


def drawn(names: list[str], shown: set[tuple[str, str]]) -> str:
    """Return the picture as SVG: the rooms below each other, and the arrows as arcs beside them."""
    width, height = _BOX
    places = {name: _TOP + _ROW * row for row, name in enumerate(names)}
    longest = max((abs(places[lower] - places[upper]) for upper, lower in shown), default=0)
    size = (_BOX[0] + 40 + longest // 2, 2 * _TOP + _ROW * len(names) - (_ROW - height))
    wide, high = size
    box = f'width="{wide}" height="{high}"'
    font = 'font-family="system-ui, sans-serif" font-size="14"'
    tip = 'id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {box} viewBox="0 0 {wide} {high}" {font}>',
        "<title>The rooms of twostage_servo, and which imports which</title>",
        f'<defs><marker {tip}><path d="M0 0 8 4 0 8z" fill="{_INK}"/></marker></defs>',
        f'<rect {box} fill="white"/>',
    ]
    for upper, lower in sorted(shown, key=lambda arrow: (places[arrow[0]], places[arrow[1]])):
        start, end = places[upper] + 0.65 * height, places[lower] + 0.35 * height
        reach = 16 + abs(end - start) / 1.6
        right = 10 + width
        lines.append(
            f'<path d="M{right} {start:g}C{right + reach:g} {start:g} {right + reach:g} {end:g} {right} {end:g}" '
            f'fill="none" stroke="{_INK}" stroke-opacity="0.75" marker-end="url(#tip)"/>'
        )
    for name, place in places.items():
        lines.append(
            f'<rect x="10" y="{place}" width="{width}" height="{height}" rx="4" fill="#eef3f8" stroke="{_INK}"/>'
            f'<text x="{10 + width // 2}" y="{place + 18}" text-anchor="middle" fill="{_INK}">{escape(name)}</text>'
        )
    return "\n".join([*lines, "</svg>", ""])


def main() -> int:
    """Write the picture, or check it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    options = parser.parse_args()
    names = rooms()
    picture = drawn(names, arrows(names))
    if not options.check:
        PICTURE.write_text(picture, encoding="utf-8")
        return 0
    if PICTURE.is_file() and PICTURE.read_text(encoding="utf-8") == picture:
        return 0
    print(f"{PICTURE} is not what the imports say: run python -m tools.rooms.draw", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
