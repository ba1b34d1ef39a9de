"""What mutmut does in the throw-away copy; started by :mod:`run` as a process of its own, in that copy.

``CORES PLAN RESULTS FILE...``: mutates the files, runs mutmut, and writes one JSON object a mutant to RESULTS.
PLAN is JSON: what became of a mutant whose key is under ``known`` is taken from there, and it is not tried; ``only``,
unless null, names the keys to look at, ``sample`` how many of them, ``share`` which part, ``seed`` in which order; what
becomes of each is added to ``kept`` at once; after ``most_s`` seconds no other is begun. ``reach`` is
what :mod:`reach` found, and ``most_tests_s`` how long the tests of a mutant may take unmutated, all together.

mutmut's own operators are used but for the strings, with three added: a comparison is negated, a condition is negated,
and an ``and`` or ``or`` loses either side. Places that mutmut leaves out are taken in. A property is written as an
assignment first, which mutmut can mutate. Left out are protocols, which have no code, and ``strict=`` of a zip.

Numbers, signs and conditions outside functions, in constants and defaults, are given out with status ``fresh``, for
:mod:`tools.mutation.run` to try in processes of their own; so is what survived of a function that the import of the
tests calls: mutmut forks after it and does not see what a mutant changes there.
"""

import contextlib
import dataclasses
import difflib
import importlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from tools.mutation.mutant import Mutant, is_about_equal_lengths
from tools.mutation.reach import Reach
from tools.mutation.results import KeptResults, in_order, share_of

cst: Any = importlib.import_module("libcst")
file_mutation: Any = importlib.import_module("mutmut.mutation.file_mutation")
mutators: Any = importlib.import_module("mutmut.mutation.mutators")


def negated_comparison(node: Any) -> Iterator[Any]:
    """Turn ``a < b`` into ``not (a < b)``."""
    yield cst.UnaryOperation(cst.Not(), _in_parentheses(node), lpar=[cst.LeftParen()], rpar=[cst.RightParen()])


def negated_condition(node: Any) -> Iterator[Any]:
    """Negate the condition of an ``if`` or ``while`` that is neither a comparison nor negated already."""
    if isinstance(node.test, cst.Comparison | cst.UnaryOperation):
        return
    if isinstance(node.test, cst.Name) and node.test.value == "TYPE_CHECKING":
        return
    space = "whitespace_after_while" if isinstance(node, cst.While) else "whitespace_before_test"
    negated = cst.UnaryOperation(cst.Not(), _in_parentheses(node.test))
    yield node.with_changes(test=negated, **{space: cst.SimpleWhitespace(" ")})


def one_side(node: Any) -> Iterator[Any]:
    """Leave ``a`` or ``b`` of ``a and b``."""
    for side in (node.left, node.right):
        yield _in_parentheses(side)


def _in_parentheses(node: Any) -> Any:
    return node.with_changes(lpar=[cst.LeftParen(), *node.lpar], rpar=[*node.rpar, cst.RightParen()])


def configure() -> None:
    """Make mutmut leave out texts, and take in the operators of this module."""
    operators = [entry for entry in mutators.mutation_operators if entry[1] is not mutators.operator_string]
    mutators.mutation_operators[:] = [
        *operators,
        (cst.Comparison, negated_comparison),
        (cst.If, negated_condition),
        (cst.While, negated_condition),
        (cst.BooleanOperation, one_side),
    ]
    visitor = file_mutation.MutationVisitor
    skip = visitor._skip_node_and_children  # noqa: SLF001 - mutmut has no setting for it

    def skip_texts(self: Any, node: Any) -> bool:
        # An f-string or what a raise says is a text, whatever is computed inside it.
        return isinstance(node, cst.BaseString | cst.Raise) or bool(skip(self, node))

    visitor._skip_node_and_children = skip_texts  # noqa: SLF001


def without_properties(source: str) -> str:
    """Write ``@property def name`` as ``def name`` and ``name = property(name)``, which means the same."""

    class Rewrite(cst.CSTTransformer):  # type: ignore[misc]
        def leave_FunctionDef(self, original_node: Any, updated_node: Any) -> Any:  # noqa: ARG002, N802 - libcst's names
            names = [getattr(decorator.decorator, "value", None) for decorator in updated_node.decorators]
            if names != ["property"]:
                return updated_node
            name = updated_node.name.value
            after = cst.parse_statement(f"{name} = property({name})")
            return cst.FlattenSentinel([updated_node.with_changes(decorators=[]), after])

    return str(cst.parse_module(source).visit(Rewrite()).code)


