"""Which laws there are: one file and one entry point make one more.

A package that brings a law declares it in its ``pyproject.toml``, by the name that ``axis.law.type`` then takes::

    [project.entry-points."twostage_servo.laws"]
    mine = "my_package.my_law:LAW"

``LAW`` is a :class:`LawType`. The keys of the law stand in the table ``[axis.law.mine]``; each has a default, so that
changing ``axis.law.type`` alone makes a valid configuration.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from twostage_servo.control.laws.law import ControlTask, LawDesign
from twostage_servo.plug_ins import PlugIns
from twostage_servo.settings.base import Settings, check_importable

GROUP: Final = "twostage_servo.laws"
PAPER: Final = "paper"
"""The law that an axis has where its configuration names none."""


@dataclass(frozen=True, slots=True)
class LawType:
    """A law that an axis may have.

    Attributes
    ----------
    settings
        Its keys; each has a default. A class at the top level of its module.
    design
        Makes a design of such settings for a task. It raises :class:`~twostage_servo.control.laws.law.DesignError`
        where there is none.
    smooths
        Whether its laws keep the jerk of their reference, in moves and in stops, within that of the task; a task of a
        law that does not has none.
    """

    settings: type[Settings]
    design: Callable[[Any, ControlTask], LawDesign]
    smooths: bool = False

    def __post_init__(self) -> None:
        """Check what a package has put together."""
        check_importable(self.settings)


LAWS: Final = PlugIns(
    LawType,
    "law",
    GROUP,
    (PAPER, "twostage_servo.control.laws.paper_type", "PAPER"),
    ("adaptive", "twostage_servo.control.laws.adaptive.adaptive_type", "ADAPTIVE"),
)
"""All that are installed."""
