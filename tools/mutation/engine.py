"""What mutmut does in the throw-away copy; started by :mod:`run` as a process of its own, in that copy.

``engine.py CORES PLAN RESULTS FILE...`` mutates the files, runs mutmut, and writes one JSON object a mutant to RESULTS.
PLAN is JSON: keys of mutants under ``known`` are taken as survived and not tried; ``only``, unless null, names the keys
to look at; with ``quick`` what survived has survived.

mutmut's own operators are used but for the strings, with three added: a comparison is negated, a condition is negated,
and an ``and`` or ``or`` loses either side. Places that mutmut leaves out are taken in. A property is written as an
assignment first, which mutmut can mutate. Numbers, signs and conditions outside functions, in constants and defaults,
are given out with status ``fresh``, for :mod:`mutation.run` to try in processes of their own; so is what survived or
had no tests, because mutmut forks after the import and does not see what a mutant changes at the import of a test.
"""

import dataclasses
import difflib
import importlib
import json
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

sys.path[0] = str(Path(__file__).resolve().parents[1])

from mutation.mutant import Mutant  # noqa: E402 - found by the path above

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
    owner = {}
    for statement in module.body:
        if isinstance(statement, cst.FunctionDef):
            owner[statement] = ("x_" + statement.name.value, statement.name.value)
        elif isinstance(statement, cst.ClassDef) and isinstance(statement.body, cst.IndentedBlock):
            name = statement.name.value
            for part in statement.body.body:
                if isinstance(part, cst.FunctionDef):
                    owner[part] = (f"xǁ{name}ǁ{part.name.value}", f"{name}.{part.name.value}")
                else:
                    owner[part] = (None, name)
    counts: dict[str, int] = {}
    for mutation in mutations:
        mangled, function = owner.get(mutation.contained_by_top_level_function, (None, ""))
        if mangled is None and not _is_of_interest_outside(mutation, module):
            continue
        name = None
        if mangled is not None:
            counts[mangled] = counts.get(mangled, 0) + 1
            name = f"{path[:-3].replace('/', '.')}.{mangled}__mutmut_{counts[mangled]}"
        yield name, Mutant(path, function, _changed_lines(mutation, module)), partial(_mutated, mutation, module)


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


def main(cores: int, plan: dict[str, Any], results: Path, paths: list[str]) -> None:
    """Mutate, run mutmut, and write what became of each mutant."""
    configure()
    for path in paths:
        file = Path(path)
        file.write_text(without_properties(file.read_text(encoding="utf-8")), encoding="utf-8")
    command: Any = importlib.import_module("mutmut.__main__")
    data: Any = importlib.import_module("mutmut.mutation.data")
    status_by_exit_code: Any = importlib.import_module("mutmut.stats").status_by_exit_code
    known, only = set(plan["known"] or ()), plan["only"]
    mutants = [entry for path in paths for entry in enumerated(path) if only is None or entry[1].key in only]
    names = [name for name, mutant, _ in mutants if name is not None and mutant.key not in known]
    if names:
        command._run(names, cores)  # noqa: SLF001 - what `mutmut run` calls, in a process that has been configured
    codes: dict[str, int] = {}
    for path in paths:
        one = data.SourceFileMutationData(path=path)
        one.load()
        codes |= one.exit_code_by_key
    with results.open("w", encoding="utf-8") as out:
        for name, mutant, source in mutants:
            status = "survived" if mutant.key in known else "fresh"
            sure = {"killed", "timeout", "survived"} if plan["quick"] else {"killed", "timeout"}
            if name is not None and status_by_exit_code[codes[name]] in sure:
                status = status_by_exit_code[codes[name]]
            entry = dataclasses.replace(mutant, status=status, source=source() if status == "fresh" else "")
            out.write(json.dumps(dataclasses.asdict(entry)) + "\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text(encoding="utf-8")), Path(sys.argv[3]), sys.argv[4:])
