"""What became of each mutant, kept in a file, so that a run can go on later; and in which order they are tried."""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, Self

from tools.mutation.mutant import Mutant

DECIDED: Final = frozenset({"killed", "timeout", "survived"})


def in_order(keys: Iterable[str], seed: int = 0) -> list[str]:
    """Return keys in an order that is the same every time and has nothing to do with where they stand.

    So the first of them are a fair sample, and a change of one file moves no other key.
    """
    return sorted(set(keys), key=lambda key: hashlib.sha256(f"{seed} {key}".encode()).digest())


def share_of(keys: Iterable[str], number: int, of: int) -> list[str]:
    """Return a share of keys, `number` from 1 to `of`; each key is in one share, whatever other keys there are."""
    return [key for key in keys if int.from_bytes(hashlib.sha256(key.encode()).digest()[:8]) % of == number - 1]


def digest(tree: Path, paths: Sequence[str]) -> str:
    """Return a digest of files, and of all Python files in folders, given from the top of the tree."""
    found = hashlib.sha256()
    for path in sorted(paths):
        top = tree / path
        for file in [top] if top.is_file() else sorted(top.rglob("*.py")):
            found.update(file.relative_to(tree).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return found.hexdigest()[:16]


class KeptResults:
    """A file with a line for each mutant that was tried, written as soon as it is known what became of it.

    A verdict counts for as long as the mutant's file is what it was. That nothing was found counts only while the tests
    are what they were as well.

    Parameters
    ----------
    path
        The file; None keeps nothing.
    sources
        Digests of the files that are mutated, by their path.
    tests
        Digest of the tests.
    """

    def __init__(self, path: str | None, sources: dict[str, str], tests: str) -> None:
        self.path = path
        self.sources = sources
        self.tests = tests

    @classmethod
    def of(cls, path: Path | None, tree: Path, sources: Sequence[str], tests: Sequence[str]) -> Self:
        """Return those of a tree as it is now."""
        digests = {source: digest(tree, [source]) for source in sources}
        return cls(None if path is None else str(path.absolute()), digests, digest(tree, tests))

    def load(self, *, settled: bool = False) -> dict[str, str]:
        """Return the verdicts that count, by key; with `settled` also that nothing was found by earlier tests."""
        if self.path is None or not Path(self.path).exists():
            return {}
        verdicts: dict[str, str] = {}
        for line in Path(self.path).read_text(encoding="utf-8").splitlines():
            entry = json.loads(line)
            known = entry["source"] == self.sources.get(entry["path"])
            verdicts.pop(entry["key"], None)
            if known and (settled or entry["status"] != "survived" or entry["tests"] == self.tests):
                verdicts[entry["key"]] = str(entry["status"])
        return verdicts

    def keep(self, mutant: Mutant) -> None:
        """Add what became of a mutant, if that is known."""
        if self.path is None or mutant.status not in DECIDED:
            return
        entry = {
            "key": mutant.key,
            "path": mutant.path,
            "status": mutant.status,
            "source": self.sources[mutant.path],
            "tests": self.tests,
        }
        with Path(self.path).open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")


def with_status(mutant: Mutant, status: str) -> Mutant:
    """Return a mutant of which it is known what became."""
    return dataclasses.replace(mutant, status=status, source="", tests=())
