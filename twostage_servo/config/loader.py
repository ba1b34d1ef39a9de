"""The configuration: one TOML file and ``--set`` arguments become the rooms' settings.

The settings themselves, with units and bounds, are declared in the room that uses them.
"""

import codecs
import importlib.resources
import os
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, NoReturn, TypeVar

from pydantic import Field, ValidationError

from twostage_servo.axis.settings import AxisSettings
from twostage_servo.canbus.link import BusSettings
from twostage_servo.config import toml_lines
from twostage_servo.config.problems import ConfigError, Document, Override, Problem, validation_problems
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.host.settings import RealtimeSettings
from twostage_servo.service.settings import ServiceSettings
from twostage_servo.settings.base import Settings
from twostage_servo.settings.reference import describe, key_text
from twostage_servo.simulation.settings import SimulationSettings

__all__ = ["Config", "ConfigError", "LoadedConfig", "Problem", "describe", "load", "load_as"]

LARGEST_FILE_BYTES = 1_000_000
_LONGEST_SOURCE_LINE = 100

ModelT = TypeVar("ModelT", bound=Settings)


class Config(Settings):
    """The whole configuration file."""

    service: ServiceSettings = Field(ServiceSettings(), description="The tick and what runs beside it")
    realtime: RealtimeSettings = Field(RealtimeSettings(), description="What the service asks of its host")
    bus: BusSettings = Field(description="The CAN bus")
    protocol: ProtocolSettings = Field(ProtocolSettings(), description="The drive's frames, as its DBC names them")
    axis: AxisSettings = Field(description="The drive: plant, law, observer, limits")
    simulation: SimulationSettings = Field(SimulationSettings(), description="The simulated drive")


@dataclass(frozen=True, slots=True)
class LoadedConfig(Generic[ModelT]):
    """A valid configuration and where it came from.

    Parameters
    ----------
    config
        The settings.
    source
        The file as it was named; ``demo.toml (built in)`` for the embedded one.
    folder
        Folder of the file, to which the paths in it are relative.
    """

    config: ModelT
    source: str
    folder: Path
    _document: Document = field(repr=False)

    def problem(self, key: Sequence[str | int], message: str) -> ConfigError:
        """Make an error of what was noticed only after loading, such as a signal that the DBC does not have.

        Parameters
        ----------
        key
            The key at fault from the root, e.g. ``("protocol", "feedback", "position")``.
        message
            What is wrong and what would be right.

        Returns
        -------
        ConfigError
            To be raised; it names the line or the argument that set the key, else the table's line.
        """
        return ConfigError([self._document.problem(tuple(key), message)])


def load(path: Path | None, overrides: Sequence[str] = ()) -> LoadedConfig[Config]:
    """Load the configuration of the service.

    Parameters
    ----------
    path
        The TOML file; None for the embedded ``demo.toml``.
    overrides
        ``KEY=VALUE`` arguments of ``--set``: a dotted key; a value in TOML notation, or a bare word, which is a text.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, or holds something that the settings refuse.
    """
    return load_as(Config, path, overrides)


def load_as(model: type[ModelT], path: Path | None, overrides: Sequence[str] = ()) -> LoadedConfig[ModelT]:
    """Load a file as another settings class than :class:`Config`; see :func:`load`."""
    if path is None:
        embedded = Path(str(importlib.resources.files("twostage_servo_config"))) / "demo.toml"
        source, folder, text = "demo.toml (built in)", embedded.parent, _read(embedded)
    else:
        source, folder, text = str(path), path.parent, _read(path)
    data, lines = _parse(source, text)
    accepted: list[Override] = []
    problems: list[Problem] = []
    for override in overrides:
        try:
            accepted.append(_apply(data, override))
        except ConfigError as error:
            problems += error.problems
    document = Document(source, data, lines, accepted)
    try:
        config = model.model_validate(data)
    except ValidationError as error:
        raise ConfigError([*validation_problems(error, document, model), *problems]) from None
    if problems:
        raise ConfigError(problems)
    return LoadedConfig(config, source, folder, document)


def _refuse(file: str, message: str, line: int | None = None, key: str = "") -> NoReturn:
    raise ConfigError([Problem(file, line, key, None, message)]) from None


