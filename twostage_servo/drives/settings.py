"""The table ``[protocol]``: which type of drive; the rest of it belongs to that type."""

from typing import Any, TypeAlias

from pydantic import Field, ModelWrapValidatorHandler, field_validator, model_validator

from twostage_servo.drives.registry import GROUP, drive_type, is_known, known_types
from twostage_servo.settings.base import Settings

DEFAULT_TYPE = "dbc"

SettingsClass: TypeAlias = type[Settings]


class DriveSettings(Settings):
    """What the settings of all types of drives have in common. A type adds its own keys to them."""

    type: str = Field(DEFAULT_TYPE, description="Type of the drive: dbc, or one that an installed package brings")

    @field_validator("type")
    @classmethod
    def _is_known(cls, name: str) -> str:
        if not is_known(name):
            there_are = ", ".join(known_types()) or "none, not even of this package: install it again (pip install)"
            raise ValueError(
                f"no such type of drive is installed; there are: {there_are}. A package brings one by an entry point "
                f"of the group {GROUP}"
            )
        return name

    @model_validator(mode="wrap")
    @classmethod
    def _of_its_type(cls, value: Any, handler: ModelWrapValidatorHandler["DriveSettings"]) -> "DriveSettings":
        """Read the table as the settings of the type that it names."""
        if cls is not DriveSettings or not isinstance(value, dict):
            return handler(value)
        name = value.get("type", DEFAULT_TYPE)
        if not isinstance(name, str) or not is_known(name):
            return handler({"type": name})
        settings: DriveSettings = drive_type(name).settings.model_validate(value)
        return settings

    @staticmethod
    def class_for(table: object) -> SettingsClass:
        """Return the class that reads a table; that of the default where it names no type that is known."""
        name = table.get("type") if isinstance(table, dict) else None
        known: SettingsClass = drive_type(name if isinstance(name, str) and is_known(name) else DEFAULT_TYPE).settings
        return known