def enumerated(path: str) -> Iterator[tuple[str | None, Mutant, Callable[[], str]]]:
    """Give each mutant of a file with mutmut's name for it, None outside functions, and what makes its whole source."""
    module, mutations, _, _ = file_mutation.create_mutations(path, Path(path).read_text(encoding="utf-8"))
    owner, declared = _owners(module)
    counts: dict[str, int] = {}
    for mutation in mutations:
        mangled, function = owner.get(mutation.contained_by_top_level_function, (None, ""))
        if mangled is None and not _is_of_interest_outside(mutation, module):
            continue
        name = None
        if mangled is not None:
            counts[mangled] = counts.get(mangled, 0) + 1
            name = f"{path[:-3].replace('/', '.')}.{mangled}__mutmut_{counts[mangled]}"
        lines = _changed_lines(mutation, module)
        if function in declared or is_about_equal_lengths(lines):
            continue
        yield name, Mutant(path, function, lines), partial(_mutated, mutation, module)


def _owners(module: Any) -> tuple[dict[Any, tuple[str | None, str]], set[str]]:
    """Return mutmut's name and ours for each part of a module, and the functions that protocols declare."""
    owner: dict[Any, tuple[str | None, str]] = {}
    declared = set()
    for statement in module.body:
        if isinstance(statement, cst.FunctionDef):
            owner[statement] = ("x_" + statement.name.value, statement.name.value)
        elif isinstance(statement, cst.ClassDef) and isinstance(statement.body, cst.IndentedBlock):
            name = statement.name.value
            is_protocol = any(getattr(base.value, "value", None) == "Protocol" for base in statement.bases)
            for part in statement.body.body:
                if not isinstance(part, cst.FunctionDef):
                    owner[part] = (None, name)
                    continue
                owner[part] = (f"xǁ{name}ǁ{part.name.value}", f"{name}.{part.name.value}")
                if is_protocol:
                    declared.add(f"{name}.{part.name.value}")
    return owner, declared


def _mutated(mutation: Any, module: Any) -> str:
    return str(file_mutation.deep_replace(module, mutation.original_node, mutation.mutated_node).code)


def _changed_lines(mutation: Any, module: Any) -> tuple[str, ...]:
    part = mutation.contained_by_top_level_function or module
    changed = file_mutation.deep_replace(part, mutation.original_node, mutation.mutated_node)
    before, after = (module.code_for_node(node).splitlines() for node in (part, changed))
    lines = list(difflib.unified_diff(before, after, n=0, lineterm=""))[2:]
    return tuple(line[0] + " " + line[1:].strip() for line in lines if not line.startswith("@@"))


def _is_of_interest_outside(mutation: Any, module: Any) -> bool:
    """Whether a change outside functions is one of a value: not of what engine wrote itself, nor None for a constant.

    A constant of None or a call without an argument mostly fails at the import, which says nothing of a test.
    """
    if isinstance(mutation.mutated_node, cst.Call | cst.Assign | cst.AnnAssign):
        return False
    node = mutation.contained_by_top_level_function or mutation.original_node
    return "property(" not in str(module.code_for_node(node))


def use_reach(command: Any, chosen: dict[str, list[str]], reach: Reach) -> None:
    """Let mutmut run the tests that were chosen for each function, in that order, instead of finding out by itself."""

    def fill(*_arguments: Any, **_options: Any) -> None:
        state: Any = importlib.import_module("mutmut.state").state()
        state.duration_by_test.update(reach.took_s)
        for function, tests in chosen.items():
            state.tests_by_mangled_function_name[function] = tests

    command.collect_or_load_stats = fill
    runner = importlib.import_module("mutmut.runners.harness").PytestRunner
    run = runner.run_tests

    def in_order(self: Any, *, mutant_name: str | None, tests: Any) -> int:
        known = chosen.get((mutant_name or "").rpartition("__mutmut_")[0])
        return int(run(self, mutant_name=mutant_name, tests=tests if known is None else known))

    runner.run_tests = in_order
    isolation: Any = importlib.import_module("mutmut.workers.isolation")
    isolation.ForkRunner.run_clean_tests = lambda self, tests: leave_out_failing(
        self.test_runner, sorted(tests), chosen
    )
    isolation.register_timeout = stop_after


def leave_out_failing(runner: Any, tests: list[str], chosen: dict[str, list[str]]) -> int:
    """Run tests on mutmut's form of the code, unmutated, and leave out those that fail: what they would say is void.

    Such a test looks at a function itself, as at its defaults, instead of calling it.
    """
    failing = set()

    class Failing:
        @staticmethod
        def pytest_runtest_logreport(report: Any) -> None:
            if report.failed:
                failing.add(report.nodeid)

    with contextlib.chdir("mutants"):
        code = int(runner.execute_pytest(["-q", *tests], plugins=[Failing()]))
    for of_function in chosen.values():
        of_function[:] = [test for test in of_function if test not in failing]
    for test in sorted(failing):
        sys.__stderr__.write(f"\nleft out, it fails on code that is prepared for mutants: {test}\n")  # type: ignore[union-attr]
    return 0 if code <= 1 else code


