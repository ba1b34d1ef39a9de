"""The table ``[protocol]``: which type of drive; the rest of it belongs to that type."""

from typing import Any, TypeAlias

from pydantic import Field, ModelWrapValidatorHandler, field_validator, model_validator

from twostage_servo.drives.registry import DBC, DRIVES
from twostage_servo.plug_ins import UnknownPlugInError
from twostage_servo.settings.base import Settings

SettingsClass: TypeAlias = type[Settings]


class DriveSettings(Settings):
    """The table ``[protocol]``: derive the settings of your type from it, and add its keys.

    ::

        class NodeSettings(DriveSettings):
            node: int = quantity(unit="1", description="Number of the drive's node", ge=1, le=127)

    Attributes
    ----------
    type
        Name of the type, by which the entry point is found.
    """

    type: str = Field(DBC, description="Type of the drive: dbc, or one that an installed package provides")

    @field_validator("type")
    @classmethod
    def _is_known(cls, name: str) -> str:
        try:
            DRIVES.get(name)
        except UnknownPlugInError as error:
            raise ValueError(str(error)) from error
        return name

    @model_validator(mode="wrap")
    @classmethod
    def _of_its_type(cls, value: Any, handler: ModelWrapValidatorHandler["DriveSettings"]) -> "DriveSettings":
        """Read the table as the settings of the type that it names."""
        if cls is not DriveSettings or not isinstance(value, dict):
            return handler(value)
        known = _class_of(value)
        if known is None:
            return handler({"type": value["type"]})
        settings = known.model_validate(value)
        if not isinstance(settings, DriveSettings):
            raise ValueError("the settings of this type are not a DriveSettings: correct its package")  # noqa: TRY004
        return settings

    @staticmethod
    def class_for(table: object) -> SettingsClass:
        """Return the class that reads a table; that of the default where it names no type that is known."""
        known = _class_of(table) if isinstance(table, dict) else None
        return known or _class_of({}) or DriveSettings


def _class_of(table: dict[str, Any]) -> SettingsClass | None:
    """Return the settings class of the type that a table names, or None if there is no such type."""
    name = table.get("type", DBC)
    if not isinstance(name, str):
        return None
    try:
        found: SettingsClass = DRIVES.get(name).settings
    except UnknownPlugInError:
        return None
    return found
