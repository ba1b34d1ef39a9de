"""No circle of imports between modules, and every room in its place; ``lint-imports`` holds the rest in CI."""

import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest

from tools.rooms.assignments import assignments
from tools.rooms.imports import PACKAGE, Import, circles, imports_of

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
CONTRACTS = tomllib.loads(PYPROJECT.read_text("utf-8"))["tool"]["importlinter"]["contracts"]
ROOMS = next(contract for contract in CONTRACTS if contract["id"] == "rooms")
IMPORTS = imports_of(PACKAGE)


def package(folder: Path, sources: Mapping[str, str]) -> list[Import]:
    for name, source in sources.items():
        path = folder / "made" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source, "utf-8")
    return imports_of(folder / "made")


def test_no_modules_import_each_other() -> None:
    assert circles(IMPORTS) == []


def test_each_room_imports_from_those_below_it() -> None:
    places = {name.strip("()"): place for place, name in enumerate(ROOMS["layers"])}
    rising = {
        f"{one.importer} -> {one.imported}"
        for one in IMPORTS
        if (upper := places.get(one.importer.partition(".")[0])) is not None
        and (lower := places.get(one.imported.partition(".")[0])) is not None
        and lower < upper
    }
    assert rising == set()


def test_every_room_has_a_place() -> None:
    found = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    placed = {name for name in ROOMS["layers"] if not name.startswith("(")} | set(ROOMS["exhaustive_ignores"])
    assert placed - found == set()
    assert found - {"__init__"} - placed <= {name.strip("()") for name in ROOMS["layers"]}


@pytest.mark.parametrize(
    "source",
    [
        "from made.a import x\n",
        "import made.a\n",
        "def f() -> None:\n    from made import a\n",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from made.a import A\n",
    ],
)
def test_a_circle_is_found_wherever_the_import_stands(source: str, tmp_path: Path) -> None:
    made = package(tmp_path, {"__init__": "", "a": "from made.b import y\n", "b": "from made import c\n", "c": source})
    assert circles(made) == [["a", "b", "c"]]


def test_what_only_shares_an_import_is_no_circle(tmp_path: Path) -> None:
    sources = {"__init__": "", "a": "from made import b, c\n", "b": "from made.c import z\n", "c": "z = 1\n"}
    assert circles(package(tmp_path, sources)) == []


def test_two_circles_are_told_apart_and_a_package_counts_as_a_module(tmp_path: Path) -> None:
    sources = {
        "__init__": "", "a": "import made.b\n", "b": "import made.a\nimport made.inner.d\n",
        "inner/__init__": "from made.inner.d import x\n", "inner/d": "import os\nfrom made.inner import e\n",
        "inner/e": "from made.inner import d\n",
    }  # fmt: skip
    made = package(tmp_path, sources)
    assert circles(made) == [["a", "b"], ["inner.d", "inner.e"]]
    assert Import("b", "inner.d", 2) in made


def set_from_outside(folder: Path, source: str) -> list[str]:
    (folder / "made").mkdir()
    (folder / "made" / "a.py").write_text(source, "utf-8")
    return [one.text for one in assignments(folder / "made")]


def test_nobody_sets_an_attribute_of_another_object() -> None:
    assert assignments(PACKAGE) == []


PART = """
class Part:
    def __init__(self):
        self.on_arrival = None
"""


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("part.on_arrival = act\n", ["part.on_arrival"]),
        ("whole.part.on_arrival += 1\n", ["whole.part.on_arrival"]),
        ("before, part.on_arrival = part.on_arrival, act\n", ["part.on_arrival"]),
        ("for part.on_arrival in acts: pass\n", ["part.on_arrival"]),
        ("del part.on_arrival\n", ["part.on_arrival"]),
        ("setattr(part, 'on_arrival', act)\n", ["setattr(part, 'on_arrival', act)"]),
        ("setattr(part, name, act)\n", ["setattr(part, name, act)"]),
        ("object.__setattr__(part, 'on_arrival', act)\n", ["object.__setattr__(part, 'on_arrival', act)"]),
        ("part.listen(act)\n", []),
        ("message.timestamp = 1.0\n", []),
        ("import sys\nsetattr(sys, name, act)\n", []),
        ("import threading\nthreading.Thread.on_arrival = act\n", []),
        ("import threading as t\nt.Thread.on_arrival = act\n", []),
        ("profile.on_arrival = act\n", ["profile.on_arrival"]),
        ("import os\npart.os.on_arrival = act\n", ["part.os.on_arrival"]),
    ],
)
def test_an_assignment_from_outside_is_found(source: str, found: list[str], tmp_path: Path) -> None:
    assert set_from_outside(tmp_path, PART + source) == found


@pytest.mark.parametrize(
    ("decorator", "found"),
    [
        ("@dataclass\n", []),
        ("@dataclass(slots=True)\n", []),
        ("@dataclass(frozen=True)\n", ["one.sent"]),
        ("", ["one.sent"]),
    ],
)
def test_a_field_of_a_record_may_be_set(decorator: str, found: list[str], tmp_path: Path) -> None:
    source = f"{decorator}class Counters:\n    sent: int = 0\n\none.sent += 1\n"
    assert set_from_outside(tmp_path, source) == found
