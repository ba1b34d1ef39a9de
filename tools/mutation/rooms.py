"""Which files a room of the mutation testing has, and where the tests are that should notice a change of them."""

import dataclasses
import fnmatch
from collections.abc import Sequence
from pathlib import Path

PACKAGE = "twostage_servo"


@dataclasses.dataclass(frozen=True, slots=True)
class Room:
    """A part of the package with its tests.

    Attributes
    ----------
    sources
        Files and folders below the package; one that does not exist is left out.
    tests
        Files and folders of tests, likewise. Which of their tests are run for a mutant follows from what they call.
    """

    sources: tuple[str, ...]
    tests: tuple[str, ...]


_OF_AN_AXIS = ("backlog", "disabled_drive", "encoder_range", "foreign_commands", "reference")
"""Tests of an axis with its drive on a bus, which stand beside those of the service."""

_OF_CONTROL = (
    "adaptive_axis", "design_numbers", "duration", "encoder", "encoder_in_doubt", "smooth_axis", "stops",
    "stops_of_other_plants", "stops_under_load", "very_slow",
)  # fmt: skip
"""Tests of the model's test and of the law with an axis around them."""

ROOMS = {
    "control": Room(("control",), ("tests/control", *(f"tests/axis/test_{name}.py" for name in _OF_CONTROL))),
    "axis": Room(
        ("axis",),
        (
            "tests/axis",
            "tests/cli/test_warnings_of_check.py",
            *(f"tests/service/test_{name}.py" for name in _OF_AN_AXIS),
        ),
    ),
    "service": Room(
        ("app", "service", "telemetry", "api", "timing/histogram.py"),
        (
            "tests/app",
            "tests/service",
            "tests/telemetry",
            "tests/api",
            "tests/timing/test_histogram.py",
            "tests/test_printable.py",
            "tests/canbus/test_slow_opening.py",
        ),
    ),
    "client": Room(("client",), ("tests/cli", "tests/client", "tests/api/test_socket_trust.py")),
}


def files_of(room: Room, tree: Path, globs: Sequence[str] = ("*",)) -> list[str]:
    """Return the room's files, from the top of the tree, whose path below the room matches one of some patterns."""
    found = []
    for source in room.sources:
        top = tree / PACKAGE / source
        for path in [top] if top.is_file() else sorted(top.rglob("*.py")):
            name = path.name if top.is_file() else str(path.relative_to(top))
            if any(fnmatch.fnmatch(name, glob) for glob in globs):
                found.append(str(path.relative_to(tree)))
    return found


def paths_of_tests(room: Room, tree: Path) -> list[str]:
    """Return the folders and files of the room's tests, from the top of the tree."""
    return [test for test in room.tests if (tree / test).exists()]
