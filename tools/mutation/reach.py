"""A pytest plugin for the unmutated tree: which functions of the package each test calls, and how long it takes.

What it finds is kept for each file of tests, until that file, what the tests share or the package changes. So a run
that goes on after new tests were written runs no other test unmutated again.
"""

import ast
import builtins
import dataclasses
import json
import os
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pytest

from tools.mutation.results import digest

OUTPUT = "MUTATION_REACH"
"""Environment variable with the path of the file to which the plugin writes; without it the plugin does nothing."""

PACKAGE = "twostage_servo"

AT_IMPORT = ""
"""What stands for a test's name where a function is called while the tests are imported."""

_MODULE: Final = re.compile(rf"{PACKAGE}(?:\.\w+)+")

_TOLD: Final = "_mutation_told"

Found = dict[str, dict[str, Any]]
"""What a file of tests came to, by the test's name: ``took_s`` and ``calls``."""


class _Telling(ast.NodeTransformer):
    """Lets each function begin with telling that it was called."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._names: list[str] = []

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        self._names.append(node.name)
        self.generic_visit(node)
        self._names.pop()
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        return self._told(node)

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> ast.AST:
        return self._told(node)

    def _told(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> ast.AST:
        """Leave what is inside as it is: a function in a function belongs to that."""
        name = f"{self._path}:{'.'.join([*self._names, node.name])}"
        node.body.insert(1 if ast.get_docstring(node) else 0, ast.parse(f"{_TOLD}({name!r})").body[0])
        return node


def let_functions_tell(tree: Path) -> None:
    """Rewrite the package of a throw-away copy of the tree, so that each of its functions tells that it was called.

    A tracer of Python's own does without, and makes the tests four times as slow. A process that a test starts has not
    this plugin: there nobody is told.
    """
    for file in sorted((tree / PACKAGE).rglob("*.py")):
        telling = _Telling(str(file.relative_to(tree))).visit(ast.parse(file.read_text(encoding="utf-8")))
        file.write_text(ast.unparse(ast.fix_missing_locations(telling)), encoding="utf-8")
    with (tree / PACKAGE / "__init__.py").open("a", encoding="utf-8") as first:
        first.write(f"\nimport builtins\nvars(builtins).setdefault({_TOLD!r}, len)\n")


_calls: set[str] = set()
_began_s = [0.0]
_found: dict[str, Found] = {}
setattr(builtins, _TOLD, _calls.add)


def _is_wanted() -> bool:
    return OUTPUT in os.environ


def _take(file: str, test: str, took_s: float) -> None:
    _found.setdefault(file, {})[test] = {"took_s": round(took_s, 4), "calls": sorted(_calls)}
    _calls.clear()


def pytest_collection_finish() -> None:
    """Write down what the import of the tests called."""
    if _is_wanted():
        _take(AT_IMPORT, AT_IMPORT, 0.0)


def pytest_runtest_setup(item: pytest.Item) -> None:  # noqa: ARG001 - pytest goes by the name
    """Begin with a test."""
    _began_s[0] = time.process_time()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Write down what a test has called, with what its fixtures have."""
    if _is_wanted():
        _take(item.nodeid.partition("::")[0], item.nodeid, time.process_time() - _began_s[0])


def pytest_sessionfinish() -> None:
    """Write all of it."""
    if _is_wanted():
        Path(os.environ[OUTPUT]).write_text(json.dumps(_found), encoding="utf-8")


