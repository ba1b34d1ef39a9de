"""The one reader of configuration files: a file is read once and parsed once, and its lines are found once.

The loader makes settings of what it returns. A command that wants no more than the control socket's path takes it from
there as well, and loads neither the settings nor their library.
"""

import codecs
import os
import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn

from twostage_servo.config.errors import ConfigError, Problem
from twostage_servo.config.files import shipped_configuration, similar_configurations
from twostage_servo.settings.toml_text import key_text

if TYPE_CHECKING:
    from twostage_servo.config import toml_lines

LARGEST_FILE_BYTES: Final = 1_000_000
_LONGEST_SOURCE_LINE: Final = 100


class TomlFile:
    """What a configuration file holds, before anybody has judged it.

    Parameters
    ----------
    source
        The file as it was named; ``demo.toml (built in)`` for the embedded one.
    folder
        Folder of the file, to which the paths in it are relative.
    data
        Its tables, keys and values, not to be changed.
    text
        What it was parsed from.
    lines
        Line of every table, key and list entry, where somebody knows them already.
    """

    def __init__(
        self,
        source: str,
        folder: Path,
        data: dict[str, Any],
        text: str,
        lines: "dict[toml_lines.Path, int] | None" = None,
    ) -> None:
        self.source = source
        self.folder = folder
        self.data = data
        self._text = text
        self._lines = lines

    def with_keys(self, data: dict[str, Any], lines: "dict[toml_lines.Path, int]") -> "TomlFile":
        """Return the file with other keys, and the line of each."""
        return TomlFile(self.source, self.folder, data, self._text, lines)

    @property
    def lines(self) -> "dict[toml_lines.Path, int]":
        """Line of every table, key and list entry; found once, when somebody asks."""
        if self._lines is None:
            from twostage_servo.config import toml_lines  # noqa: PLC0415 - the operator's commands start without it

            try:
                self._lines = toml_lines.key_lines(self._text)
            except RecursionError:
                _refuse_nesting(self.source)
        return self._lines


def read_toml(path: Path | None) -> TomlFile:
    """Read and parse a configuration file.

    Parameters
    ----------
    path
        The TOML file; None for the embedded ``demo.toml``.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, or is empty.
    """
    if path is None:
        embedded = shipped_configuration("demo.toml")
        source, folder, text = "demo.toml (built in)", embedded.parent, _read(embedded)
    else:
        source, folder, text = str(path), path.parent, _read(path)
    return TomlFile(source, folder, _parse(source, text), text)


def _refuse(file: str, message: str, line: int | None = None, key: str = "") -> NoReturn:
    raise ConfigError([Problem(file, line, key, None, message)]) from None


def _refuse_nesting(source: str) -> NoReturn:
    _refuse(source, "lists or tables are nested too deeply; a configuration needs three levels")


def _read(path: Path) -> str:
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            _refuse(str(path), "this is a device, a pipe or a socket; name a TOML file")  # reading it might never end
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE_BYTES + 1)
    except FileNotFoundError:
        advice = "check the name, and the current folder if the name is relative"
        if similar := similar_configurations(path):
            advice = f"did you mean {' or '.join(similar)}?"
        _refuse(str(path), f"there is no such file; {advice}")
    except IsADirectoryError:
        inside = ", ".join(sorted(entry.name for entry in path.glob("*.toml"))[:8])
        _refuse(str(path), f"this is a folder; name a TOML file in it{f': {inside}' if inside else ''}")
    except PermissionError:
        _refuse(str(path), f"user {os.getuid()} may not read it; check the owner and mode of the file and its folders")
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        _refuse(str(path), f"cannot be read: {error}")
    if len(content) > LARGEST_FILE_BYTES:
        _refuse(str(path), f"is larger than {LARGEST_FILE_BYTES} bytes, too large for a configuration; check the name")
    try:
        # Not by the codec utf-8-sig, which is one more module to load.
        return content.removeprefix(codecs.BOM_UTF8).decode().replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        start = error.start + (len(codecs.BOM_UTF8) if content.startswith(codecs.BOM_UTF8) else 0)
        line = content.count(b"\n", 0, start) + 1
        _refuse(str(path), f"byte 0x{content[start]:02x} is not UTF-8; save the file as UTF-8", line)


def _parse(source: str, text: str) -> dict[str, Any]:
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        _refuse_syntax(source, text, str(error))
    except RecursionError:
        _refuse_nesting(source)
    except ValueError as error:  # an integer of thousands of digits
        digits = re.search(r"\d{4000,}", text)  # the only value that tomllib takes for one and Python does not
        line = text.count("\n", 0, digits.start()) + 1 if digits else None
        _refuse(source, f"contains a value that cannot be read: {str(error).partition(';')[0]}", line)
    if not data:
        _refuse(source, "there are no settings in this file; start from a copy of demo.toml")
    return data


def _refuse_syntax(source: str, text: str, error: str) -> NoReturn:
    text_lines = text.split("\n")
    place = re.search(r" \(at line (\d+), column (\d+)\)$", error)
    line, column = (int(place[1]), int(place[2])) if place else (len(text_lines), len(text_lines[-1]) + 1)
    message = error[: place.start()] if place else error.replace("(at end of document)", "(the file ends too early)")
    if message.startswith(("Cannot", "Duplicate")):
        from twostage_servo.config import toml_lines  # noqa: PLC0415 - as above

        offset = sum(len(text_line) + 1 for text_line in text_lines[: line - 1]) + column - 1
        path, line, earlier_line = toml_lines.find_clash(text[:offset])
        earlier = f"clashes with line {earlier_line}" if earlier_line is not None else "contains a key twice"
        _refuse(source, f"{earlier}: each key and table must appear once; keep one of the two", line, key_text(path))
    if message == "Invalid value":
        message += ": write text in quotes, numbers as 1.5, switches as true or false"
    _refuse(source, f"not TOML at column {column}: {message}\n{_caret(text_lines[line - 1], column)}", line)


def _caret(text_line: str, column: int) -> str:
    start = max(0, column - 1 - _LONGEST_SOURCE_LINE // 2)
    shown = "".join(c if c.isprintable() else " " for c in text_line[start : start + _LONGEST_SOURCE_LINE])
    return f"    {shown}\n    {' ' * (column - 1 - start)}^"
