"""Mutation testing: what the tests of a room would not notice if its code were wrong.

``python tools/mutation/run.py control`` changes `twostage_servo/control/` in a throw-away copy, one small change at a
time, and lets `tests/control` find out; ``axis``, ``service`` and ``client`` likewise, see :mod:`rooms`. The whole of a
room takes the better part of an hour on two cores, or more; ``--only observer.py`` takes some minutes. It exits with 1
if less than the room's least share of the mutants is found, or if one that is not found has no reason in
`survivors.toml`. A mutant with a reason there counts as not found and is not tried, but with ``--all``. A reason whose
mutant is found, or no longer exists, is reported: it can go.

With ``--results FILE`` what became of each mutant is kept there as soon as it is known, and a run that is started again
goes on from there: a verdict counts until the file changes, and that nothing was found until the tests change.
``--minutes`` ends a run after a time. Mutants are chosen in an order that has nothing to do with where they stand, and
is the same every time: ``--sample 150`` is a fair sample, and ``--share 3/20`` the third of twenty parts, for CI.

The mutants are mutmut's (3.8), because it imports the tests once, forks for each mutant, and runs just the tests that
call the function, the quickest first: three mutants a second, where cosmic-ray needs a process with numpy and scipy for
each, two seconds before the first test. What mutmut leaves out is added, see :mod:`engine`: properties, constants and
defaults outside functions, negated conditions. Texts are left out: docstrings, strings, f-strings and what a ``raise``
says. So numbers, signs, operators, comparisons, conditions and arguments count.

What mutmut leaves out and nothing adds: functions under a decorator other than ``property``, ``staticmethod`` and
``classmethod``. In `control` and `axis` these are the three validators of ``axis/settings.py``, whose comparisons
`tests/axis/test_settings_of_an_axis.py` holds by hand on either side. The rest of that module is numbers of fields.

Tests that start processes are left out: they take seconds each, and in real time. Examples of property tests are the
same every time. A test that takes ten times as much processor time as without a mutant (:mod:`limits`) counts as one
that found it: an endless loop is noticed.
"""

import argparse
import concurrent.futures
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

from mutation.limits import SPENT  # noqa: E402 - found by the path above
from mutation.mutant import Mutant  # noqa: E402 - likewise
from mutation.results import KeptResults, with_status  # noqa: E402 - likewise
from mutation.rooms import ROOMS, files_of, paths_of_tests  # noqa: E402 - likewise

TREE = HERE.parent.parent
LEAST_SCORE = {"control": 0.9, "axis": 0.9, "service": 0.85, "client": 0.85}
MOST_WALL_S = 3600
"""For the whole room in one process."""
NEEDED = {"mutmut": "mutmut>=3.8,<3.9", "pytest": "pytest", "hypothesis": "hypothesis"}
SETTINGS = """
[tool.mutmut]
source_paths = ["twostage_servo"]
only_mutate = {paths}
also_copy = ["config", "docs", "README.md", "CHANGELOG.md", "tools"]
pytest_add_cli_args_test_selection = {tests}
pytest_add_cli_args = {arguments}
track_dependencies = false
use_git_change_detection = false
timeout_multiplier = 6.0
timeout_constant = 5.0
"""
PYTEST = ["-p", "no:cacheprovider", "-p", "mutation.limits", "-m", "not processes"]
PYTEST += [
    # It starts a process of another user, in which mutmut's own code cannot find what it needs.
    "--deselect=tests/service/test_control_socket.py::test_who_may_not_enter_the_folder_of_the_socket_is_told_so",
]


def copied(target: Path) -> Path:
    """Copy the tree without what git ignores."""
    ignore = shutil.ignore_patterns(
        ".git", ".venv", "__pycache__", "*.egg-info", ".*_cache", ".hypothesis", "build", "dist", "mutants"
    )
    shutil.copytree(TREE, target, ignore=ignore)
    return target


def environment(tree: Path, spent: Path) -> dict[str, str]:
    """Return the environment in which a tree's tests see that tree, and how long each of them may take."""
    return os.environ | {
        "CI": "1",
        "PYTHONPATH": os.pathsep.join([str(tree), str(HERE.parent)]),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
        SPENT: str(spent),
    }


def forked(
    folder: Path, tests: list[str], paths: list[str], plan: dict[str, Any], jobs: int, kept: KeptResults
) -> list[Mutant]:
    """Run mutmut in a copy of the tree; return its mutants with their status."""
    tree = copied(folder / "forked")
    progress = folder / "progress.jsonl"
    (tree / "plan.json").write_text(json.dumps(plan | {"progress": str(progress)}), encoding="utf-8")
    with (tree / "pyproject.toml").open("a", encoding="utf-8") as file:
        values = {"paths": json.dumps(paths), "tests": json.dumps(tests), "arguments": json.dumps(PYTEST)}
        file.write(SETTINGS.format(**values))
    results = tree / "mutation.jsonl"
    command = [sys.executable, str(HERE / "engine.py"), str(jobs), "plan.json", str(results), *paths]
    environ = environment(tree, folder / "spent.json")
    # mutmut puts its mutated copy of the tree before everything else itself.
    environ["PYTHONPATH"] = str(HERE.parent)
    try:
        code = subprocess.run(command, cwd=tree, env=environ, stdout=sys.stderr, check=False).returncode  # noqa: S603
    finally:  # also where it was interrupted
        for mutant in read_mutants(progress):
            if mutant.status in {"killed", "timeout"} or (plan["quick"] and mutant.status == "survived"):
                kept.keep(mutant)
    if code:
        raise SystemExit(f"mutmut ended with {code}")
    return read_mutants(results)


