"""The configuration: one TOML file and ``--set`` arguments become the rooms' settings.

The settings themselves, with units and bounds, are declared in the room that uses them.
"""

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import Field, ValidationError, create_model

from twostage_servo.axis.settings import AxisSettings
from twostage_servo.canbus.bus_settings import BusSettings
from twostage_servo.config.document import Document, overridden
from twostage_servo.config.errors import ConfigError, Problem
from twostage_servo.config.problems import validation_problems
from twostage_servo.config.renamed_keys import note_of, present_path, under_present_names
from twostage_servo.config.toml_file import TomlFile, read_toml
from twostage_servo.drives.settings import DriveSettings
from twostage_servo.host.settings import RealtimeSettings
from twostage_servo.service.settings import ServiceSettings
from twostage_servo.settings.base import Settings
from twostage_servo.simulation.settings import SimulationSettings

ModelT = TypeVar("ModelT", bound=Settings)


class Config(Settings):
    """The whole configuration file."""

    service: ServiceSettings = Field(ServiceSettings(), description="Tick, control socket and log")
    realtime: RealtimeSettings = Field(RealtimeSettings(), description="Real-time settings of the host")
    bus: BusSettings = Field(description="The CAN bus")
    protocol: DriveSettings = Field(
        default_factory=lambda: DriveSettings.model_validate({}), description="Type of the drive, and its frames"
    )
    axis: AxisSettings = Field(description="The axis: plant, law, observer, limits")
    simulation: SimulationSettings = Field(SimulationSettings(), description="The simulated drive")


@dataclass(frozen=True, slots=True)
class LoadedConfig(Generic[ModelT]):
    """A valid configuration and where it came from.

    Parameters
    ----------
    config
        The settings.
    source
        The file as it was named; ``demo.toml (built in)`` for the embedded one.
    folder
        Folder of the file, to which the paths in it are relative.
    notes
        What is valid, and yet to be told: what stands there, or among the arguments, under a former name, with the
        present one; and an axis whose law has no type.
    """

    config: ModelT
    source: str
    folder: Path
    notes: tuple[Problem, ...]
    _document: Document = field(repr=False)

    def problem(self, key: Sequence[str | int], message: str) -> ConfigError:
        """Make an error of what was noticed only after loading, such as a signal that the DBC does not have.

        Parameters
        ----------
        key
            The key at fault from the root, e.g. ``("protocol", "feedback", "position")``.
        message
            What is wrong and what would be right.

        Returns
        -------
        ConfigError
            To be raised; it names the line or the argument that set the key, else the table's line.
        """
        return ConfigError([self._document.problem(tuple(key), message)])


def load(path: Path | None, overrides: Sequence[str] = ()) -> LoadedConfig[Config]:
    """Load the configuration of the service.

    Parameters
    ----------
    path
        The TOML file; None for the embedded ``demo.toml``.
    overrides
        ``KEY=VALUE`` arguments of ``--set``: a dotted key; a value in TOML notation, or a bare word, which is a text.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, or holds something that the settings refuse.
    """
    return load_as(Config, path, overrides)


def load_as(model: type[ModelT], path: Path | None, overrides: Sequence[str] = ()) -> LoadedConfig[ModelT]:
    """Load a file as another settings class than :class:`Config`; see :func:`load`."""
    return validated(model, read_toml(path), overrides)


def validated(model: type[ModelT], file: TomlFile, overrides: Sequence[str] = ()) -> LoadedConfig[ModelT]:
    """Make settings of a file that has been read.

    Parameters
    ----------
    model
        The settings class.
    file
        The file, which stays as it is.
    overrides
        As for :func:`load`.

    Raises
    ------
    ConfigError
        With everything that the settings refuse.
    """
    present = under_present_names(model, file)
    document, problems = overridden(present.file, overrides, functools.partial(present_path, model))
    try:
        config = model.model_validate(document.data)
    except ValidationError as error:
        raise ConfigError([*validation_problems(error, document, described(model, document.data)), *problems]) from None
    if problems:
        raise ConfigError(problems)
    renamed = (*present.notes, *(note_of(one) for one in document.overrides if one.named != one.path))
    notes = (*renamed, *_note_of_the_law(config, document))
    return LoadedConfig(config, file.source, file.folder, notes, document)


def _note_of_the_law(config: Settings, document: Document) -> Iterator[Problem]:
    """Yield the note of an axis whose law has no type."""
    if isinstance(config, Config) and (text := config.axis.law.unnamed):
        yield document.problem(("axis", "law", "type"), text)


def described(model: type[Settings], data: Mapping[str, Any]) -> type[Settings]:
    """Return a settings class with every key that a file may have; which keys ``[protocol]`` has, its type decides."""
    if "protocol" not in model.model_fields:
        return model
    protocol = DriveSettings.class_for(data.get("protocol"))
    description = model.model_fields["protocol"].description
    typed: type[Settings] = create_model(
        model.__name__, __base__=model, protocol=(protocol, Field(default_factory=protocol, description=description))
    )
    return typed
