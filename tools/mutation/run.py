"""Mutation testing: what the tests of a room would not notice if its code were wrong.

``python tools/mutation/run.py control`` changes `twostage_servo/control/` in a throw-away copy, one small change at a
time, and lets `tests/control` find out; ``axis`` likewise. It takes the better part of an hour on two cores; ``--only
observer.py`` takes some minutes. It exits with 1 if less than 90 % of the mutants are found, or if one that is not
found has no reason in `survivors.toml`. A mutant with a reason there counts as not found and is not tried, but with
``--all``. A reason whose mutant is found, or no longer exists, is reported: it can go.

The mutants are mutmut's (3.8), because it imports the tests once, forks for each mutant, and runs just the tests that
call the function, the quickest first: three mutants a second, where cosmic-ray needs a process with numpy and scipy for
each, two seconds before the first test. What mutmut leaves out is added, see :mod:`engine`: properties, constants and
defaults outside functions, negated conditions. Texts are left out: docstrings, strings, f-strings and what a ``raise``
says. So numbers, signs, operators, comparisons, conditions and arguments count.

What mutmut leaves out and nothing adds: functions under a decorator other than ``property``, ``staticmethod`` and
``classmethod``. In the two rooms these are the three validators of ``axis/settings.py``, whose comparisons
`tests/axis/test_settings_of_an_axis.py` holds by hand on either side. The rest of that module is numbers of fields.

Examples of property tests are the same every time. A test that takes more processor time than :mod:`limits` allows
counts as one that found its mutant: an endless loop is noticed.
"""

import argparse
import concurrent.futures
import dataclasses
import fnmatch
import importlib.util
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[0] = str(HERE.parent)

from mutation.mutant import Mutant  # noqa: E402 - found by the path above

TREE = HERE.parent.parent
LEAST_SCORE = 0.9
MOST_WALL_S = 3600
"""For the whole room in one process."""
NEEDED = {"mutmut": "mutmut>=3.8,<3.9", "pytest": "pytest", "hypothesis": "hypothesis"}
SETTINGS = """
[tool.mutmut]
source_paths = ["twostage_servo"]
only_mutate = {paths}
also_copy = ["config", "docs", "README.md", "CHANGELOG.md", "tools"]
pytest_add_cli_args_test_selection = {tests}
pytest_add_cli_args = ["-p", "no:cacheprovider", "-p", "mutation.limits"]
track_dependencies = false
use_git_change_detection = false
timeout_multiplier = 6.0
timeout_constant = 5.0
"""


def copied(target: Path) -> Path:
    """Copy the tree without what git ignores."""
    ignore = shutil.ignore_patterns(
        ".git", ".venv", "__pycache__", "*.egg-info", ".*_cache", ".hypothesis", "build", "dist", "mutants"
    )
    shutil.copytree(TREE, target, ignore=ignore)
    return target


def environment(tree: Path) -> dict[str, str]:
    """Return the environment in which a tree's tests see that tree."""
    return os.environ | {
        "CI": "1",
        "PYTHONPATH": os.pathsep.join([str(tree), str(HERE.parent)]),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }


def forked(tree: Path, tests: list[str], paths: list[str], plan: dict[str, Any], jobs: int) -> list[Mutant]:
    """Run mutmut in a copy of the tree; return its mutants with their status."""
    (tree / "plan.json").write_text(json.dumps(plan), encoding="utf-8")
    with (tree / "pyproject.toml").open("a", encoding="utf-8") as file:
        file.write(SETTINGS.format(paths=json.dumps(paths), tests=json.dumps(tests)))
    results = tree / "mutation.jsonl"
    command = [sys.executable, str(HERE / "engine.py"), str(jobs), "plan.json", str(results), *paths]
    environ = environment(tree)
    # mutmut puts its mutated copy of the tree before everything else itself.
    environ["PYTHONPATH"] = str(HERE.parent)
    done = subprocess.run(command, cwd=tree, env=environ, stdout=sys.stderr, check=False)  # noqa: S603 - fixed
    if done.returncode:
        raise SystemExit(f"mutmut ended with {done.returncode}")
    entries = [json.loads(line) for line in results.read_text(encoding="utf-8").splitlines()]
    return [Mutant(**entry | {"diff": tuple(entry["diff"])}) for entry in entries]


def in_own_process(tree: Path, tests: list[str], path: str, source: str) -> str:
    """Run the tests on one mutated file, those that bear its name first; return the status."""
    file = tree / path
    original = file.read_text(encoding="utf-8")
    file.write_text(source, encoding="utf-8")
    first = [str(test.relative_to(tree)) for name in tests for test in (tree / name).rglob(f"test_{file.stem}*.py")]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "mutation.limits"]
    command += [*sorted(first), *tests]
    try:
        code = subprocess.run(  # noqa: S603 - fixed
            command, cwd=tree, env=environment(tree), capture_output=True, timeout=MOST_WALL_S, check=False
        ).returncode
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        file.write_text(original, encoding="utf-8")
    return {0: "survived", 36: "timeout"}.get(code, "killed")


