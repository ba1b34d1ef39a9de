"""One change of one file, and what became of it."""

import dataclasses
import re
from collections.abc import Sequence
from typing import Final


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One change of one file.

    Attributes
    ----------
    path
        The file, from the top of the tree.
    function
        Its function, ``Class.method``; outside functions its class or an empty string.
    diff
        The lines that it removes and adds, each with its sign.
    status
        ``killed``, ``timeout``, ``survived``; ``fresh`` where a process of its own has to tell, and ``open`` where the
        time was over before.
    source
        The whole mutated file; empty unless the status is ``fresh``.
    tests
        The tests that a process of its own runs, in their order; empty for all of the room.
    """

    path: str
    function: str
    diff: tuple[str, ...]
    status: str = ""
    source: str = ""
    tests: tuple[str, ...] = ()

    @property
    def place(self) -> str:
        """The module, without the package's name."""
        return self.path.removeprefix("twostage_servo/").removesuffix(".py").replace("/", ".")

    @property
    def key(self) -> str:
        """What `survivors.toml` calls it: its place and its changed lines, nothing that moves with other lines."""
        return f"{self.place}:{self.function}: {' '.join(self.diff)}"

    @property
    def called(self) -> str:
        """What :mod:`reach` calls its function."""
        return f"{self.path}:{self.function}"


_LENGTHS: Final = re.compile(r"(zip\((?:[^()]|\([^()]*\))*),\s*(strict=\w+)?\s*\)")


def is_about_equal_lengths(lines: Sequence[str]) -> bool:
    """Whether changed lines differ by nothing but ``strict=`` of a zip, which changes nothing of equal lengths."""
    before, after = ([_LENGTHS.sub(r"\1)", line[2:]) for line in lines if line[0] == sign] for sign in "-+")
    return before == after
