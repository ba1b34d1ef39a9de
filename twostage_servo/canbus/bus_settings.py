"""Settings of the bus: which interface of python-can, and how it is opened."""

import difflib
from typing import Any, Final

import can
from pydantic import Field, field_validator, model_validator

from twostage_servo.canbus.bus_load import most_frames
from twostage_servo.settings.base import Settings, quantity

_OWN_ARGUMENTS: Final = frozenset(
    {"interface", "channel", "bitrate", "can_filters", "ignore_config", "config_context", "receive_own_messages", "fd"}
)
_FD: Final = frozenset({"socketcan", "virtual"})
_LEAST_FRAMES_READ: Final = 64
"""What adapters and networks that hand frames over in lots may bring to a short tick at once."""
_NO_BITRATE: Final = frozenset({"socketcand", "udp_multicast", "virtual"})


class BusSettings(Settings):
    """The bus and how it is opened."""

    interface: str = Field(
        description="Interface of python-can: socketcan, socketcand, udp_multicast, virtual, pcan, ..."
    )
    channel: str | int = Field(description="Channel of the interface, such as can0")
    bitrate: int | None = quantity(
        None,
        unit="bit/s",
        description="Bit rate, for interfaces that set it; with socketcan the rate set by 'ip link', to check the load",
        gt=0,
        le=1_000_000,
    )
    fd: bool = Field(
        default=False, description="Whether the frames are CAN FD frames; the interface must be set up for them"
    )
    bit_rate_switch: bool = Field(
        default=False, description="Whether CAN FD frames are sent with the higher bit rate for their data"
    )
    options: dict[str, bool | int | float | str] = Field(
        default_factory=dict, description="Further arguments of the python-can interface, passed unchanged"
    )
    max_frames_per_tick: int | None = quantity(
        None,
        unit="frames",
        description="Most frames read in one tick; default: twice what the bus can carry in a tick, at least 64",
        ge=1,
        le=10_000,
    )
    reopen_interval_ms: float = quantity(
        1000.0, unit="ms", description="Time between two attempts to open the bus", ge=10.0, le=60_000.0
    )

    def frames_carried(self, duration_s: float) -> int:
        """Return how many frames at most this bus can carry in a time in s: at 1 Mbit/s where no bit rate is given."""
        return most_frames(duration_s, self.bitrate, fd=self.fd)

    def frames_read(self, tick_s: float) -> int:
        """Return how many frames are read at most in a tick of so many seconds.

        By default twice what the bus can carry, so that a backlog shrinks even on a bus that is full.
        """
        if self.max_frames_per_tick is not None:
            return self.max_frames_per_tick
        return max(_LEAST_FRAMES_READ, 2 * self.frames_carried(tick_s))

    def with_frames_of(self, other: "BusSettings") -> "BusSettings":
        """Return this bus, for the kind of frames that another one carries: classic ones or CAN FD."""
        return self.model_copy(update={"fd": other.fd, "bit_rate_switch": other.bit_rate_switch})

    @field_validator("interface")
    @classmethod
    def _is_known(cls, interface: str) -> str:
        if interface not in can.VALID_INTERFACES:
            near = difflib.get_close_matches(interface, can.VALID_INTERFACES, n=1)
            guess = f"; did you mean {near[0]}?" if near else "."
            raise ValueError(
                f"python-can has no such interface{guess} Its interfaces: {', '.join(sorted(can.VALID_INTERFACES))}"
            )
        return interface

    @field_validator("options")
    @classmethod
    def _has_no_argument_of_ours(cls, options: dict[str, Any]) -> dict[str, Any]:
        if clash := sorted(_OWN_ARGUMENTS & options.keys()):
            raise ValueError(
                f"{', '.join(clash)} cannot be set here; interface, channel and bitrate have keys of their own"
            )
        return options

    @model_validator(mode="after")
    def _bitrate_has_an_effect(self) -> "BusSettings":
        if self.bitrate is not None and self.interface in _NO_BITRATE:
            raise ValueError(f"bitrate has no effect on interface {self.interface!r}; remove it")
        return self

    @model_validator(mode="after")
    def _fd_is_possible(self) -> "BusSettings":
        if self.bit_rate_switch and not self.fd:
            raise ValueError("bit_rate_switch has an effect on CAN FD frames only; set fd = true, or remove it")
        if self.fd and self.interface not in _FD:
            raise ValueError(f"fd is not possible on interface {self.interface!r}, only on {', '.join(sorted(_FD))}")
        if self.fd and self.bitrate is not None:
            raise ValueError("bitrate serves only the load check with classic frames; with fd = true, remove it")
        return self
