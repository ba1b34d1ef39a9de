"""The type of drives whose frames a DBC file describes; the entry point ``dbc`` names it."""

from pathlib import Path
from typing import Final

from twostage_servo.axis.messages import DriveTraits
from twostage_servo.drives.dbc.compiler import dbc_digest
from twostage_servo.drives.dbc.drive import DbcDrive
from twostage_servo.drives.dbc.drive_side import DbcDriveSide
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.drives.protocol_error import ProtocolError
from twostage_servo.drives.registry import DriveType


def _build(settings: ProtocolSettings, folder: Path, axis_unit: str, fd: bool) -> DbcDrive:
    return DbcDrive(DriveProfile.compile(settings, folder, axis_unit, fd=fd))


def _check_unchanged(settings: ProtocolSettings, folder: Path, traits: DriveTraits) -> None:
    if dbc_digest(settings.dbc, folder) != traits.digest:
        text = "the content of the DBC file has changed: only a restart of the service can follow that"
        raise ProtocolError(("protocol", "dbc"), text)


DBC: Final = DriveType(ProtocolSettings, _build, lambda drive: DbcDriveSide(drive.profile), _check_unchanged)
