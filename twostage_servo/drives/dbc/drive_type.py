"""The type of drives whose frames a DBC file describes; the entry point ``dbc`` names it.

What compiles a DBC is imported where a drive is built: that takes 45 ms, and a configuration is read elsewhere as well.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Final

from twostage_servo.axis.messages import DriveTraits
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.drives.drive import DriveSide
from twostage_servo.drives.protocol_error import ProtocolError
from twostage_servo.drives.registry import DriveType

if TYPE_CHECKING:
    from twostage_servo.drives.dbc.drive import DbcDrive


def _build(settings: ProtocolSettings, folder: Path, axis_unit: str, fd: bool) -> "DbcDrive":
    from twostage_servo.drives.dbc.drive import DbcDrive
    from twostage_servo.drives.dbc.profile import DriveProfile

    return DbcDrive(DriveProfile.compile(settings, folder, axis_unit, fd=fd))


def _side(drive: "DbcDrive") -> DriveSide:
    from twostage_servo.drives.dbc.drive_side import DbcDriveSide

    return DbcDriveSide(drive.profile)


def _check_unchanged(settings: ProtocolSettings, folder: Path, traits: DriveTraits) -> None:
    from twostage_servo.drives.dbc.compiler import dbc_digest

    if dbc_digest(settings.dbc, folder) != traits.digest:
        text = "the content of the DBC file has changed: restart the service to apply that"
        raise ProtocolError(("protocol", "dbc"), text)


DBC: Final = DriveType(ProtocolSettings, _build, _side, _check_unchanged)
