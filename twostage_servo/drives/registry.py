"""Which types of drives there are: one package and one entry point make one more.

A package that brings a type declares it in its ``pyproject.toml``, by the name that ``protocol.type`` then takes::

    [project.entry-points."twostage_servo.drives"]
    mine = "my_package.my_drive:DRIVE"

``DRIVE`` is a :class:`DriveType`. Its settings are the table ``[protocol]``.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from twostage_servo.axis.messages import DriveTraits
from twostage_servo.drives.drive import Drive, DriveSide
from twostage_servo.settings.base import Settings

GROUP: Final = "twostage_servo.drives"
DBC: Final = "dbc"
"""The type of a drive whose configuration names none."""

_DBC_TYPE: Final = "twostage_servo.drives.dbc.drive_type", "DBC"
"""Its entry point, known without a search through all installed packages, which takes up to 20 ms of a start."""

SettingsT = TypeVar("SettingsT", bound=Settings)
DriveT = TypeVar("DriveT", bound=Drive)


@dataclass(frozen=True, slots=True)
class DriveType(Generic[SettingsT, DriveT]):
    """A type of drives: how they are made.

    Attributes
    ----------
    settings
        The class of the table ``[protocol]``, a :class:`~twostage_servo.drives.settings.DriveSettings`.
    build
        ``build(settings, folder of the configuration, unit of the axis, whether the frames are CAN FD ones)`` makes a
        drive; what does not fit is a :class:`~twostage_servo.drives.protocol_error.ProtocolError`.
    side
        Makes the drive's own end of it, for the simulated drive.
    check_unchanged
        ``check_unchanged(settings, folder, traits)`` raises a ProtocolError if a file that describes the drive is not
        the one any more from which those traits come.
    """

    settings: type[SettingsT]
    build: Callable[[SettingsT, Path, str, bool], DriveT]
    side: Callable[[DriveT], DriveSide]
    check_unchanged: Callable[[SettingsT, Path, DriveTraits], None] = lambda *_: None


class UnknownDriveError(LookupError):
    """No type of drives of this name is installed, or it cannot be loaded; the text says so."""


def drive_type_names() -> list[str]:
    """Return the names of all types that are installed."""
    return sorted({DBC, *(point.name for point in _entry_points())})


@functools.cache
def drive_type(name: str) -> DriveType[Any, Any]:
    """Return the type of a name; only its own module is imported.

    Raises
    ------
    UnknownDriveError
        If there is none, or its package is broken.
    """
    if name == DBC:
        module, attribute = _DBC_TYPE
        found = getattr(import_module(module), attribute)
    else:
        point = next((point for point in _entry_points() if point.name == name), None)
        if point is None:
            raise UnknownDriveError(
                f"no type of drives is called {name!r}; there are: {', '.join(drive_type_names())}. A package brings "
                f"one by an entry point of the group {GROUP}"
            )
        try:
            found = point.load()
        except Exception as error:
            raise UnknownDriveError(f"the type {name!r} cannot be loaded from {point.value}: {error}") from error
    if not isinstance(found, DriveType):
        text = f"the type {name!r} is no DriveType but {type(found).__name__}: its package is wrong"
        raise UnknownDriveError(text)
    return found


def _entry_points() -> metadata.EntryPoints:
    return metadata.entry_points(group=GROUP)