def read_mutants(path: Path) -> list[Mutant]:
    """Return the mutants in a file; none if there is none."""
    if not path.exists():
        return []
    entries = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [Mutant(**entry | {"diff": tuple(entry["diff"]), "tests": tuple(entry["tests"])}) for entry in entries]


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


def reasons() -> dict[str, str]:
    """Return the reason of each mutant in `survivors.toml`, by key."""
    groups = tomllib.loads((HERE / "survivors.toml").read_text(encoding="utf-8")).get("group", [])
    return {key: group["reason"] for group in groups for key in group["mutants"]}


def summarise(every: list[Mutant], explained: dict[str, str], tried: list[str], seconds: float) -> dict[str, Any]:
    """Return counts per module, the score, the survivors, and which of the reasons that were tried can go."""
    mutants = [mutant for mutant in every if mutant.status != "open"]
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
        "open": len(every) - len(mutants),
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
    left = f"; {summary['open']} were not tried any more" if summary["open"] else ""
    lines.append(f"{total}, in {summary['seconds']:.0f} s{left}")
    lines += [
        f"\nsurvived: {survivor['key']}\n  {survivor['reason'] or 'NO REASON in survivors.toml'}"
        for survivor in summary["survivors"]
    ]
    lines += [f"\nno longer needed in survivors.toml: {key}" for key in summary["reasons_without_mutant"]]
    return "\n".join(lines)


def share(text: str) -> tuple[int, int]:
    """Return the numbers of ``3/20``."""
    number, _, of = text.partition("/")
    if not (number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
        raise argparse.ArgumentTypeError(f"{text!r}: give a part of all, such as 3/20")
    return int(number), int(of)


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("room", choices=list(ROOMS))
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--all", action="store_true", help="try those of survivors.toml as well, not just the others")
    parser.add_argument("--again", type=Path, metavar="JSON", help="only what survived in that --json output")
    parser.add_argument("--quick", action="store_true", help="do not try survivors again in processes of their own")
    parser.add_argument("--only", default=["*"], nargs="+", metavar="GLOB", help="files of the room, as observer.py")
    parser.add_argument("--tests", nargs="+", metavar="PATH", help="fewer than those of the room, which is quicker")
    parser.add_argument("--results", type=Path, metavar="FILE", help="keep the verdicts here, and go on from there")
    parser.add_argument("--minutes", type=float, metavar="N", help="begin no mutant after so many minutes")
    parser.add_argument("--sample", type=int, metavar="N", help="so many mutants")
    parser.add_argument("--share", type=share, metavar="I/N", help="the I-th of N parts of the mutants")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the order in which they are tried")
    return parser


def make_plan(options: argparse.Namespace, explained: dict[str, str], kept: dict[str, str]) -> dict[str, Any]:
    """Return what the engine is to do."""
    known = kept | ({} if options.all else dict.fromkeys(explained, "survived"))
    only = None
    if options.again:
        survivors = json.loads(options.again.read_text(encoding="utf-8"))["survivors"]
        only = [survivor["key"] for survivor in survivors]
    most_s = None if options.minutes is None else 60.0 * options.minutes
    chosen = {"only": only, "sample": options.sample, "share": options.share, "seed": options.seed}
    return {"known": known, "quick": options.quick, "most_s": most_s, **chosen}


def main() -> int:
    """Run the mutants that the arguments describe; return 0 if enough are found and the others explained."""
    parser = arguments()
    options = parser.parse_args()
    room = ROOMS[options.room]
    tests: list[str] = options.tests or paths_of_tests(room, TREE)
    missing = [package for name, package in NEEDED.items() if importlib.util.find_spec(name) is None]
    if missing:
        parser.error(f"install beside the package: pip install {' '.join(repr(package) for package in missing)}")
    paths = files_of(room, TREE, options.only)
    if not paths:
        parser.error(f"no file of {options.room} is called {' or '.join(options.only)}")
    started = time.monotonic()
    explained, kept = reasons(), KeptResults(options.results, TREE, tests)
    plan = make_plan(options, explained, kept.load())
    until_s = None if plan["most_s"] is None else started + plan["most_s"]
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = Path(name)
        found = forked(folder, tests, paths, plan, options.jobs, kept)
        mutants = verdicts(folder, tests, found, options.jobs, kept, until_s)
    looked_at = {mutant.key for mutant in mutants}
    is_part = options.sample is not None or options.share is not None or plan["only"] is not None
    tried = [key for key in explained if not is_part or key in looked_at]
    summary = summarise(mutants, explained, tried, time.monotonic() - started)
    print(json.dumps(summary, indent=1) if options.json else as_text(summary))
    unexplained = any(survivor["reason"] is None for survivor in summary["survivors"])
    return 1 if unexplained or summary["score"] < LEAST_SCORE[options.room] else 0


if __name__ == "__main__":
    sys.exit(main())
