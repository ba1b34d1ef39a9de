"""Settings of the simulated drive: the *true* plant, apart from the law's model, and what goes wrong with it."""

from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from twostage_servo.settings.base import Settings, quantity


def _place(description: str) -> Any:
    return quantity(None, unit="axis unit", description=description, ge=-1e9, le=1e9)


_LOWEST_RESONANCE_HZ = 0.1
"""Below it the load would hardly follow the drive within a move."""


class SimulationSettings(Settings):
    """The ``[simulation]`` table."""

    gain: float = quantity(
        180.0, unit="axis unit/(effort unit s²)", description="True gain of the plant.", ge=-1e9, le=1e9
    )
    pole: float = quantity(14.0, unit="1/s", description="True pole of the plant: friction over mass.", gt=0, le=1e6)
    coulomb_friction: float = quantity(
        0.0,
        unit="effort unit",
        description="Dry friction: the effort below which the axis at rest does not move.",
        ge=0,
        le=1e6,
    )
    resonance_hz: float = quantity(
        0.0,
        unit="Hz",
        description="Frequency at which the load, with the encoder on it, swings against the drive; 0: fixed to it.",
        ge=0,
        le=10_000,
    )
    resonance_damping: float = quantity(
        0.02, unit="1", description="Damping ratio of that resonance.", ge=0.0001, le=0.99
    )
    backlash: float = quantity(
        0.0,
        unit="axis unit",
        description="Play between the drive and the load with the encoder: the whole width of the gap.",
        ge=0,
        le=1e9,
    )
    load: float = quantity(
        0.0, unit="effort unit", description="Constant load; positive opposes positive effort.", ge=-1e6, le=1e6
    )
    load_at_s: float = quantity(
        0.0, unit="s", description="Time from the start of the drive until the load sets in.", ge=0, le=1e9
    )
    initial_position: float = quantity(
        0.0, unit="axis unit", description="True position at the start of the drive.", ge=-1e9, le=1e9
    )
    hard_stop_minimum: float | None = _place("Hard stop at the end of smaller positions; absent: none.")
    hard_stop_maximum: float | None = _place("Hard stop at the end of larger positions; absent: none.")
    negative_limit_from: float | None = _place("The negative limit switch is active from here down; absent: none.")
    positive_limit_from: float | None = _place("The positive limit switch is active from here up; absent: none.")
    home_switch_from: float | None = _place("The home switch is active from here up; absent: none.")
    home_switch_to: float | None = _place("The home switch is active from here down; absent: none.")
    index_at: float | None = _place("True position of an index mark of the encoder; absent: none.")
    index_pitch: float = quantity(
        0.0, unit="axis unit", description="Distance between index marks; 0 for a single mark.", ge=0, le=1e9
    )
    noise_std: float = quantity(
        0.0,
        unit="axis unit",
        description="Standard deviation of the noise on the measured position.",
        ge=0,
        le=1e9,
    )
    quantum: float = quantity(
        0.001, unit="axis unit", description="Resolution of the encoder; 0 for one without steps.", ge=0, le=1e9
    )
    delay_ms: float = quantity(
        0.0,
        unit="ms",
        description="Transport delay from the arrival of a command until its effort acts.",
        ge=0,
        le=1000,
    )
    frame_loss: float = quantity(
        0.0,
        unit="1",
        description="Probability that a frame is lost at the drive, for each frame in either direction.",
        ge=0,
        le=1,
    )
    command_timeout_ms: float = quantity(
        50.0,
        unit="ms",
        description="Silence of the controller after which the enabled drive disables itself.",
        gt=0,
        le=10_000,
    )
    feedback: Literal["on_command", "cyclic"] = Field(
        "on_command",
        description="When the drive samples and reports its position: in answer to each command, or free-running.",
    )
    feedback_period_ms: float = quantity(
        10.0,
        unit="ms",
        description="Period of free-running feedback; with on_command, the silence after which the drive reports.",
        gt=0,
        le=10_000,
    )
    heartbeat_ms: float = quantity(100.0, unit="ms", description="Period of the drive's heartbeat.", gt=0, le=60_000)
    cycle_ms: float = quantity(
        1.0,
        unit="ms",
        description="Period of the drive's firmware cycle, at which it reads and writes the bus.",
        gt=0,
        le=1000,
    )
    seed: int = quantity(1, unit="1", description="Seed of the noise and of the lost frames.", ge=0, le=2**63 - 1)
    hub: bool = Field(
        default=True,
        description="Serve the loopback bus of [bus] from the drive's process when its interface is socketcand.",
    )

    @field_validator("gain")
    @classmethod
    def _drivable(cls, value: float) -> float:
        if value == 0.0:
            raise ValueError("effort would not move this plant; give a gain, such as 180")
        return value

    @field_validator("resonance_hz")
    @classmethod
    def _swings_in_a_run(cls, value: float) -> float:
        if 0.0 < value < _LOWEST_RESONANCE_HZ:
            raise ValueError(
                f"{value:g} Hz is no resonance of a drive: give {_LOWEST_RESONANCE_HZ:g} Hz or more, or 0 for a load "
                "that is fixed to the drive"
            )
        return value

    @field_validator("quantum")
    @classmethod
    def _none_or_sensible(cls, value: float) -> float:
        if 0.0 < value < 1e-9:
            raise ValueError("the resolution of an encoder must be at least 1e-9, or 0 for one without steps")
        return value

    @model_validator(mode="after")
    def _places_fit(self) -> "SimulationSettings":
        for lower, upper in (
            ("hard_stop_minimum", "hard_stop_maximum"),
            ("negative_limit_from", "positive_limit_from"),
            ("home_switch_from", "home_switch_to"),
        ):
            low, high = getattr(self, lower), getattr(self, upper)
            if low is not None and high is not None and low >= high:
                raise ValueError(f"{lower} = {low:g} is not below {upper} = {high:g}")
        if (self.home_switch_from is None) != (self.home_switch_to is None):
            raise ValueError("home_switch_from and home_switch_to are the two ends of one switch: give both or neither")
        if self.index_pitch and self.index_at is None:
            raise ValueError(f"index_pitch = {self.index_pitch:g} without index_at: set it to the position of one mark")
        if self.hard_stop_minimum is not None and self.hard_stop_maximum is not None:
            way = self.hard_stop_maximum - self.hard_stop_minimum
            if self.backlash >= way:
                raise ValueError(
                    f"backlash = {self.backlash:g} is not below the way of {way:g} between the hard stops: the load "
                    "would never move"
                )
        for stop, sign in ((self.hard_stop_minimum, -1.0), (self.hard_stop_maximum, 1.0)):
            if stop is not None and (self.initial_position - stop) * sign > 0.0:
                raise ValueError(f"initial_position = {self.initial_position:g} is beyond the hard stop at {stop:g}")
        return self
