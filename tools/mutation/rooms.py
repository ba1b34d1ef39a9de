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


ROOMS = {
    "control": Room(("control",), ("tests/control",)),
    "axis": Room(("axis",), ("tests/axis",)),
    "service": Room(("service",), ("tests/service", "tests/test_printable.py", "tests/canbus/test_slow_opening.py")),
    "client": Room(("cli/client.py", "client"), ("tests/cli", "tests/client", "tests/service/test_socket_trust.py")),
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
