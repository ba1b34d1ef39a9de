"""A small tree of settings with one field of every kind, and a valid file for it."""

from pathlib import Path
from typing import Literal

import pytest
from pydantic import Field, model_validator

from twostage_servo.config.errors import ConfigError, Problem
from twostage_servo.config.loader import load_as
from twostage_servo.settings.base import Settings, quantity


class Limits(Settings):
    velocity: float = quantity(unit="axis unit/s", description="Largest cruise velocity", gt=0, le=1e4)
    overspeed: float = quantity(unit="axis unit/s", description="Speed at which the axis trips", gt=0, lt=1e4)
    missed_ticks: int = quantity(3, unit="ticks", description="Ticks missed in one go", ge=0, le=1000)

    @model_validator(mode="after")
    def _consistent(self) -> "Limits":
        if self.overspeed <= self.velocity:
            raise ValueError(f"overspeed = {self.overspeed:g} is not above velocity = {self.velocity:g}")
        return self


class Waypoint(Settings):
    position: float = quantity(unit="axis unit", description="Where to", ge=-100, le=100)


class Axis(Settings):
    unit: str = Field(description="Unit of position", min_length=1, max_length=4)
    home: Literal["index", "switch"] = Field("index", description="How the zero is found")
    fault: str | Literal[False] = Field("Fault", description="Signal of the fault bit")
    ratio: float | None = quantity(None, unit="1", description="Gear ratio", gt=0, le=100)
    code: str = Field("A1", description="Order code", pattern="^[A-Z][0-9]$")
    gains: list[float] = Field([1.0], description="Gains", min_length=1, max_length=3)
    limits: Limits = Field(description="What the axis must never exceed")
    waypoints: list[Waypoint] = Field([], description="Stations")


class Bus(Settings):
    channel: str | int = Field("vcan0", description="Channel of the interface")
    options: dict[str, str | int | float | bool] = Field({}, description="Further options of the interface")
    listen_only: bool = Field(default=False, description="Never send")


class Machine(Settings):
    bus: Bus = Bus()
    axis: Axis = Field(description="The drive")


VALID = """\
# a machine
[bus]
channel = "can0"
options = { tcp_tune = true, "receive buffer" = 4096 }

[axis]
unit = "mm"
home = "switch"
fault = false
gains = [
    1.0,  # first
    2.5,
]

[axis.limits]
velocity = 900.0
overspeed = 1100.0

[[axis.waypoints]]
position = 1.0

[[axis.waypoints]]
position = 2.0
"""


def write(content: str | bytes) -> Path:
    """Write ``axis.toml`` in the current folder."""
    path = Path("axis.toml")
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def refused(path: Path, *overrides: str) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        load_as(Machine, path, overrides)
    return caught.value


def only_problem(path: Path, *overrides: str) -> Problem:
    [problem] = refused(path, *overrides).problems
    return problem
