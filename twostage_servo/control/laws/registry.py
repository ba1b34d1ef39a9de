"""Which laws there are: one file and one entry point make one more.

A package that brings a law declares it in its ``pyproject.toml``, by the name that ``axis.law.type`` then takes::

    [project.entry-points."twostage_servo.laws"]
    mine = "my_package.my_law:LAW"

``LAW`` is a :class:`LawType`. The keys of the law stand in the table ``[axis.law.mine]``; each has a default, so that
changing ``axis.law.type`` alone makes a valid configuration.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module, metadata
from typing import Any, Final

from twostage_servo.control.laws.law import ControlTask, LawDesign
from twostage_servo.settings.base import Settings

GROUP: Final = "twostage_servo.laws"
PAPER: Final = "paper"
"""The law that an axis has where its configuration names none."""

_PAPER_TYPE: Final = "twostage_servo.control.laws.paper_type", "PAPER"
"""Its entry point, known without a search through all installed packages, which takes up to 20 ms of a start."""


@dataclass(frozen=True, slots=True)
class LawType:
    """A law that an axis may have.

    Attributes
    ----------
    settings
        Its keys; each has a default.
    design
        Makes a design of such settings for a task. It raises :class:`~twostage_servo.control.laws.law.DesignError`
        where there is none.
    """

    settings: type[Settings]
    design: Callable[[Any, ControlTask], LawDesign]


class UnknownLawError(LookupError):
    """No law of this name is installed, or it cannot be loaded; the text says so."""


def law_names() -> list[str]:
    """Return the names of all laws that are installed."""
    return sorted({PAPER, *(point.name for point in _entry_points())})


@functools.cache
def law_type(name: str) -> LawType:
    """Return the law of a name.

    Raises
    ------
    UnknownLawError
        If there is none, or its package is broken.
    """
    if name == PAPER:
        module, attribute = _PAPER_TYPE
        found = getattr(import_module(module), attribute)
    else:
        point = next((point for point in _entry_points() if point.name == name), None)
        if point is None:
            raise UnknownLawError(f"no law is called {name!r}; there are: {', '.join(law_names())}")
        try:
            found = point.load()
        except Exception as error:
            raise UnknownLawError(f"the law {name!r} cannot be loaded from {point.value}: {error}") from error
    if not isinstance(found, LawType):
        raise UnknownLawError(f"the law {name!r} is no LawType but {type(found).__name__}: its package is wrong")
    return found


def _entry_points() -> metadata.EntryPoints:
    return metadata.entry_points(group=GROUP)