def _read(path: Path) -> str:
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            _refuse(str(path), "this is a device, a pipe or a socket; name a TOML file")  # reading it might never end
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE_BYTES + 1)
    except FileNotFoundError:
        _refuse(str(path), "there is no such file; check the name, and the current folder if the name is relative")
    except IsADirectoryError:
        inside = ", ".join(sorted(entry.name for entry in path.glob("*.toml"))[:8])
        _refuse(str(path), f"this is a folder; name a TOML file in it{f': {inside}' if inside else ''}")
    except PermissionError:
        _refuse(
            str(path), f"user {os.getuid()} may not read it; check the owner and mode of it and of the folders above"
        )
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        _refuse(str(path), f"cannot be read: {error}")
    if len(content) > LARGEST_FILE_BYTES:
        _refuse(str(path), f"is larger than {LARGEST_FILE_BYTES} bytes, hardly a configuration; is the name right?")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        # decode() counts from behind a byte order mark.
        start = error.start + (3 if content.startswith(codecs.BOM_UTF8) else 0)
        line = content.count(b"\n", 0, start) + 1
        _refuse(str(path), f"byte 0x{content[start]:02x} is not UTF-8; save the file as UTF-8", line)


def _parse(source: str, text: str) -> tuple[dict[str, Any], dict[toml_lines.Path, int]]:
    try:
        data = tomllib.loads(text)
        lines = toml_lines.key_lines(text)
    except tomllib.TOMLDecodeError as error:
        _refuse_syntax(source, text, str(error))
    except RecursionError:
        _refuse(source, "lists or tables are nested too deeply; a configuration needs three levels")
    except ValueError as error:  # an integer of thousands of digits
        digits = re.search(r"\d{4000,}", text)  # the only value that tomllib takes for one and Python does not
        line = text.count("\n", 0, digits.start()) + 1 if digits else None
        _refuse(source, f"holds a value that cannot be read: {str(error).partition(';')[0]}", line)
    if not data:
        _refuse(source, "there is no setting in this file; start from a copy of demo.toml")
    return data, lines


def _refuse_syntax(source: str, text: str, error: str) -> NoReturn:
    text_lines = text.split("\n")
    place = re.search(r" \(at line (\d+), column (\d+)\)$", error)
    line, column = (int(place[1]), int(place[2])) if place else (len(text_lines), len(text_lines[-1]) + 1)
    message = error[: place.start()] if place else error.replace("(at end of document)", "(the file ends too early)")
    if message.startswith(("Cannot", "Duplicate")):
        offset = sum(len(text_line) + 1 for text_line in text_lines[: line - 1]) + column - 1
        path, line, earlier_line = toml_lines.find_clash(text[:offset])
        earlier = f"clashes with line {earlier_line}" if earlier_line is not None else "holds a key twice"
        _refuse(source, f"{earlier}: each key and table is given once; keep one of the two", line, key_text(path))
    if message == "Invalid value":
        message += ": text goes in quotes, numbers are written 1.5, switches true or false"
    _refuse(source, f"not TOML at column {column}: {message}\n{_caret(text_lines[line - 1], column)}", line)


def _caret(text_line: str, column: int) -> str:
    start = max(0, column - 1 - _LONGEST_SOURCE_LINE // 2)
    shown = "".join(c if c.isprintable() else " " for c in text_line[start : start + _LONGEST_SOURCE_LINE])
    return f"    {shown}\n    {' ' * (column - 1 - start)}^"


def _apply(data: dict[str, Any], override: str) -> Override:
    argument = f"--set {override if override.isprintable() else ascii(override)}"
    key, equals, text = (part.strip() for part in override.partition("="))
    if not equals or not key:
        _refuse(argument, "is not KEY=VALUE, such as simulation.gain=234")
    if not override.isprintable():
        _refuse(argument, "holds characters that cannot be printed; a value is plain text on one line")
    try:
        path = toml_lines.split_key(key)
    except (ValueError, RecursionError):
        _refuse(argument, "is not a dotted key, such as simulation.gain", key=key)
    value = _override_value(argument, path, text)
    table = data
    for depth, part in enumerate(path[:-1], start=1):
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            _refuse(argument, f"{key_text(path[:depth])} is not a table, it has no keys", key=key_text(path))
    table[path[-1]] = value
    return Override(argument, path, value)


def _override_value(argument: str, path: toml_lines.Path, text: str) -> object:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError) as error:
        if text and text[0] not in "\"'[{#":
            return text
        reason = str(error).partition(" (at ")[0]
        notation = 'a value is written as in TOML: 1.5, true, "mm", [1, 2], ""'
        _refuse(argument, f"{reason}; {notation}", key=key_text(path))
