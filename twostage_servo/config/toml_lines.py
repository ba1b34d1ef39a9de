"""On which line of a TOML text each table and key is defined.

:mod:`tomllib` parses and checks but does not say where a value came from. The scanner here only reads what tomllib has
accepted (a whole text, or the part up to a doubled key), so it checks nothing: it tells keys, strings and brackets
apart and leaves every other rule of TOML 1.0 to tomllib. A property test holds the two together.
"""

import bisect
import re
import tomllib
from typing import Any, NamedTuple

Path = tuple[str | int, ...]
"""Keys and list indices from the root, e.g. ``("axis", "limits", "velocity")``."""

_PART = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')"""
_KEY = re.compile(rf"{_PART}(?:[ \t]*\.[ \t]*{_PART})*")
_BLANK = re.compile(r"(?:[ \t\r\n]|\#[^\n]*)*")
_SEPARATOR = re.compile(r"(?:[ \t\r\n,]|\#[^\n]*)*")
_SCALAR = re.compile(r"[^,\]}\#\n]*")
# The last two quotation marks of a multi-line string may be its own text: up to five stand at its end.
_STRING = re.compile(
    r'''
      """ (?: [^\\] | \\. )*? """ "{0,2}
    | \'\'\' .*? \'\'\' \'{0,2}
    | " (?: [^"\\\n] | \\. )* "
    | ' [^'\n]* '
    ''',
    re.DOTALL | re.VERBOSE,
)


class Definition(NamedTuple):
    """One table header, key or list entry."""

    path: Path
    line: int


class Clash(NamedTuple):
    """A key or table that is defined where it must not be again."""

    path: Path
    line: int
    earlier_line: int | None


class _Scanner:
    """Walks an accepted text once; ``statements`` holds each statement's definitions, its own first."""

    def __init__(self, text: str) -> None:
        self.statements: list[list[Definition]] = []
        self._text = text
        self._position = 0
        self._line_ends = [match.start() for match in re.finditer("\n", text)]
        self._array_lengths: dict[Path, int] = {}
        header: Path = ()
        self._skip(_BLANK)
        while self._position < len(text):
            self.statements.append([])
            if text[self._position] == "[":
                header = self._header()
            else:
                self._pair(header)
            self._skip(_BLANK)

    def _header(self) -> Path:
        line = self._line()
        is_array = self._text.startswith("[[", self._position)
        self._position += 2 if is_array else 1
        self._skip(_BLANK)
        path: Path = ()
        for part in self._key():
            # [a.b] under [[a]] speaks of the newest entry of a.
            path += (part,) if path not in self._array_lengths else (self._array_lengths[path] - 1, part)
        if is_array:
            index = self._array_lengths.get(path, 0)
            self._array_lengths[path] = index + 1
            path += (index,)
        self.statements[-1].append(Definition(path, line))
        end = self._text.find("\n", self._position)
        self._position = len(self._text) if end < 0 else end
        return path

    def _pair(self, table: Path) -> None:
        line = self._line()
        path = table + self._key()
        self.statements[-1].append(Definition(path, line))
        self._position = self._text.index("=", self._position) + 1
        self._value(path)

    def _value(self, path: Path) -> None:
        self._skip(_BLANK)
        first = self._text[self._position]
        if first in "\"'":
            self._skip(_STRING)
        elif first not in "[{":
            self._skip(_SCALAR)
        else:
            self._position += 1
            self._entries(path, is_list=first == "[")

    def _entries(self, path: Path, *, is_list: bool) -> None:
        index = 0
        while True:
            self._skip(_SEPARATOR)
            if self._text[self._position : self._position + 1] in ("]", "}", ""):
                self._position += 1
                return
            if is_list:
                self.statements[-1].append(Definition((*path, index), self._line()))
                self._value((*path, index))
                index += 1
            else:
                self._pair(path)

    def _key(self) -> tuple[str, ...]:
        start = self._position
        self._skip(_KEY)
        return split_key(self._text[start : self._position])

    def _line(self) -> int:
        return bisect.bisect_left(self._line_ends, self._position) + 1

    def _skip(self, pattern: re.Pattern[str]) -> None:
        match = pattern.match(self._text, self._position)
        if match is None:
            raise ValueError(f"offset {self._position}: not a text that tomllib accepts")
        self._position = match.end()


def split_key(key: str) -> tuple[str, ...]:
    """Split a dotted key, e.g. ``axis."my plant".gain``.

    Raises
    ------
    tomllib.TOMLDecodeError
        The text is not one TOML key.
    """
    if not _KEY.fullmatch(key):
        raise tomllib.TOMLDecodeError("not a dotted key")
    if "." not in key and key[0] not in "\"'":
        return (key,)
    node: Any = tomllib.loads(f"{key} = 0")
    parts: list[str] = []
    while isinstance(node, dict):
        [(part, node)] = node.items()
        parts.append(part)
    return tuple(parts)


def key_lines(text: str) -> dict[Path, int]:
    """Find the line of every table, key and list entry.

    Parameters
    ----------
    text
        A text that ``tomllib.loads`` accepts.

    Returns
    -------
    dict
        Line numbers from 1. A table that is only implied (``a`` in ``[a.b]``) has the line that first implies it.
    """
    implied: dict[Path, int] = {}
    defined: dict[Path, int] = {}
    for statement in _Scanner(text).statements:
        for path, line in statement:
            defined[path] = line
            for length in range(1, len(path)):
                implied.setdefault(path[:length], line)
    return implied | defined


def find_clash(text: str) -> Clash:
    """Say which definition the last statement of a text repeats.

    Parameters
    ----------
    text
        The text up to the place where tomllib refused to define something a second time.

    Returns
    -------
    Clash
        The refused key with its line, and the earlier line that excludes it (None where the two are parts of one
        inline table).
    """
    *before, (statement, *inner) = _Scanner(text).statements
    lines = {statement.path: statement.line}
    for path, line in inner:
        if path in lines:
            return Clash(path, line, lines[path])
        lines[path] = line
    length = len(statement.path)
    earlier = [definition for definitions in before for definition in definitions]
    same_or_inside = [line for path, line in earlier if path[:length] == statement.path]
    around = [definition for definition in earlier if definition.path == statement.path[: len(definition.path)]]
    if same_or_inside:
        return Clash(*statement, same_or_inside[0])
    return Clash(*statement, max(around, key=lambda found: len(found.path)).line if around else None)
