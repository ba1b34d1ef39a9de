"""What became of each mutant, kept in a file, so that a run can go on later; and in which order they are tried."""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from mutation.mutant import Mutant


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
    """A file with a line for each mutant that was tried.

    A verdict counts for as long as the mutant's file is what it was. That nothing was found counts only while the tests
    are what they were as well.

    Parameters
    ----------
    path
        The file; None keeps nothing.
    tree
        The tree whose files they are of.
    tests
        The tests.
    """

    def __init__(self, path: Path | None, tree: Path, tests: Sequence[str]) -> None:
        self._path = path
        self._tree = tree
        self._tests = digest(tree, tests)
        self._sources: dict[str, str] = {}

    def load(self) -> dict[str, str]:
        """Return the verdicts that count, by key."""
        if self._path is None or not self._path.exists():
            return {}
        verdicts: dict[str, str] = {}
        for line in self._path.read_text(encoding="utf-8").splitlines():
            entry = json.loads(line)
            known = (self._tree / entry["path"]).exists() and entry["source"] == self._source(entry["path"])
            verdicts.pop(entry["key"], None)
            if known and (entry["status"] != "survived" or entry["tests"] == self._tests):
                verdicts[entry["key"]] = str(entry["status"])
        return verdicts

    def keep(self, mutant: Mutant) -> None:
        """Add what became of a mutant."""
        if self._path is None:
            return
        entry = {
            "key": mutant.key,
            "path": mutant.path,
            "status": mutant.status,
            "source": self._source(mutant.path),
            "tests": self._tests,
        }
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def _source(self, path: str) -> str:
        if path not in self._sources:
            self._sources[path] = digest(self._tree, [path])
        return self._sources[path]


def with_status(mutant: Mutant, status: str) -> Mutant:
    """Return a mutant of which it is known what became."""
    return dataclasses.replace(mutant, status=status, source="", tests=())
