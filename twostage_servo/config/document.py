"""Keys and values after all overrides, and where each of them came from."""

import copy
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, NoReturn

from twostage_servo.config.errors import ConfigError, Problem
from twostage_servo.config.toml_file import TomlFile
from twostage_servo.config.toml_lines import Path, split_key
from twostage_servo.settings.toml_text import key_text, value_text


class Override(NamedTuple):
    """One ``--set KEY=VALUE``; `named` is its path as it was given, `path` the same under present names."""

    argument: str
    path: Path
    value: object
    named: Path


@dataclass(frozen=True, slots=True)
class Document:
    """What is to be validated, and where each key stands.

    Parameters
    ----------
    file
        The file as it was named.
    data
        Keys and values, those of the arguments in place of the file's.
    lines
        Line of each key in the file.
    overrides
        The arguments, in their order.
    """

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


def overridden(
    file: TomlFile, arguments: Sequence[str], present: Callable[[tuple[str, ...]], tuple[str, ...]]
) -> tuple[Document, list[Problem]]:
    """Put arguments over a file.

    Parameters
    ----------
    file
        The file, which stays as it is.
    arguments
        ``KEY=VALUE``: a dotted key; a value in TOML notation, or a bare word, which is a text.
    present
        Gives a path its present name.

    Returns
    -------
    tuple
        The document, and what is wrong with those arguments that are left out of it.
    """
    data = copy.deepcopy(file.data) if arguments else file.data
    accepted: list[Override] = []
    problems: list[Problem] = []
    for argument in arguments:
        try:
            accepted.append(_apply(data, argument, present))
        except ConfigError as error:
            problems += error.problems
    return Document(file.source, data, file.lines, accepted), problems


def _refuse(argument: str, message: str, key: str = "") -> NoReturn:
    raise ConfigError([Problem(argument, None, key, None, message)]) from None


def _apply(data: dict[str, Any], override: str, present: Callable[[tuple[str, ...]], tuple[str, ...]]) -> Override:
    argument = f"--set {override if override.isprintable() else ascii(override)}"
    key, equals, text = (part.strip() for part in override.partition("="))
    if not equals or not key:
        _refuse(argument, "is not KEY=VALUE, such as simulation.gain=234")
    if not override.isprintable():
        _refuse(argument, "contains unprintable characters; a value is plain text on one line")
    try:
        named = split_key(key)
    except (ValueError, RecursionError):
        _refuse(argument, "is not a dotted key, such as simulation.gain", key=key)
    path = present(named)
    value = _override_value(argument, path, text)
    table = data
    for depth, part in enumerate(path[:-1], start=1):
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            _refuse(argument, f"{key_text(path[:depth])} is not a table and has no keys", key=key_text(path))
    table[path[-1]] = value
    return Override(argument, path, value, named)


def _override_value(argument: str, path: Path, text: str) -> object:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError) as error:
        if text and text[0] not in "\"'[{#":
            return text
        reason = str(error).partition(" (at ")[0]
        notation = 'write a value as in TOML: 1.5, true, "mm", [1, 2], ""'
        _refuse(argument, f"{reason}; {notation}", key=key_text(path))
