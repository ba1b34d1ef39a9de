"""The error with which a configuration is refused, whoever finds out; it needs the standard library alone."""

from collections.abc import Sequence
from typing import NamedTuple

from twostage_servo.portable_error import PortableError


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


class ConfigError(PortableError, ValueError):
    """The configuration cannot be used; ``problems`` holds everything that is wrong with it, in the file's order."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))
