"""What an axis knows goes on when its settings change: nothing of it may be forgotten.

Each class that continues from a former one is read: what its methods change after ``__init__`` has to be handed over,
unless it is of one tick alone.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import twostage_servo.axis

FOLDER = Path(twostage_servo.axis.__file__).parent
OF_ONE_TICK = {
    "DriveReport": {"fresh", "told_state", "told_present_state"},
    "DriveStateComparison": {"new"},
}
"""Attributes that ``begin_tick`` sets anew, whatever they were."""


def continuing(folder: Path = FOLDER) -> Iterator[tuple[str, ast.ClassDef]]:
    for path in sorted(folder.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef) and "continue_from" in {one.name for one in methods(node)}:
                yield node.name, node


def methods(node: ast.ClassDef) -> list[ast.FunctionDef]:
    return [one for one in node.body if isinstance(one, ast.FunctionDef)]


def set_in(method: ast.FunctionDef) -> set[str]:
    """Return the attributes of `self` that a method sets."""
    return {
        one.attr
        for one in ast.walk(method)
        if isinstance(one, ast.Attribute) and isinstance(one.ctx, ast.Store) and ast.unparse(one.value) == "self"
    }


def forgotten(node: ast.ClassDef) -> set[str]:
    changed: set[str] = set()
    handed_over: set[str] = set()
    for method in methods(node):
        if method.name == "continue_from":
            handed_over = set_in(method)
        elif method.name != "__init__":
            changed |= set_in(method)
    return changed - handed_over - OF_ONE_TICK.get(node.name, set())


@pytest.mark.parametrize(("name", "node"), list(continuing()), ids=[name for name, _ in continuing()])
def test_all_that_changes_is_handed_over(name: str, node: ast.ClassDef) -> None:
    assert forgotten(node) == set(), f"{name}.continue_from forgets"


@pytest.mark.parametrize(("name", "node"), list(continuing()), ids=[name for name, _ in continuing()])
def test_what_is_of_one_tick_is_set_anew_in_each(name: str, node: ast.ClassDef) -> None:
    anew = {attribute for one in methods(node) if one.name == "begin_tick" for attribute in set_in(one)}
    assert OF_ONE_TICK.get(name, set()) <= anew


def test_those_that_an_axis_has_are_among_them() -> None:
    assert {name for name, _ in continuing()} == {
        "Axis", "CountWatch", "DisabledDriveWatch", "DriveReport", "DriveStateComparison", "ForeignCommands",
        "Heartbeat", "MotionWhileDisabled", "Reference", "Unwrapping",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("line", "lost"),
    [
        ("self.known = former.known", {"_ticks"}),
        ("self.known, self._ticks = former.known, former._ticks", set()),
    ],
)
def test_one_that_is_forgotten_is_found(line: str, lost: set[str]) -> None:
    source = f"""
class Watch:
    def __init__(self):
        self.known, self._ticks, self._limit = Known(), 0, 1.0

    def update(self):
        self.known.place = 1.0
        self._ticks += 1

    def continue_from(self, former):
        {line}
"""
    (node,) = ast.parse(source).body
    assert isinstance(node, ast.ClassDef)
    assert forgotten(node) == lost