def verdicts(folder: Path, tests: list[str], found: list[Mutant], jobs: int) -> list[Mutant]:
    """Try what forking could not decide in processes of its own."""
    trees: queue.SimpleQueue[Path] = queue.SimpleQueue()
    for number in range(jobs):
        trees.put(copied(folder / f"fresh{number}"))

    def verdict(mutant: Mutant) -> Mutant:
        if mutant.status != "fresh":
            return mutant
        tree = trees.get()
        try:
            return dataclasses.replace(mutant, status=in_own_process(tree, tests, mutant.path, mutant.source))
        finally:
            trees.put(tree)

    undecided = sum(mutant.status == "fresh" for mutant in found)
    mutants = []
    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        for number, mutant in enumerate(pool.map(verdict, found), 1):
            mutants.append(mutant)
            print(f"\r{undecided} in their own processes: {number}/{len(found)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return mutants


def reasons() -> dict[str, str]:
    """Return the reason of each mutant in `survivors.toml`, by key."""
    groups = tomllib.loads((HERE / "survivors.toml").read_text(encoding="utf-8")).get("group", [])
    return {key: group["reason"] for group in groups for key in group["mutants"]}


def summarise(mutants: list[Mutant], explained: dict[str, str], tried: list[str], seconds: float) -> dict[str, Any]:
    """Return counts per module, the score, the survivors, and which of the reasons that were tried can go."""
    modules: dict[str, dict[str, int]] = {}
    for mutant in mutants:
        counts = modules.setdefault(mutant.path, {"mutants": 0, "killed": 0, "timeout": 0, "survived": 0})
        counts["mutants"] += 1
        counts[mutant.status] += 1
    survivors = [mutant for mutant in mutants if mutant.status == "survived"]
    found = len(mutants) - len(survivors)
    places = {mutant.place for mutant in mutants}
    left = {mutant.key for mutant in survivors}
    return {
        "modules": modules,
        "mutants": len(mutants),
        "found": found,
        "score": found / len(mutants) if mutants else 1.0,
        "seconds": round(seconds, 1),
        "survivors": [{"key": mutant.key, "reason": explained.get(mutant.key)} for mutant in survivors],
        "reasons_without_mutant": [key for key in tried if key.split(":")[0] in places and key not in left],
    }


def as_text(summary: dict[str, Any]) -> str:
    """Lay the summary out to be read."""
    lines = [f"{'module':48}{'mutants':>8}{'killed':>8}{'timeout':>8}{'survived':>9}{'found':>8}"]
    for path, counts in summary["modules"].items():
        share = 1.0 - counts["survived"] / counts["mutants"]
        numbers = f"{counts['mutants']:8}{counts['killed']:8}{counts['timeout']:8}{counts['survived']:9}{share:8.1%}"
        lines.append(f"{path:48}{numbers}")
    total = f"{summary['found']} of {summary['mutants']} found: {summary['score']:.1%}"
    lines.append(f"{total}, in {summary['seconds']:.0f} s")
    lines += [
        f"\nsurvived: {survivor['key']}\n  {survivor['reason'] or 'NO REASON in survivors.toml'}"
        for survivor in summary["survivors"]
    ]
    lines += [f"\nno longer needed in survivors.toml: {key}" for key in summary["reasons_without_mutant"]]
    return "\n".join(lines)


def main() -> int:
    """Run the mutants that the arguments describe; return 0 if enough are found and the others explained."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("room", choices=["control", "axis"])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--all", action="store_true", help="try those of survivors.toml as well, not just the others")
    parser.add_argument("--again", type=Path, metavar="JSON", help="only what survived in that --json output")
    parser.add_argument("--quick", action="store_true", help="do not try survivors again in processes of their own")
    parser.add_argument("--only", default=["*"], nargs="+", metavar="GLOB", help="files of the room, as observer.py")
    parser.add_argument("--tests", nargs="+", metavar="PATH", help="fewer than those of the room, which is quicker")
    options = parser.parse_args()
    tests: list[str] = options.tests or [f"tests/{options.room}"]
    missing = [package for name, package in NEEDED.items() if importlib.util.find_spec(name) is None]
    if missing:
        parser.error(f"install beside the package: pip install {' '.join(repr(package) for package in missing)}")
    top = TREE / "twostage_servo" / options.room
    every = {str(path.relative_to(top)): path for path in sorted(top.rglob("*.py"))}
    files = [path for name, path in every.items() if any(fnmatch.fnmatch(name, glob) for glob in options.only)]
    paths = [str(path.relative_to(TREE)) for path in files]
    if not paths:
        parser.error(f"no file of {top.relative_to(TREE)} is called {' or '.join(options.only)}")
    started = time.monotonic()
    explained = reasons()
    plan: dict[str, Any] = {"known": [] if options.all else sorted(explained), "only": None, "quick": options.quick}
    if options.again:
        survivors = json.loads(options.again.read_text(encoding="utf-8"))["survivors"]
        plan["only"] = [survivor["key"] for survivor in survivors]
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = Path(name)
        found = forked(copied(folder / "forked"), tests, paths, plan, options.jobs)
        mutants = verdicts(folder, tests, found, options.jobs)
    tried = [key for key in explained if plan["only"] is None or key in plan["only"]]
    summary = summarise(mutants, explained, tried, time.monotonic() - started)
    print(json.dumps(summary, indent=1) if options.json else as_text(summary))
    unexplained = any(survivor["reason"] is None for survivor in summary["survivors"])
    return 1 if unexplained or summary["score"] < LEAST_SCORE else 0


if __name__ == "__main__":
    sys.exit(main())
