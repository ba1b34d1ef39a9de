"""The machine: one configuration, or several that share a tick, and what has to be true of them together.

A machine's file lists the configurations of its axes, each of which is complete and can be checked and tried alone.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field, field_validator

from twostage_servo.config.errors import ConfigError, Problem
from twostage_servo.config.loader import Config, LoadedConfig, validated
from twostage_servo.config.toml_file import read_toml
from twostage_servo.host.settings import RealtimeSettings
from twostage_servo.service.settings import ServiceSettings
from twostage_servo.settings.base import Settings

FaultReaction = Literal["continue", "stop", "quick_stop", "disarm"]
"""What the other axes of a machine do when one trips."""

_MOST_CHOICES = 3
_FOR_AN_AXIS = re.compile(r"(\w[\w.-]*):(.*)", re.DOTALL)


class MachineSettings(Settings):
    """Which axes run in one service, and what they have to do with each other."""

    axes: list[str] = Field(
        description="Configuration files of the axes, relative to the folder of this file", min_length=1, max_length=64
    )
    fault_reaction: FaultReaction = Field(
        "stop",
        description="What the other axes do when one trips: continue, stop and hold, quick stop and hold, or disarm",
    )
    renamed: ClassVar = {"when_one_trips": "fault_reaction"}

    @field_validator("axes")
    @classmethod
    def _are_different(cls, axes: list[str]) -> list[str]:
        if doubled := sorted({axis for axis in axes if axes.count(axis) > 1}):
            raise ValueError(f"{', '.join(doubled)} is listed twice; each axis needs its own file")
        return axes


class MachineConfig(Settings):
    """The whole file of a machine of several axes."""

    service: ServiceSettings = Field(ServiceSettings(), description="Tick, control socket and log")
    realtime: RealtimeSettings = Field(RealtimeSettings(), description="Real-time settings of the host")
    machine: MachineSettings = Field(description="The axes")


@dataclass(frozen=True, slots=True)
class Machine:
    """A valid configuration of a service.

    Attributes
    ----------
    source
        The file as it was named.
    service, realtime
        Its tables ``[service]`` and ``[realtime]``.
    fault_reaction
        What the other axes do when one trips.
    axes
        The axes' configurations, in their order.
    """

    source: str
    service: ServiceSettings
    realtime: RealtimeSettings
    fault_reaction: FaultReaction
    axes: tuple[LoadedConfig[Config], ...]
    _file: LoadedConfig[Config] | LoadedConfig[MachineConfig] = field(repr=False)

    @property
    def is_one_axis(self) -> bool:
        """Whether the file is that of an axis, not of a machine."""
        return self._file in self.axes

    def axis(self, name: str) -> LoadedConfig[Config]:
        """Return the configuration of the axis of a name.

        Raises
        ------
        KeyError
            If there is none.
        """
        for loaded in self.axes:
            if loaded.config.axis.name == name:
                return loaded
        raise KeyError(name)

    def with_axis(self, name: str, config: Config) -> "Machine":
        """Return the machine with another configuration of the axis of a name."""
        former = self.axis(name)
        changed = replace(former, config=config)
        if self._file is former:
            return Machine.of(changed)
        return replace(self, axes=tuple(changed if loaded is former else loaded for loaded in self.axes))

    @property
    def notes(self) -> list[Problem]:
        """What is to be told of any of the files; see :class:`LoadedConfig`."""
        files = [self._file, *(loaded for loaded in self.axes if loaded is not self._file)]
        return [one for file in files for one in file.notes]

    def problem(self, key: Sequence[str | int], message: str) -> ConfigError:
        """Make an error of what was noticed only after loading; see :meth:`LoadedConfig.problem`."""
        return self._file.problem(key, message)

    @classmethod
    def of(cls, loaded: LoadedConfig[Config]) -> "Machine":
        """Return the machine of one axis."""
        return cls(loaded.source, loaded.config.service, loaded.config.realtime, "stop", (loaded,), loaded)


def load_machine(path: Path | None, overrides: Sequence[str] = ()) -> Machine:
    """Load the configuration of a service: of one axis, or of a machine of several.

    Parameters
    ----------
    path
        The TOML file, of an axis or of a machine; None for the embedded ``demo.toml``.
    overrides
        ``KEY=VALUE`` arguments of ``--set``; in a machine, ``AXIS:KEY=VALUE`` is for the axis of that name.

    Raises
    ------
    ConfigError
        A file cannot be used, or they do not fit together.
    """
    file = read_toml(path)
    if "machine" not in file.data:
        return Machine.of(validated(Config, file, overrides))
    for_axes = [found.groups() for override in overrides if (found := _FOR_AN_AXIS.match(override))]
    for_none = [one for one in overrides if not _FOR_AN_AXIS.match(one) and _is_of_an_axis(one)]
    for_all = [one for one in overrides if not _FOR_AN_AXIS.match(one) and one not in for_none]
    machine = validated(MachineConfig, file, for_all)
    settings = machine.config.machine
    problems: list[Problem] = []
    axes: list[LoadedConfig[Config]] = []
    for name in settings.axes:
        try:
            axes.append(_load_axis(file.folder / name, for_axes))
        except ConfigError as error:
            problems += error.problems
    problems += _problems_together(machine, axes)
    names = {axis.config.axis.name for axis in axes}
    problems += [
        Problem(
            f"--set {name}:{text}", None, "", None, f"there is no axis {name}; the axes are {', '.join(sorted(names))}"
        )
        for name, text in for_axes
        if name not in names and not problems
    ]
    problems += [
        Problem(f"--set {text}", None, "", None, f"that is a key of an axis: name the axis, {_choices(text, names)}")
        for text in for_none
    ]
    if problems:
        raise ConfigError(problems)
    config = machine.config
    return Machine(machine.source, config.service, config.realtime, settings.fault_reaction, tuple(axes), machine)


def _is_of_an_axis(override: str) -> bool:
    """Whether an argument is of a table that the files of the axes have, and that of the machine has not."""
    table = re.split(r"[.=]", override, maxsplit=1)[0].strip()
    return table in Config.model_fields and table not in MachineConfig.model_fields


def _choices(override: str, names: Collection[str]) -> str:
    shown = [f"--set {name}:{override}" for name in sorted(names)[:_MOST_CHOICES]]
    return " or ".join(shown) or "as in --set AXIS:KEY=VALUE"


def _load_axis(path: Path, for_axes: Sequence[tuple[str, ...]]) -> LoadedConfig[Config]:
    """Load an axis, which has to be valid alone: only then is its name known, and with it the arguments for it."""
    file = read_toml(path)
    loaded = validated(Config, file)
    name = loaded.config.axis.name
    overrides = [text for axis, text in for_axes if axis == name]
    return validated(Config, file, overrides) if overrides else loaded


def _problems_together(machine: LoadedConfig[MachineConfig], axes: Sequence[LoadedConfig[Config]]) -> Iterator[Problem]:
    seen: dict[str, str] = {}
    for loaded in axes:
        config = loaded.config
        name = config.axis.name
        if name == "all":
            yield from loaded.problem(("axis", "name"), "'all' means every axis; choose another name").problems
        if name in seen:
            text = f"{seen[name]} has an axis of this name too; give each axis its own name"
            yield from loaded.problem(("axis", "name"), text).problems
        seen[name] = loaded.source
        for table, default in (("service", ServiceSettings()), ("realtime", RealtimeSettings())):
            if getattr(config, table) not in (default, getattr(machine.config, table)):
                text = f"differs from that of {machine.source}, which takes precedence: remove it here"
                yield from loaded.problem((table,), text).problems
    for first, second in _different_settings_of_one_bus(axes):
        text = f"differs from that of {first.source}, but it is the same bus: give both the same settings"
        yield from second.problem(("bus",), text).problems


def _different_settings_of_one_bus(
    axes: Sequence[LoadedConfig[Config]],
) -> Iterator[tuple[LoadedConfig[Config], LoadedConfig[Config]]]:
    firsts: dict[tuple[str, str | int], LoadedConfig[Config]] = {}
    for loaded in axes:
        bus = loaded.config.bus
        first = firsts.setdefault((bus.interface, bus.channel), loaded)
        if first.config.bus != bus:
            yield first, loaded
