"""Types of drives by name: those of this package, and those that other packages declare as entry points."""

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, EntryPoints, PackageNotFoundError, distribution, entry_points
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from twostage_servo.axis.messages import DriveTraits
from twostage_servo.drives.drive import Drive, DriveSide
from twostage_servo.settings.base import Settings

GROUP: Final = "twostage_servo.drives"
_OURS: Final = "twostage-servo"

SettingsT = TypeVar("SettingsT", bound=Settings)
DriveT = TypeVar("DriveT", bound=Drive)


@dataclass(frozen=True, slots=True)
class DriveType(Generic[SettingsT, DriveT]):
    """What an entry point of the group ``twostage_servo.drives`` names: how drives of a type are made.

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


def known_types() -> list[str]:
    """Return the names of all types that are installed."""
    return sorted({one.name for one in (*_ours(), *entry_points(group=GROUP))})


def is_known(name: str) -> bool:
    """Whether there is a type of this name; of ours this is known without a look at all that is installed."""
    return _find(name) is not None


@functools.cache
def drive_type(name: str) -> DriveType[Any, Any]:
    """Return the type of a name; only its own module is imported.

    Raises
    ------
    KeyError
        If there is none.
    TypeError
        If its entry point names something else.
    """
    found = _find(name)
    if found is None:
        raise KeyError(name)
    loaded = found.load()
    if not isinstance(loaded, DriveType):
        raise TypeError(f"the entry point {name} of {GROUP}, {found.value}, is no DriveType")
    return loaded


def _find(name: str) -> EntryPoint | None:
    ours: Iterable[EntryPoint] = _ours().select(name=name)
    return next(iter(ours or entry_points(group=GROUP, name=name)), None)


@functools.cache
def _ours() -> EntryPoints:
    """Return the types of this package, which are found without a look at all that is installed."""
    try:
        return distribution(_OURS).entry_points.select(group=GROUP)
    except PackageNotFoundError:
        return EntryPoints()
