"""The table ``[service]``."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final, Literal

from pydantic import Field

from twostage_servo.settings.base import Settings, quantity

if TYPE_CHECKING:
    from twostage_servo.axis.design import AxisDesign


class ServiceSettings(Settings):
    """The tick, the control socket and the log."""

    tick_ms: float = quantity(
        10.0, unit="ms", description="Period of the loop and of the law's design", ge=1.0, le=100.0
    )
    socket: str = Field(
        "",
        description="Path of the control socket; empty for the user's runtime folder",
        max_length=100,
        pattern=r"^[^\x00-\x1f]*$",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="Least severe log line written")
    recording_s: float = quantity(
        2.0, unit="s", description="Length of the recording of the last ticks before a trip", ge=0.1, le=600.0
    )
    trip_folder: str = Field(
        "",
        description="Folder for the trip files, and for what laws have learned (axis.law.memory); empty for systemd's "
        "state directory or the user's own",
        max_length=1000,
        pattern=r"^[^\x00-\x1f]*$",
    )
    holder_lost: Literal["continue", "stop", "disarm"] = Field(
        "continue",
        description="What happens to a move when the connection that commanded it ends without releasing authority",
    )
    shutdown_timeout_ms: float = quantity(
        800.0,
        unit="ms",
        description="Longest time to brake when the service ends; the drive is disabled at the end of it. "
        "If absent, longer if the axes need it to stop",
        ge=0.0,
        le=60_000.0,
    )


_PATIENCE: Final = 2.0
"""How many times its designed duration a stop may take; by then it has failed in any case (trip `braking_failed`)."""
_LONGEST_MS: Final = 60_000.0
_AFTER_BRAKING_S: Final = 12.0
"""An opening of a bus that is under way is waited for, a trip file, and what laws have learned; the log is written."""


def stop_ms(design: "AxisDesign") -> float:
    """Return how long an axis takes to stop from its largest velocity, in ms."""
    limits = design.settings.limits
    return 1e3 * design.stopping_time_s(limits.velocity, limits.acceleration, smooth=True)


def with_time_to_stop(settings: ServiceSettings, designs: "Iterable[AxisDesign]") -> ServiceSettings:
    """Return settings with which every axis has the time to come to rest as the service ends, where none is stated.

    A heavy axis brakes for seconds. One whose drive is disabled before coasts on, and nothing brakes it.
    """
    if "shutdown_timeout_ms" in settings.model_fields_set:
        return settings
    longest_ms = min(_LONGEST_MS, _PATIENCE * max(map(stop_ms, designs), default=0.0))
    return settings.model_copy(update={"shutdown_timeout_ms": max(settings.shutdown_timeout_ms, longest_ms)})


def longest_end_s(settings: ServiceSettings, arming_timeouts_ms: Iterable[float]) -> float:
    """Return how long the service may take from the request to end until its process has ended, in s.

    The axes brake, and each drive then has its ``axis.arming_timeout_ms`` to report that it is disabled.
    """
    return (settings.shutdown_timeout_ms + max(arming_timeouts_ms, default=0.0)) / 1e3 + _AFTER_BRAKING_S