def stop_after(pid: int, timeout_s: float) -> None:
    """End a child after a time, if it is still one: mutmut ends whoever has its number by then."""

    def stop() -> None:
        try:
            if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
                os.kill(pid, signal.SIGXCPU)
        except ChildProcessError:  # it has ended, as most do
            return

    timer = threading.Timer(timeout_s, stop)
    timer.daemon = True
    timer.start()


def report_each(command: Any, mutants: dict[str, Mutant], plan: dict[str, Any], reach: Reach) -> None:
    """Let mutmut write what becomes of each mutant as it is known, and end when the time is over."""
    register = command._register_mutant_result  # noqa: SLF001 - mutmut has no hook for it
    began_s, kept = time.monotonic(), KeptResults(**plan["kept"])

    def report(result: Any, data: Any) -> None:
        register(result, data)
        mutant = mutants[result.mutant_name]
        mutant = dataclasses.replace(mutant, status=status_of(result.exit_code, mutant, reach))
        kept.keep(mutant)
        if plan["most_s"] is not None and time.monotonic() - began_s > plan["most_s"]:
            raise KeyboardInterrupt

    command._register_mutant_result = report  # noqa: SLF001 - likewise


def status_of(code: int | None, mutant: Mutant, reach: Reach) -> str:
    """Return what an exit code of mutmut's says of a mutant, or that a process of its own has to tell."""
    if code is None:
        return "open"
    status = str(importlib.import_module("mutmut.stats").status_by_exit_code[code])
    if status in {"killed", "timeout"}:
        return status
    return "fresh" if status != "survived" or mutant.called in reach.at_import else "survived"


def main(cores: int, plan: dict[str, Any], results: Path, paths: list[str]) -> None:
    """Mutate, run mutmut, and write what became of each mutant."""
    configure()
    for path in paths:
        file = Path(path)
        file.write_text(without_properties(file.read_text(encoding="utf-8")), encoding="utf-8")
    command: Any = importlib.import_module("mutmut.__main__")
    data: Any = importlib.import_module("mutmut.mutation.data")
    every = [entry for path in paths for entry in enumerated(path)]
    chosen = set(chosen_keys([mutant.key for _, mutant, _ in every], plan))
    mutants = [entry for entry in every if entry[1].key in chosen]
    named = {name: mutant for name, mutant, _ in mutants if name is not None and mutant.key not in plan["known"]}
    reach = Reach(**plan["reach"] | {"at_import": frozenset(plan["reach"]["at_import"])})
    most_s = plan["most_tests_s"]
    if named and plan["most_s"] != 0.0:
        tests = {
            name.rpartition("__mutmut_")[0]: reach.chosen(mutant.path, mutant.function, most_s)
            for name, mutant in named.items()
        }
        use_reach(command, tests, reach)
        report_each(command, named, plan, reach)
        places = {key: place for place, key in enumerate(in_order(chosen, plan["seed"]))}  # mutmut: the quickest first
        command.estimated_worst_case_time = lambda name: places[named[name].key]
        command._run(list(named), cores)  # noqa: SLF001 - what `mutmut run` calls, in a process that has been configured
    codes: dict[str, int | None] = {}
    for path in paths:
        one = data.SourceFileMutationData(path=path)
        one.load()
        codes |= one.exit_code_by_key
    codes = dict.fromkeys(named) | codes
    with results.open("w", encoding="utf-8") as out:
        for name, mutant, source in mutants:
            status = plan["known"].get(mutant.key) or (
                "fresh" if name is None else status_of(codes[name], mutant, reach)
            )
            fresh = status == "fresh"
            entry = dataclasses.replace(
                mutant,
                status=status,
                source=source() if fresh else "",
                tests=tuple(reach.chosen(mutant.path, mutant.function, most_s)) if fresh else (),
            )
            out.write(json.dumps(dataclasses.asdict(entry)) + "\n")


def chosen_keys(keys: list[str], plan: dict[str, Any]) -> list[str]:
    """Return the keys that a plan looks at, of all that there are."""
    chosen = in_order(keys if plan["only"] is None else set(keys) & set(plan["only"]), plan["seed"])
    if plan["share"] is not None:
        chosen = share_of(chosen, *plan["share"])
    return chosen if plan["sample"] is None else chosen[: plan["sample"]]


if __name__ == "__main__":
    main(int(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text(encoding="utf-8")), Path(sys.argv[3]), sys.argv[4:])
