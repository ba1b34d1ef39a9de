"""A pytest plugin for the unmutated tree: which functions of the package each test calls, and how long it takes.

What it finds is kept for each file of tests, until that file, what the tests share or the package changes. So a run
that goes on after new tests were written runs no other test unmutated again.
"""

import dataclasses
import json
import os
import re
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Final

import pytest

from mutation.results import digest

OUTPUT = "MUTATION_REACH"
"""Environment variable with the path of the file to which the plugin writes; without it the plugin does nothing."""

PACKAGE = "twostage_servo"

AT_IMPORT = ""
"""What stands for a test's name where a function is called while the tests are imported."""

_MODULE: Final = re.compile(rf"{PACKAGE}(?:\.\w+)+")

Found = dict[str, dict[str, Any]]
"""What a file of tests came to, by the test's name: ``took_s`` and ``calls``."""


class _Recorder:
    """Writes down the functions of the package that are called, in any thread."""

    def __init__(self, top: Path) -> None:
        self._top = str(top) + os.sep
        self._names: dict[CodeType, str | None] = {}
        self.calls: set[str] = set()
        self.began_s = 0.0

    def trace(self, frame: FrameType, _event: str, _argument: object) -> None:
        """Take a call in; by returning nothing, leave the lines of the function alone."""
        code = frame.f_code
        try:
            name = self._names[code]
        except KeyError:
            name = self._names[code] = self._name(code)
        if name is not None:
            self.calls.add(name)

    def _name(self, code: CodeType) -> str | None:
        path = os.path.abspath(code.co_filename)  # noqa: PTH100 - for each function there is, and a Path is slower
        if not path.startswith(self._top + PACKAGE + os.sep) or code.co_name == "<module>":
            return None
        return f"{path.removeprefix(self._top)}:{code.co_qualname.partition('.<locals>')[0]}"


_recorder = _Recorder(Path.cwd())
_found: dict[str, Found] = {}


def _is_wanted() -> bool:
    return OUTPUT in os.environ


def _start() -> None:
    threading.settrace(_recorder.trace)
    sys.settrace(_recorder.trace)


def _take(file: str, test: str, took_s: float) -> None:
    _found.setdefault(file, {})[test] = {"took_s": round(took_s, 4), "calls": sorted(_recorder.calls)}
    _recorder.calls.clear()


def pytest_sessionstart() -> None:
    """Begin before the tests are imported."""
    if _is_wanted():
        _start()


def pytest_collection_finish() -> None:
    """Write down what the import of the tests called."""
    if _is_wanted():
        _take(AT_IMPORT, AT_IMPORT, 0.0)


def pytest_runtest_setup(item: pytest.Item) -> None:  # noqa: ARG001 - pytest goes by the name
    """Begin with a test."""
    if _is_wanted():
        _start()
        _recorder.began_s = time.process_time()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Write down what a test has called, with what its fixtures have."""
    if _is_wanted():
        _take(item.nodeid.partition("::")[0], item.nodeid, time.process_time() - _recorder.began_s)


def pytest_sessionfinish() -> None:
    """Write all of it."""
    if _is_wanted():
        sys.settrace(None)
        threading.settrace(None)
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
        functions, and for a function that no test calls in its own process, all count that call anything in the file or
        bear its name.
        """
        stem, module = Path(path).stem, path.removesuffix(".py").replace("/", ".")

        def is_named(test: str) -> bool:
            return stem in Path(test.partition("::")[0]).stem

        def distance(test: str) -> int:
            return 0 if is_named(test) else 1 if module in self.imports.get(test.partition("::")[0], ()) else 2

        tests = set(self.tests.get(f"{path}:{function}", ()))
        if not tests:
            tests = {test for key, found in self.tests.items() if key.startswith(path + ":") for test in found}
            tests |= set(filter(is_named, self.took_s))
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
