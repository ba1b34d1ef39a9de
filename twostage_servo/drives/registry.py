"""The installed types of drives: one package and one entry point add another.

A package that adds a type declares it in its ``pyproject.toml``, under the name that ``protocol.type`` selects::

    [project.entry-points."twostage_servo.drives"]
    mine = "my_package.my_drive:DRIVE"

``DRIVE`` is a :class:`DriveType`. Its settings are the table ``[protocol]``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from twostage_servo.axis.messages import DriveTraits
from twostage_servo.drives.drive import Drive, DriveSide
from twostage_servo.plug_ins import PlugIns
from twostage_servo.settings.base import Settings, check_importable

GROUP: Final = "twostage_servo.drives"
DBC: Final = "dbc"
"""The type of a drive whose configuration names none."""

SettingsT = TypeVar("SettingsT", bound=Settings)
DriveT = TypeVar("DriveT", bound=Drive)


@dataclass(frozen=True, slots=True)
class DriveType(Generic[SettingsT, DriveT]):
    """A type of drives: how to build them.

    Attributes
    ----------
    settings
        The class of the table ``[protocol]``, a :class:`~twostage_servo.drives.settings.DriveSettings` at the top level
        of its module.
    build
        ``build(settings, folder, unit, fd)`` makes a drive. `folder` is that of the configuration, `unit` that of the
        axis, and `fd` says whether the frames are CAN FD ones. It raises
        :class:`~twostage_servo.drives.protocol_error.ProtocolError` for what does not fit.
    side
        Builds the drive's end of it, for the simulated drive.
    check_unchanged
        ``check_unchanged(settings, folder, traits)`` raises a ProtocolError if a file that describes the drive has
        changed since those traits were read from it.
    """

    settings: type[SettingsT]
    build: Callable[[SettingsT, Path, str, bool], DriveT]
    side: Callable[[DriveT], DriveSide]
    check_unchanged: Callable[[SettingsT, Path, DriveTraits], None] = lambda *_: None

    def __post_init__(self) -> None:
        """Check what a package has put together."""
        check_importable(self.settings)


DRIVES: Final[PlugIns[DriveType[Any, Any]]] = PlugIns(
    DriveType, "type of drives", GROUP, (DBC, "twostage_servo.drives.dbc.drive_type", "DBC")
)
"""All types that are installed."""
