"""The mutation testing chooses what it tries the same every time, and goes on from what it has kept."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tools.mutation.limits import LEAST_CPU_S, OTHERWISE_CPU_S, TIMES, allowed_s
from tools.mutation.mutant import Mutant, is_about_equal_lengths
from tools.mutation.reach import OUTPUT, KeptReach, Reach, let_functions_tell
from tools.mutation.results import KeptResults, digest, in_order, share_of, with_status
from tools.mutation.rooms import ROOMS, Room, files_of, paths_of_tests
from tools.mutation.run import arguments, make_plan, share
from tools.mutation.summary import as_far_as_tried, reasons, summarise
from tools.mutation.trees import TREE, environment

PACKAGE = TREE / "twostage_servo"
KEYS = [f"service.loop:f{number}: - a + b" for number in range(1000)]


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name in ("twostage_servo/service/loop.py", "twostage_servo/client/verbs.py", "tests/service/test_loop.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("a = 1\n")
    return tmp_path


def mutant(name: str = "f", status: str = "killed") -> Mutant:
    return Mutant("twostage_servo/service/loop.py", name, ("- a", "+ b"), status)


# Which ones -----------------------------------------------------------------------------------------------------------


def test_the_order_depends_on_the_seed_alone() -> None:
    assert in_order(KEYS) == in_order(reversed(KEYS)) != KEYS
    assert in_order(KEYS, 1) != in_order(KEYS)
    without = in_order(KEYS[1:])
    assert [key for key in in_order(KEYS) if key != KEYS[0]] == without


def test_each_key_is_in_one_share_whatever_others_there_are() -> None:
    shares = [share_of(KEYS, number, 20) for number in range(1, 21)]
    assert sorted(key for part in shares for key in part) == sorted(KEYS)
    assert all(25 <= len(part) <= 80 for part in shares)
    assert share_of(KEYS[:500], 3, 20) == [key for key in shares[2] if key in KEYS[:500]]


@pytest.mark.parametrize("text", ["0/5", "6/5", "1", "a/b", "1/0", "-1/5"])
def test_a_share_that_is_none_is_refused(text: str) -> None:
    assert share("3/20") == (3, 20)
    with pytest.raises(Exception, match="give a part of all"):
        share(text)


@pytest.mark.parametrize(
    ("before", "after", "lengths_alone"),
    [
        ("for a, b in zip(c, d, strict=True):", "for a, b in zip(c, d, strict=False):", True),
        ("for a, b in zip(c, d, strict=True):", "for a, b in zip(c, d, ):", True),
        ("for a, b in zip(c.items(), d, strict=False):", "for a, b in zip(c.items(), d, ):", True),
        ("for a, b in zip(c.items(), d, strict=False):", "for a, b in zip(c.items(), strict=False):", False),
        (
            "x = sum(a * b for a, b in zip(c, d, strict=True))",
            "x = sum(a / b for a, b in zip(c, d, strict=True))",
            False,
        ),
        ("for a, b in zip(c, d, strict=True):", "for a, b in zip(c, None, strict=True):", False),
        ("a = load(b, strict=True)", "a = load(b, strict=False)", False),
        ("a = b", "a = None", False),
    ],
)
def test_whether_lengths_are_checked_is_no_change(before: str, after: str, lengths_alone: bool) -> None:
    assert is_about_equal_lengths((f"- {before}", f"+ {after}")) is lengths_alone


def test_a_room_has_its_files_and_the_tests_that_there_are(tree: Path) -> None:
    assert files_of(ROOMS["service"], tree) == ["twostage_servo/service/loop.py"]
    assert files_of(ROOMS["service"], tree, ["port.py"]) == []
    assert files_of(ROOMS["client"], tree) == ["twostage_servo/client/verbs.py"]
    assert paths_of_tests(ROOMS["service"], tree) == ["tests/service"]
    assert paths_of_tests(Room((), ("tests/none",)), tree) == []


def test_each_room_of_this_tree_has_files_and_tests() -> None:
    for room in ROOMS.values():
        assert files_of(room, TREE)
        assert paths_of_tests(room, TREE)


# How long a test may take ---------------------------------------------------------------------------------------------


def test_a_test_may_take_a_multiple_of_what_it_took_unmutated() -> None:
    assert allowed_s({"slow": 2.0, "quick": 0.01}, "slow") == TIMES * 2.0
    assert allowed_s({"slow": 2.0, "quick": 0.01}, "quick") == LEAST_CPU_S
    assert allowed_s({}, "unknown") == OTHERWISE_CPU_S


# What is kept ---------------------------------------------------------------------------------------------------------


def kept(tree: Path) -> KeptResults:
    sources = [mutant().path] if (tree / mutant().path).exists() else []
    return KeptResults.of(tree / "kept.jsonl", tree, sources, ["tests/service"])


def test_a_verdict_counts_until_its_file_changes(tree: Path) -> None:
    assert kept(tree).load() == {}
    kept(tree).keep(mutant())
    assert kept(tree).load() == {mutant().key: "killed"}
    (tree / "tests/service/test_loop.py").write_text("a = 2\n")
    assert kept(tree).load() == {mutant().key: "killed"}
    (tree / "twostage_servo/service/loop.py").write_text("a = 2\n")
    assert kept(tree).load() == {}


def test_a_survivor_counts_until_the_tests_change(tree: Path) -> None:
    kept(tree).keep(mutant(status="survived"))
    assert kept(tree).load() == {mutant().key: "survived"}
    (tree / "tests/service/test_more.py").write_text("a = 2\n")
    assert kept(tree).load() == {}
    kept(tree).keep(mutant())
    assert kept(tree).load() == {mutant().key: "killed"}


def test_a_survivor_of_earlier_tests_counts_where_nothing_shall_be_tried_again(tree: Path) -> None:
    kept(tree).keep(mutant(status="survived"))
    (tree / "tests/service/test_more.py").write_text("a = 2\n")
    assert kept(tree).load(settled=True) == {mutant().key: "survived"}
    (tree / "twostage_servo/service/loop.py").write_text("a = 2\n")
    assert kept(tree).load(settled=True) == {}


def test_the_last_verdict_of_a_mutant_is_the_one_that_counts(tree: Path) -> None:
    for status in ("killed", "survived"):
        kept(tree).keep(mutant(status=status))
    assert kept(tree).load() == {mutant().key: "survived"}


def test_a_file_that_is_gone_has_no_verdict(tree: Path) -> None:
    kept(tree).keep(mutant())
    (tree / "twostage_servo/service/loop.py").unlink()
    assert kept(tree).load() == {}


def test_nothing_is_kept_without_a_file(tree: Path) -> None:
    nowhere = KeptResults.of(None, tree, [mutant().path], ["tests/service"])
    nowhere.keep(mutant())
    assert nowhere.load() == {}


def test_a_digest_is_of_names_and_contents(tree: Path) -> None:
    before = digest(tree, ["tests", "twostage_servo/client/verbs.py"])
    assert before == digest(tree, ["twostage_servo/client/verbs.py", "tests"])
    (tree / "tests/service/test_loop.py").rename(tree / "tests/service/test_other.py")
    assert digest(tree, ["tests", "twostage_servo/client/verbs.py"]) != before


# What is said ---------------------------------------------------------------------------------------------------------


def test_what_was_not_tried_any_more_counts_neither_way() -> None:
    every = [mutant("f"), mutant("g", "survived"), mutant("h", "timeout"), with_status(mutant("i"), "open")]
    summary = summarise(every, {every[1].key: "equivalent"}, [every[1].key], 1.0)
    assert (summary["mutants"], summary["found"], summary["open"]) == (3, 2, 1)
    assert summary["score"] == pytest.approx(2 / 3)
    assert summary["survivors"] == [{"key": every[1].key, "reason": "equivalent"}]
    assert summary["reasons_without_mutant"] == []


def test_of_those_with_a_reason_only_as_many_count_as_stand_among_those_that_were_tried() -> None:
    """All of them counted as not found, however few of the others there was time for."""
    order = in_order([mutant(f"f{number}").key for number in range(20)], 3)
    tried, explained = order[:9], {order[4]: "equivalent", order[15]: "equivalent"}
    by_key = {mutant(f"f{number}").key: mutant(f"f{number}") for number in range(20)}

    def status(key: str) -> str:
        return "survived" if key in explained else "killed" if key in tried else "open"

    every = [with_status(by_key[key], status(key)) for key in sorted(by_key)]
    summary = summarise(as_far_as_tried(every, explained, 3), explained, list(explained), 1.0)
    assert (summary["mutants"], summary["found"], summary["open"]) == (9, 8, 11)
    assert summary["reasons_without_mutant"] == []  # one that was not looked at may still be needed
    whole = [with_status(one, "survived" if one.key in explained else "killed") for one in every]
    assert as_far_as_tried(whole, explained, 3) == whole
    nothing_tried = [with_status(one, "survived" if one.key in explained else "open") for one in every]
    assert summarise(as_far_as_tried(nothing_tried, explained, 3), explained, [], 1.0)["mutants"] == 0


def test_what_survived_and_has_a_reason_by_now_is_not_counted_again(tmp_path: Path) -> None:
    again = tmp_path / "again.json"
    again.write_text(json.dumps({"survivors": [{"key": "explained"}, {"key": "left"}]}))
    options = arguments().parse_args(["axis", "--again", str(again)])
    assert make_plan(options, {"explained": "equivalent"}, {})["only"] == ["left"]
    options.all = True
    assert make_plan(options, {"explained": "equivalent"}, {})["only"] == ["explained", "left"]


def test_a_plan_takes_what_was_kept_and_what_has_a_reason_for_known(tmp_path: Path) -> None:
    again = tmp_path / "again.json"
    again.write_text(json.dumps({"survivors": [{"key": "k"}]}))

    class Options:
        all, seconds, minutes, sample, share, seed = False, 20.0, 2.0, 150, (1, 3), 7
        again: Path | None = None

    options = Options()
    plan = make_plan(options, {"a": "equivalent"}, {"b": "killed"})  # type: ignore[arg-type]
    assert plan["known"] == {"a": "survived", "b": "killed"}
    assert (plan["most_s"], plan["sample"], plan["share"], plan["seed"], plan["only"]) == (120.0, 150, (1, 3), 7, None)
    options.all, options.again = True, again
    plan = make_plan(options, {"a": "equivalent"}, {})  # type: ignore[arg-type]
    assert (plan["known"], plan["only"]) == ({}, ["k"])


# Which tests a mutant is tried with -----------------------------------------------------------------------------------


@pytest.fixture
def counted(tmp_path: Path) -> Path:
    """A tree with a module, two files of tests, and what they share."""
    files = {
        "twostage_servo/__init__.py": "",
        "twostage_servo/counter.py": "\n".join(
            [
                "class Counter:",
                "    def up(self): return (lambda: one() + 1)()",
                "def one(): return 1",
                "def two(): return 2",
                "def never(): return 3",
                "TWO = two()",
            ]
        ),
        "tests/__init__.py": "",
        "tests/test_counter.py": "from twostage_servo.counter import Counter\n"
        "def test_up(): assert Counter().up() == 2\n",
        "tests/test_more.py": "import threading\nfrom twostage_servo import counter\ndef test_thread():\n"
        "    thread = threading.Thread(target=counter.one)\n    thread.start()\n    thread.join()\n",
        "pyproject.toml": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def learn(tree: Path) -> KeptReach:
    kept = KeptReach(tree / "reach.json", tree, ["tests"])
    before = {file: file.read_text() for file in (tree / "twostage_servo").glob("*.py")}
    let_functions_tell(tree)
    options = ["-q", "-p", "tools.mutation.reach", "-p", "no:cacheprovider"]
    command = [sys.executable, "-m", "pytest", *options, *kept.unknown()]
    environ = environment(tree, tree / "none") | {OUTPUT: str(tree / "found.json")}
    subprocess.run(command, cwd=tree, env=environ, check=True, capture_output=True)  # noqa: S603 - fixed
    for file, text in before.items():
        file.write_text(text)
    kept.add(json.loads((tree / "found.json").read_text()))
    return kept


def test_it_is_known_which_functions_a_test_calls_in_any_thread_and_which_its_import_does(counted: Path) -> None:
    reach = learn(counted).reach()
    module, up, thread = (
        "twostage_servo/counter.py",
        "tests/test_counter.py::test_up",
        "tests/test_more.py::test_thread",
    )
    assert reach.tests[f"{module}:Counter.up"] == [up]
    assert reach.tests[f"{module}:one"] == [up, thread]
    assert f"{module}:never" not in reach.tests
    assert f"{module}:two" in reach.at_import
    assert set(reach.took_s) == {up, thread}


def test_a_process_that_a_test_starts_tells_nobody(counted: Path) -> None:
    let_functions_tell(counted)
    script = "from twostage_servo.counter import Counter; print(Counter().up())"
    environ = environment(counted, counted / "none")
    done = subprocess.run(  # noqa: S603 - fixed
        [sys.executable, "-c", script], cwd=counted, env=environ, check=True, capture_output=True
    )
    assert done.stdout == b"2\n"


def test_only_files_of_tests_that_have_changed_are_run_unmutated_again(counted: Path) -> None:
    learn(counted)

    def unknown() -> list[str]:
        return KeptReach(counted / "reach.json", counted, ["tests"]).unknown()

    assert unknown() == []
    (counted / "tests/test_more.py").write_text("def test_nothing(): pass\n")
    assert unknown() == ["tests/test_more.py"]
    (counted / "twostage_servo/counter.py").write_text("def one(): return 1\n")
    assert unknown() == ["tests/test_counter.py", "tests/test_more.py"]


def test_the_tests_that_bear_the_name_go_first_then_the_quickest_as_long_as_there_is_time() -> None:
    named, quick, slow, other = "t/test_authority.py::a", "t/test_x.py::b", "t/test_x.py::c", "t/test_x.py::d"
    took_s = {named: 3.0, quick: 1.0, slow: 5.0, other: 0.1}
    calls = {"service/authority.py:preempt": [slow, quick, named], "service/authority.py:f": [quick]}
    reach = Reach(took_s, calls, frozenset())
    assert reach.chosen("service/authority.py", "preempt", 100.0) == [named, quick, slow]
    assert reach.chosen("service/authority.py", "preempt", 4.5) == [named, quick]
    assert reach.chosen("service/authority.py", "preempt", 0.0) == [named]
    calls["service/loop.py:f"] = [slow, named, "t/test_loop.py::e", other]
    took_s["t/test_loop.py::e"] = 9.0
    importing = Reach(took_s, calls, frozenset(), {"t/test_x.py": ["service.loop"]})
    assert importing.chosen("service/loop.py", "f", 100.0) == ["t/test_loop.py::e", other, slow, named]
    constant = importing.chosen("service/loop.py", "", 100.0)  # those that import it as well: they may read it
    assert constant == ["t/test_loop.py::e", other, quick, slow, named]
    assert reach.chosen("service/authority.py", "", 100.0) == [
        named,
        quick,
        slow,
    ]  # outside functions: all of the file's
    assert reach.chosen("service/authority.py", "in_another_process", 100.0) == [named, quick, slow]


def test_each_reason_is_about_code_that_is_there() -> None:
    """The line that a mutant changes stands in its module; signs between the lines of a change are in lines as well."""
    gone = []
    for key in reasons():
        module, _, change = key.split(":", 2)
        path = PACKAGE / f"{module.replace('.', '/')}.py"
        source = " ".join(path.read_text(encoding="utf-8").split()) if path.exists() else ""
        removed = " ".join(change.split()).removeprefix("- ")
        ends = [at.start() for at in re.finditer(r" [-+] ", removed)]
        if not any(removed[:end] in source for end in ends):
            gone.append(key)
    assert gone == []
