"""What pydantic finds wrong with a configuration, for the operator: file, line, key, value, what would be right."""

import difflib

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from twostage_servo.config.document import Document
from twostage_servo.config.errors import Problem
from twostage_servo.config.toml_lines import Path
from twostage_servo.settings.base import Settings
from twostage_servo.settings.reference import Located, describe, fields_of, locate, row, table_of
from twostage_servo.settings.toml_text import key_text

_LONGEST_KEY_LIST = 24
_MOST_PROBLEMS = 100


def validation_problems(error: ValidationError, document: Document, model: type[Settings]) -> list[Problem]:
    """Turn pydantic's errors into problems, one for each key, in the file's order, those of arguments last."""
    by_path: dict[Path, str] = {}
    errors = error.errors(include_url=False)
    for details in errors[:_MOST_PROBLEMS]:
        located = locate(model, details["loc"])
        path = details["loc"] if details["type"] == "extra_forbidden" else located.path
        # The members of a union complain one by one; the first stands for all, unless a validator has words of its own.
        if path not in by_path or details["type"] == "value_error":
            by_path[path] = _message(details, located, model)
    problems = [document.problem(path, message) for path, message in by_path.items()]
    last = float("inf")
    problems.sort(key=lambda problem: last if problem.line is None else problem.line)
    if len(errors) > _MOST_PROBLEMS:
        more = f"and {len(errors) - _MOST_PROBLEMS} more; check that this is a configuration of twostage-servo"
        problems.append(Problem(document.file, None, "", None, more))
    return problems


def _message(details: ErrorDetails, located: Located, model: type[Settings]) -> str:
    kind = details["type"]
    table = table_of(located.annotation)
    if kind == "extra_forbidden":
        return _unknown_key_message(details["loc"], located, model)
    if kind in ("value_error", "assertion_error"):
        return str(details["ctx"]["error"])
    if kind == "missing":
        if table is None:
            return f"is missing; {row(located).needed}"
        required = ", ".join(setting.key for setting in describe(table) if setting.default is None)
        return f"the table is missing ({row(located).description}); required keys: {required}"
    if kind == "finite_number":
        return f"is not finite; {row(located).needed}"
    return row(located).needed


def _unknown_key_message(path: Path, located: Located, model: type[Settings]) -> str:
    table = table_of(located.annotation)
    names = list(fields_of(table)) if table is not None else []
    unknown = str(path[-1])
    near = [key_text((*located.path, name)) for name in difflib.get_close_matches(unknown, names, n=3)]
    elsewhere = [setting.key for setting in describe(model) if setting.key.rpartition(".")[2] == unknown]
    guess = f"; did you mean {' or '.join(near or elsewhere[:3])}?" if near or elsewhere else ""
    place = f"[{key_text(located.path)}]" if located.path else "the file"
    known = f"; keys of {place}: {', '.join(names)}" if len(names) <= _LONGEST_KEY_LIST else ""
    return f"unknown key{guess}{known}"
