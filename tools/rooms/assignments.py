"""Find where the attribute of an object is set from outside: ``python -m tools.rooms.assignments``; exit code 1 if any.

An object is complete after ``__init__``: what changes in it, its own methods change. An assignment to ``x.name`` counts
unless ``x`` is ``self`` or ``cls``, and so does ``setattr``. Two kinds are left out, by the name alone:

- a field of a data class that is not frozen: such a class is a record, and whoever owns one writes it;
- a name that no class of the package has: the object belongs to a library. So does what is reached through a module of
  the standard library.
"""

import ast
import sys
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final, NamedTuple

from tools.rooms.imports import PACKAGE

_OWN: Final = ("self", "cls")
_OF_LIBRARIES: Final = {("simulation/bus.py", "copied.data")}  # a message of python-can, whose copy shares its bytes


class Assignment(NamedTuple):
    """An assignment from outside: in which file, at which line, and what is set."""

    file: str
    line: int
    text: str


def assignments(package: Path) -> list[Assignment]:
    """Return those of a package, in the order of files and lines."""
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(package.rglob("*.py"))}
    classes = [node for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    ours = {name for one in classes for name in _attributes(one)}
    records = {name for one in classes if _is_record(one) for name in _fields(one)}
    found = []
    for path, tree in trees.items():
        file, modules = path.relative_to(package), set(_standard_modules(tree))
        for node in ast.walk(tree):
            for target, name in _set_from_outside(node, modules):
                one = Assignment(str(file), target.lineno, ast.unparse(target))
                if (name is None or name in ours - records) and (one.file, one.text) not in _OF_LIBRARIES:
                    found.append(one)
    return sorted(set(found))


def _standard_modules(tree: ast.Module) -> Iterator[str]:
    """Yield the names under which a file imports modules of the standard library."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for one in node.names:
                if one.name.partition(".")[0] in sys.stdlib_module_names:
                    yield one.asname or one.name.partition(".")[0]


def _set_from_outside(node: ast.AST, modules: Collection[str]) -> Iterator[tuple[ast.expr, str | None]]:
    """Yield what a statement sets from outside, with the attribute's name; None if only a run tells it."""
    if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store | ast.Del):
        if not (isinstance(node.value, ast.Name) and node.value.id in _OWN) and _root(node) not in modules:
            yield node, node.attr
    elif isinstance(node, ast.Call):
        called = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        if called in {"setattr", "delattr", "__setattr__"} and len(node.args) > 1:
            changed, name = node.args[:2]
            if not (isinstance(changed, ast.Name) and changed.id in _OWN) and _root(changed) not in modules:
                yield node, str(name.value) if isinstance(name, ast.Constant) else None


def _root(node: ast.expr) -> str:
    """Return the name that an attribute is reached through."""
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def _is_record(node: ast.ClassDef) -> bool:
    for decorator in node.decorator_list:
        call = decorator if isinstance(decorator, ast.Call) else None
        name = decorator if call is None else call.func
        if isinstance(name, ast.Name) and name.id == "dataclass":
            return not any(one.arg == "frozen" for one in call.keywords) if call is not None else True
    return False


def _fields(node: ast.ClassDef) -> Iterator[str]:
    for one in node.body:
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
            yield one.target.id


def _attributes(node: ast.ClassDef) -> Iterator[str]:
    """Yield the fields of a class, and what its methods set on ``self``; properties, which may have a setter, too."""
    yield from _fields(node)
    for one in ast.walk(node):
        if isinstance(one, ast.Attribute) and isinstance(one.ctx, ast.Store):
            if isinstance(one.value, ast.Name) and one.value.id in _OWN:
                yield one.attr
        elif isinstance(one, ast.FunctionDef) and one.decorator_list:
            yield one.name


def main() -> int:
    """Print what is found."""
    found = assignments(PACKAGE)
    for one in found:
        print(f"{PACKAGE.name}/{one.file}:{one.line}: {one.text} is set from outside: let its own class set it")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
