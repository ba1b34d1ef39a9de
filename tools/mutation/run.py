"""Mutation testing: what the tests of a room would not notice if its code were wrong.

``python -m tools.mutation.run control`` changes `twostage_servo/control/` in a throw-away copy, one small change at a
time, and lets `tests/control` find out; ``axis``, ``service`` and ``client`` likewise, see :mod:`rooms`. The whole of a
room takes the better part of an hour on two cores, or more; ``--only observer.py`` takes some minutes. It exits with 1
if less than the room's least share of the mutants is found, or if one that is not found has no reason in
`survivors.toml`. A mutant with a reason there counts as not found and is not tried, but with ``--all``. A reason whose
mutant is found, or no longer exists, is reported: it can go.

With ``--results FILE`` what became of each mutant is kept there, and a run that is started again goes on from there: a
verdict counts until the file changes, and that nothing was found until the tests change. ``--settled`` lets that count
for longer, which can only make the score too small; with ``--minutes 0`` it shows what is known. ``--minutes`` ends a
run after a time. Mutants are chosen in an order that has nothing to do with where they stand, and is the same every
time: ``--sample 150`` is a fair sample, and ``--share 3/20`` the third of twenty parts, for CI.

The tests run once unmutated, which shows what each calls and how long it takes (:mod:`reach`; kept beside the results).
A mutant is tried with those that call its function: those of a file that bears the module's name, of one that imports
it, then the quickest, as many as take ``--seconds`` together. So the score is a lower bound: another may find the rest.

The mutants are mutmut's (3.8), because it imports the tests once and forks for each mutant: three mutants a second,
where cosmic-ray needs a process with numpy and scipy for each, two seconds before the first test. What mutmut leaves
out is added, see :mod:`engine`: properties, constants and defaults outside functions, negated conditions. Texts are
left out: docstrings, strings, f-strings and what a ``raise`` says. So numbers, signs, operators, comparisons,
conditions and arguments count; but for ``strict=`` of a zip, and what a protocol declares.

What mutmut leaves out and nothing adds: functions under a decorator other than ``property``, ``staticmethod`` and
``classmethod``. In `control` and `axis` these are the three validators of ``axis/settings.py``, whose comparisons
`tests/axis/test_settings_of_an_axis.py` holds by hand on either side. The rest of that module is numbers of fields.

Tests that start processes are left out: they take seconds each, and in real time. Examples of property tests are the
same every time. A test that takes ten times as much processor time as without a mutant (:mod:`limits`) counts as one
that found it: an endless loop is noticed.
"""

import argparse
import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tools.mutation.mutant import Mutant
from tools.mutation.processes import verdicts
from tools.mutation.reach import OUTPUT, KeptReach, Reach, let_functions_tell
from tools.mutation.results import KeptResults
from tools.mutation.rooms import ROOMS, files_of, paths_of_tests
from tools.mutation.summary import as_far_as_tried, as_text, reasons, summarise
from tools.mutation.trees import PYTEST, TREE, copied, environment

LEAST_SCORE = {"control": 0.9, "axis": 0.9, "service": 0.85, "client": 0.85}
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


def what_tests_reach(folder: Path, tests: list[str], path: Path | None) -> Reach:
    """Run those tests unmutated of which it is not known yet what they call; return what all of them do."""
    kept = KeptReach(path, TREE, tests)
    if kept.unknown():
        tree, found = copied(folder / "unmutated"), folder / "reach.json"
        let_functions_tell(tree)
        print(f"unmutated first: {len(kept.unknown())} files of tests", file=sys.stderr)
        command = [sys.executable, "-m", "pytest", "-q", "-p", "tools.mutation.reach", *PYTEST, *kept.unknown()]
        environ = environment(tree, folder / "none.json") | {OUTPUT: str(found)}
        code = subprocess.run(command, cwd=tree, env=environ, stdout=sys.stderr, check=False).returncode  # noqa: S603
        if code:
            raise SystemExit(f"without a mutant the tests end with {code}")
        kept.add(json.loads(found.read_text(encoding="utf-8")))
    reach = kept.reach()
    (folder / "spent.json").write_text(json.dumps(reach.took_s), encoding="utf-8")
    return reach


def read_mutants(path: Path) -> list[Mutant]:
    """Return the mutants in a file."""
    entries = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [Mutant(**entry | {"diff": tuple(entry["diff"]), "tests": tuple(entry["tests"])}) for entry in entries]


def forked(folder: Path, tests: list[str], paths: list[str], plan: dict[str, Any], jobs: int) -> list[Mutant]:
    """Run mutmut in a copy of the tree; return its mutants with their status."""
    tree = copied(folder / "forked")
    (tree / "plan.json").write_text(json.dumps(plan), encoding="utf-8")
    with (tree / "pyproject.toml").open("a", encoding="utf-8") as file:
        values = {"paths": json.dumps(paths), "tests": json.dumps(tests), "arguments": json.dumps(PYTEST)}
        file.write(SETTINGS.format(**values))
    results = tree / "mutation.jsonl"
    command = [sys.executable, "-P", "-m", "tools.mutation.engine", str(jobs), "plan.json", str(results), *paths]
    environ = environment(tree, folder / "spent.json")
    # mutmut puts its mutated copy of the tree before everything else itself.
    environ["PYTHONPATH"] = str(TREE)
    code = subprocess.run(command, cwd=tree, env=environ, stdout=sys.stderr, check=False).returncode  # noqa: S603
    if code:
        raise SystemExit(f"mutmut ended with {code}")
    return read_mutants(results)


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
    parser.add_argument("--settled", action="store_true", help="try nothing again that survived with earlier tests")
    parser.add_argument("--seconds", type=float, default=20.0, metavar="N", help="of tests for each mutant, at most")
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
        only = [survivor["key"] for survivor in survivors if options.all or survivor["key"] not in explained]
    most_s = None if options.minutes is None else 60.0 * options.minutes
    chosen = {"only": only, "sample": options.sample, "share": options.share, "seed": options.seed}
    return {"known": known, "most_tests_s": options.seconds, "most_s": most_s, **chosen}


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
    explained, kept = reasons(), KeptResults.of(options.results, TREE, paths, tests)
    plan = make_plan(options, explained, kept.load(settled=options.settled))
    until_s = None if plan["most_s"] is None else started + plan["most_s"]
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = Path(name)
        reach = what_tests_reach(folder, tests, options.results and options.results.with_suffix(".reach.json"))
        plan["reach"] = dataclasses.asdict(reach) | {"at_import": sorted(reach.at_import)}
        plan["kept"] = vars(kept)
        found = forked(folder, tests, paths, plan, options.jobs)
        mutants = verdicts(folder, tests, found, options.jobs, kept, until_s)
    if not options.all:
        mutants = as_far_as_tried(mutants, explained, options.seed)
    looked_at = {mutant.key for mutant in mutants}
    is_part = options.sample is not None or options.share is not None or plan["only"] is not None
    tried = [key for key in explained if not is_part or key in looked_at]
    summary = summarise(mutants, explained, tried, time.monotonic() - started)
    print(json.dumps(summary, indent=1) if options.json else as_text(summary))
    unexplained = any(survivor["reason"] is None for survivor in summary["survivors"])
    return 1 if unexplained or summary["score"] < LEAST_SCORE[options.room] else 0


if __name__ == "__main__":
    sys.exit(main())
