"""Errors that processes tell each other."""

from collections.abc import Callable
from functools import partial
from typing import Any, Self


class PortableError(Exception):
    """An error that is made again, in another process, of what it was made of.

    What Exception hands over is the text that it was initialised with: of an error that takes more than that, nothing
    can be made, and a pool of processes takes that for the end of the process that has sent it.
    """

    def __new__(cls, *arguments: Any, **named: Any) -> Self:
        """Remember what it is made of."""
        self = super().__new__(cls, *arguments)
        self._made_of = arguments, named
        return self

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Return how to make it again."""
        arguments, named = self._made_of
        return partial(type(self), **named), arguments

    _made_of: tuple[tuple[Any, ...], dict[str, Any]]
