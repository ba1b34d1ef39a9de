"""What is wrong with a configuration, for the operator: file, line, key, value, and what would be right."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from twostage_servo.config.toml_lines import Path
from twostage_servo.settings.base import Settings
from twostage_servo.settings.reference import Located, describe, key_text, locate, row, table_of, value_text

_LONGEST_KEY_LIST = 24
_MOST_PROBLEMS = 100


class Problem(NamedTuple):
    """One thing that is wrong with a configuration.

    Parameters
    ----------
    file
        The file as it was named, or the argument (``--set simulation.gian=3``) that the problem comes from.
    line
        Line in the file from 1; None if there is none to name.
    key
        Dotted key; empty if the problem is the file's.
    value
        The value in TOML notation; None if there is none to show.
    message
        What is wrong and what would be right.
    """

    file: str
    line: int | None
    key: str
    value: str | None
    message: str

    def __str__(self) -> str:
        """Write the problem as one block: place, key, value, message."""
        place = self.file if self.line is None else f"{self.file}:{self.line}"
        key = self.key if self.value is None else f"{self.key} = {self.value}"
        text = ": ".join(filter(None, (place, key, self.message)))
        # Bytes of an argument or a file name that are not UTF-8 must not stop the report on its way to a terminal.
        return text.encode("utf-8", "backslashreplace").decode()


class ConfigError(ValueError):
    """The configuration cannot be used; ``problems`` holds everything that is wrong with it, in the file's order."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


class Override(NamedTuple):
    """One ``--set KEY=VALUE``."""

    argument: str
    path: Path
    value: object


@dataclass(frozen=True, slots=True)
class Document:
    """Keys and values after all overrides, and where each of them came from."""

    file: str
    data: Mapping[str, Any]
    lines: Mapping[Path, int]
    overrides: Sequence[Override] = ()

    def problem(self, path: Path, message: str) -> Problem:
        """Name the line or the argument that set a key, or the nearest table around a key that is not there."""
        file, line = self._place(path)
        value = self._value(path)
        if isinstance(value, Mapping) and line is not None:
            within = [override.argument for override in self.overrides if override.path[: len(path)] == path]
            message += f" (with {', '.join(within)})" if within else ""
        text = None if value is None or isinstance(value, Mapping) else value_text(value)
        return Problem(file, line, key_text(path), text, message)

    def _place(self, path: Path) -> tuple[str, int | None]:
        for override in reversed(self.overrides):
            if path[: len(override.path)] == override.path:
                return override.argument, None
        if path not in self.lines:
            for override in self.overrides:
                if override.path[: len(path)] == path and path:
                    return override.argument, None
        ancestors = (path[:length] for length in range(len(path), 0, -1))
        return self.file, next((self.lines[ancestor] for ancestor in ancestors if ancestor in self.lines), None)

    def _value(self, path: Path) -> Any:
        value: Any = self.data
        for part in path:
            known = range(len(value)) if isinstance(value, list) else value if isinstance(value, Mapping) else ()
            if part not in known:
                return None
            value = value[part]
        return value


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
        more = f"and {len(errors) - _MOST_PROBLEMS} more; is this a configuration of twostage-servo?"
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
        return f"the table is missing ({row(located).description}); it needs the keys: {required}"
    if kind == "finite_number":
        return f"is not finite; {row(located).needed}"
    return row(located).needed


def _unknown_key_message(path: Path, located: Located, model: type[Settings]) -> str:
    table = table_of(located.annotation)
    names = list(table.model_fields) if table is not None else []
    unknown = str(path[-1])
    near = [key_text((*located.path, name)) for name in difflib.get_close_matches(unknown, names, n=3)]
    elsewhere = [setting.key for setting in describe(model) if setting.key.rpartition(".")[2] == unknown]
    guess = f"; did you mean {' or '.join(near or elsewhere[:3])}?" if near or elsewhere else ""
    place = f"[{key_text(located.path)}]" if located.path else "the file"
    known = f"; {place} knows: {', '.join(names)}" if len(names) <= _LONGEST_KEY_LIST else ""
    return f"unknown key{guess}{known}"