@dataclasses.dataclass(frozen=True, slots=True)
class Reach:
    """Which tests call what.

    Attributes
    ----------
    took_s
        Processor time of each test, in s, by its name.
    tests
        The tests that call a function, by ``path:Class.function``.
    at_import
        The functions that the import of the tests calls.
    imports
        The modules that a file of tests names, by the file.
    """

    took_s: dict[str, float]
    tests: dict[str, list[str]]
    at_import: frozenset[str]
    imports: dict[str, list[str]] = dataclasses.field(default_factory=dict)

    def chosen(self, path: str, function: str, most_s: float) -> list[str]:
        """Return the tests to run for a mutant, in their order, as many as take `most_s` together, but one at least.

        First come those of files that bear the module's name, then of those that import it, then the quickest. Outside
        functions, and for a function that no test calls in its own process, all count that call anything in the file,
        and those of files that import it or bear its name: a constant is read, and not called.
        """
        stem, module = Path(path).stem, path.removesuffix(".py").replace("/", ".")

        def is_named(test: str) -> bool:
            return stem in Path(test.partition("::")[0]).stem

        def distance(test: str) -> int:
            return 0 if is_named(test) else 1 if module in self.imports.get(test.partition("::")[0], ()) else 2

        tests = set(self.tests.get(f"{path}:{function}", ()))
        if not tests:
            tests = {test for key, found in self.tests.items() if key.startswith(path + ":") for test in found}
            tests |= {test for test in self.took_s if distance(test) < 2}
        ordered = sorted(tests, key=lambda test: (distance(test), self.took_s[test], test))
        spent_s, chosen = 0.0, list[str]()
        for test in ordered:
            spent_s += self.took_s[test]
            if chosen and spent_s > most_s:
                continue
            chosen.append(test)
        return chosen


class KeptReach:
    """A file with what each file of tests reaches.

    Parameters
    ----------
    path
        The file; None keeps nothing.
    tree
        The tree.
    tests
        Folders and files of tests, from the top of the tree.
    """

    def __init__(self, path: Path | None, tree: Path, tests: Sequence[str]) -> None:
        self._path = path
        self._tree = tree
        files = [file for name in tests for file in _python_files(tree / name)]
        shared = sorted({str(file.relative_to(tree)) for file in _python_files(tree / "tests") if not _is_tests(file)})
        base = digest(tree, [PACKAGE, *shared])
        self._keys = {
            str(file.relative_to(tree)): base + digest(tree, [str(file.relative_to(tree))])
            for file in files
            if _is_tests(file)
        }
        self._kept: dict[str, dict[str, Any]] = {}
        if path is not None and path.exists():
            kept = json.loads(path.read_text(encoding="utf-8"))
            self._kept = {file: entry for file, entry in kept.items() if self._keys.get(file) == entry["key"]}

    def unknown(self) -> list[str]:
        """Return the files of tests of which nothing is known."""
        return sorted(set(self._keys) - set(self._kept))

    def add(self, found: dict[str, Found]) -> None:
        """Add what a run of the plugin found of the files that were unknown."""
        at_import = found.get(AT_IMPORT, {}).get(AT_IMPORT, {"calls": []})["calls"]
        for file in self.unknown():
            self._kept[file] = {"key": self._keys[file], "tests": found.get(file, {}), "at_import": at_import}
        if self._path is not None:
            others = json.loads(self._path.read_text(encoding="utf-8")) if self._path.exists() else {}
            self._path.write_text(json.dumps(others | self._kept), encoding="utf-8")

    def reach(self) -> Reach:
        """Return what is known."""
        took_s: dict[str, float] = {}
        tests: dict[str, list[str]] = {}
        for entry in self._kept.values():
            for test, found in entry["tests"].items():
                took_s[test] = found["took_s"]
                for name in found["calls"]:
                    tests.setdefault(name, []).append(test)
        at_import = frozenset(name for entry in self._kept.values() for name in entry["at_import"])
        imports = {
            file: sorted(set(_MODULE.findall((self._tree / file).read_text(encoding="utf-8")))) for file in self._kept
        }
        return Reach(took_s, tests, at_import, imports)


def _python_files(top: Path) -> list[Path]:
    return [top] if top.is_file() else sorted(top.rglob("*.py"))


def _is_tests(file: Path) -> bool:
    return file.name.startswith("test_")
