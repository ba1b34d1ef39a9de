"""Keys that have had another name: accepted under it until 1.0, with a note that gives the present one.

The settings class of each table says which they are (:attr:`~twostage_servo.settings.base.Settings.renamed`).
"""

import copy
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from pydantic import BaseModel

from twostage_servo.config.document import Override
from twostage_servo.config.errors import ConfigError, Problem
from twostage_servo.config.toml_file import TomlFile
from twostage_servo.config.toml_lines import Path
from twostage_servo.settings.base import Settings
from twostage_servo.settings.reference import table_of
from twostage_servo.settings.toml_text import key_text


class PresentNames(NamedTuple):
    """A file whose keys have their present names, and a note of each that has had another one in it."""

    file: TomlFile
    notes: tuple[Problem, ...]


def under_present_names(model: type[BaseModel], file: TomlFile) -> PresentNames:
    """Give the keys of a file their present names.

    Raises
    ------
    ConfigError
        If a key stands there under both names.
    """
    data = copy.deepcopy(file.data)
    renamed = list(_rename(model, data, (), file))
    if not renamed:
        return PresentNames(file, ())
    lines = dict(file.lines)
    for former, present in renamed:
        inside = {path: line for path, line in lines.items() if path[: len(former)] == former}
        lines |= {(*present, *path[len(former) :]): line for path, line in inside.items()}
    notes = tuple(
        Problem(file.source, lines.get(former), key_text(former), None, _text(new)) for former, new in renamed
    )
    return PresentNames(file.with_keys(data, lines), notes)


def present_path(model: type[BaseModel], path: tuple[str, ...]) -> tuple[str, ...]:
    """Return a path with each part under its present name; parts that no settings class knows stay as they are."""
    parts: list[str] = []
    table: type[BaseModel] | None = model
    for part in path:
        name = _renamed(table).get(part, part)
        parts.append(name)
        field = None if table is None else table.model_fields.get(name)
        table = None if field is None else table_of(field.annotation)
    return tuple(parts)


def note_of(override: Override) -> Problem:
    """Return the note of an argument that has a former name."""
    return Problem(override.argument, None, key_text(override.named), None, _text(override.path))


def _text(present: Path) -> str:
    return f"is now called {key_text(present)}; the former name works until 1.0"


def _rename(model: type[BaseModel], data: dict[str, Any], path: Path, file: TomlFile) -> Iterator[tuple[Path, Path]]:
    """Rename in place, table by table; yield the former and the present path of each key that had a former name."""
    for former, present in _renamed(model).items():
        if former not in data:
            continue
        if present in data:
            line, old = file.lines.get((*path, present)), (*path, former)
            text = f"is the former name of {key_text((*path, present))}, which is also in line {line}; keep that one"
            raise ConfigError([Problem(file.source, file.lines.get(old), key_text(old), None, text)])
        data[present] = data.pop(former)
        yield (*path, former), (*path, present)
    for name, field in model.model_fields.items():
        table = table_of(field.annotation)
        if table is not None and isinstance(data.get(name), dict):
            yield from _rename(table, data[name], (*path, name), file)


def _renamed(model: type[BaseModel] | None) -> Mapping[str, str]:
    return model.renamed if model is not None and issubclass(model, Settings) else {}
