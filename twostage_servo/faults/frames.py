"""The frames of the drive under test: the campaign makes and reads them itself, and knows those of a DBC alone."""

from twostage_servo.app.assembly import build_drive
from twostage_servo.config.loader import Config, LoadedConfig
from twostage_servo.drives.dbc.drive import DbcDrive
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.drives.drive import Drive


def compile_profile(loaded: LoadedConfig[Config]) -> DriveProfile:
    """Compile the drive's frames from its DBC.

    Raises
    ------
    ConfigError
        If the DBC does not hold what the configuration names, or the drive is of another type.
    """
    if not isinstance(loaded.config.protocol, ProtocolSettings):
        raise loaded.problem(
            ("protocol", "type"),
            'the fault campaign knows the frames of drives of type "dbc" alone; to see what each fault costs under '
            "these limits, run it on a copy of this file without [protocol]",
        )
    return profile_of(build_drive(loaded))


def profile_of(drive: Drive) -> DriveProfile:
    """Return the compiled frames of a drive.

    Raises
    ------
    TypeError
        If no DBC describes it.
    """
    if isinstance(drive, DbcDrive):
        return drive.profile
    raise TypeError(f"{type(drive).__name__} is no drive that a DBC describes")


def protocol_of(config: Config) -> ProtocolSettings:
    """Return the table ``[protocol]`` of a drive that a DBC describes.

    Raises
    ------
    TypeError
        If it is of another type.
    """
    if not isinstance(config.protocol, ProtocolSettings):
        raise TypeError(f"a drive of type {config.protocol.type} is described by no DBC")
    return config.protocol
