"""Mutants that cannot be tried by forking: each in a process of its own."""

import concurrent.futures
import queue
import subprocess
import sys
import time
from pathlib import Path

from tools.mutation.mutant import Mutant
from tools.mutation.results import KeptResults, with_status
from tools.mutation.trees import PYTEST, copied, environment

MOST_WALL_S = 600
"""For the tests of a mutant."""


def in_own_process(tree: Path, tests: list[str], mutant: Mutant, spent: Path) -> str:
    """Run the tests on one mutated file: those that call it, or those of the room that bear its name first."""
    file = tree / mutant.path
    original = file.read_text(encoding="utf-8")
    file.write_text(mutant.source, encoding="utf-8")
    first = [str(test.relative_to(tree)) for name in tests for test in (tree / name).rglob(f"test_{file.stem}*.py")]
    command = [sys.executable, "-m", "pytest", "-x", "-q", *PYTEST]
    command += list(mutant.tests) or [*sorted(first), *tests]
    try:
        code = subprocess.run(  # noqa: S603 - fixed
            command, cwd=tree, env=environment(tree, spent), capture_output=True, timeout=MOST_WALL_S, check=False
        ).returncode
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        file.write_text(original, encoding="utf-8")
    return {0: "survived", 36: "timeout"}.get(code, "killed")


def verdicts(
    folder: Path, tests: list[str], found: list[Mutant], jobs: int, kept: KeptResults, until_s: float | None
) -> list[Mutant]:
    """Try what forking could not decide in processes of its own, until a time on the monotonic clock."""
    trees: queue.SimpleQueue[Path] = queue.SimpleQueue()
    for number in range(jobs):
        trees.put(copied(folder / f"fresh{number}"))

    def verdict(mutant: Mutant) -> Mutant:
        if mutant.status != "fresh":
            return mutant
        if until_s is not None and time.monotonic() > until_s:
            return with_status(mutant, "open")
        tree = trees.get()
        try:
            decided = with_status(mutant, in_own_process(tree, tests, mutant, folder / "spent.json"))
        finally:
            trees.put(tree)
        kept.keep(decided)
        return decided

    undecided = sum(mutant.status == "fresh" for mutant in found)
    mutants = []
    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        for number, mutant in enumerate(pool.map(verdict, found), 1):
            mutants.append(mutant)
            print(f"\r{undecided} in their own processes: {number}/{len(found)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return mutants
