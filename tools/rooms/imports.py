"""Which module of the package imports which, read from the source without running it, and where the imports go round.

Every import counts: those at the top, those inside functions, and those under ``if TYPE_CHECKING``, which would
otherwise hide a circle. ``python -m tools.rooms.imports [FOLDER]`` prints the circles; exit code 1 if there is one.
"""

import argparse
import ast
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

PACKAGE: Final = Path(__file__).resolve().parents[2] / "twostage_servo"


class Import(NamedTuple):
    """One import of a module of the package by another; both as dotted names below the package, with the line."""

    importer: str
    imported: str
    line: int


def imports_of(package: Path) -> list[Import]:
    """Return every import inside a package, in the order of files and lines."""
    sources = sorted(package.rglob("*.py"))
    modules = {_name(source, package): source for source in sources}
    return [
        Import(name, imported, line)
        for name, source in modules.items()
        for imported, line in dict.fromkeys(_imported(source, package.name, modules))
        if imported != name
    ]


def _name(source: Path, package: Path) -> str:
    parts = source.relative_to(package).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(source: Path, package: str, modules: Mapping[str, Path]) -> Iterator[tuple[str, int]]:
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            named = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            named = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in named:
            top, _, below = name.partition(".")
            if top != package:
                continue
            if below in modules:
                yield below, node.lineno
            elif (parent := below.rpartition(".")[0]) in modules:
                yield parent, node.lineno


def circles(imports: list[Import]) -> list[list[str]]:
    """Return the sets of modules that import each other, directly or through each other, the largest first.

    They are the strongly connected components of more than one module (R. Tarjan, 1972).
    """
    edges: dict[str, list[str]] = {}
    for one in imports:
        edges.setdefault(one.importer, []).append(one.imported)
        edges.setdefault(one.imported, [])
    search = _Search(edges)
    for module in sorted(edges):
        if module not in search.index:
            search.visit(module)
    return sorted(search.found, key=lambda circle: (-len(circle), circle))


class _Search:
    """Tarjan's search; ``found`` holds the components of more than one module."""

    def __init__(self, edges: Mapping[str, list[str]]) -> None:
        self.found: list[list[str]] = []
        self.index: dict[str, int] = {}
        self._edges = edges
        self._lowest: dict[str, int] = {}
        self._stack: list[str] = []

    def visit(self, module: str) -> None:
        """Visit a module and all that it reaches; as deep as the longest chain of imports, some dozens."""
        self.index[module] = self._lowest[module] = len(self.index)
        self._stack.append(module)
        for imported in self._edges[module]:
            if imported not in self.index:
                self.visit(imported)
                self._lowest[module] = min(self._lowest[module], self._lowest[imported])
            elif imported in self._stack:
                self._lowest[module] = min(self._lowest[module], self.index[imported])
        if self._lowest[module] == self.index[module]:
            place = self._stack.index(module)
            circle, self._stack[place:] = sorted(self._stack[place:]), []
            if len(circle) > 1:
                self.found.append(circle)


def main() -> int:
    """Print the circles of a package, each with the imports that close it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=PACKAGE, help="folder of the package (default: ours)")
    options = parser.parse_args()
    imports = imports_of(options.folder)
    found = circles(imports)
    for circle in found:
        print(f"{len(circle)} modules import each other: {', '.join(circle)}")
        for one in imports:
            if one.importer in circle and one.imported in circle:
                print(f"  {one.importer} (line {one.line}) imports {one.imported}")
    print("no circle" if not found else f"{len(found)} circles", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
