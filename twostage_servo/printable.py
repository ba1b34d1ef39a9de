"""Text on its way to a terminal, which takes some characters for orders: none of these leaves as it is."""

import math
import unicodedata
from collections.abc import Iterable
from typing import Any, Final

_SPACE: Final = "Zs"  # unicodedata's category of every blank: harmless, though str.isprintable() knows one of them only


def printable(text: str) -> str:
    r"""Return a text in which control and format characters are escapes, such as ``\x1b``; lines stay lines.

    Requests, names of axes, files of drives and answers of a service all hold texts of others. In one of them ESC would
    clear the operator's screen, write a state that is none, or worse, and U+202E would turn a line round.

    Parameters
    ----------
    text
        Any text; the escapes are Python's.
    """
    if text.isprintable():
        return text
    return "".join(map(_escaped, text))


def printable_line(text: str) -> str:
    """Return the same as one line: a line break of somebody else's would begin a line of its own."""
    return printable(text).replace("\n", "\\n")


def printable_json(text: str) -> str:
    """Return JSON that has ASCII only, as JSON without the one control character that its writers leave in."""
    return text.replace("\x7f", "\\u007f")


def ready_for_json(values: Iterable[Any]) -> list[Any]:
    """Return values in which a number that is not finite, which JSON can't say, is null."""
    return [None if isinstance(value, float) and not math.isfinite(value) else value for value in values]


def _escaped(character: str) -> str:
    if character.isprintable() or character == "\n" or unicodedata.category(character) == _SPACE:
        return character
    return character.encode("unicode_escape").decode("ascii")
