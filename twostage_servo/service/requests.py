"""The control socket's requests: one JSON object a line, told apart by ``op``."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, model_validator

from twostage_servo.settings import Settings, quantity


class StatusRequest(Settings):
    """Report the present state."""

    op: Literal["status"]


class WatchRequest(Settings):
    """Send a snapshot every so many ticks, until the client closes."""

    op: Literal["watch"]
    every: int = quantity(10, unit="ticks", description="Ticks between two snapshots", ge=1, le=10_000)


class RecordingRequest(Settings):
    """Send the recording of the trip, or of the last ticks."""

    op: Literal["recording"]


class ArmRequest(Settings):
    """Enable the drive and hold."""

    op: Literal["arm"]


class DisarmRequest(Settings):
    """Come to rest and disable the drive."""

    op: Literal["disarm"]


class StopRequest(Settings):
    """Come to rest and hold."""

    op: Literal["stop"]
    quick: bool = Field(default=False, description="With the quick stop deceleration")


class ResetRequest(Settings):
    """Clear a trip."""

    op: Literal["reset"]


class MoveRequest(Settings):
    """Take a set-point: `position` or, relative to the set-point in force, `by`."""

    op: Literal["move"]
    position: float | None = quantity(None, unit="axis unit", description="Absolute set-point", ge=-1e9, le=1e9)
    by: float | None = quantity(None, unit="axis unit", description="Relative set-point", ge=-1e9, le=1e9)
    velocity: float | None = quantity(
        None, unit="axis unit/s", description="Cruise velocity; the axis' usual one if absent", gt=0.0, le=1e9
    )

    @model_validator(mode="after")
    def _one_set_point(self) -> "MoveRequest":
        if (self.position is None) == (self.by is None):
            raise ValueError("give either position or by")
        return self


class JogRequest(Settings):
    """Move for as long as this is asked for again within the jog time-out."""

    op: Literal["jog"]
    velocity: float = quantity(unit="axis unit/s", description="Velocity, whose sign is the direction", ge=-1e9, le=1e9)


class HomeRequest(Settings):
    """Look for the reference as ``[axis.homing]`` says; with `position`, say where the axis stands now."""

    op: Literal["home"]
    position: float | None = quantity(
        None, unit="axis unit", description="Position of the place where the axis stands", ge=-1e9, le=1e9
    )


class ReleaseRequest(Settings):
    """Give the lease back."""

    op: Literal["release"]


class TakeRequest(Settings):
    """Take the lease, also from another client while the axis is at rest."""

    op: Literal["take"]


class ReloadRequest(Settings):
    """Read the configuration again, while the axis is disarmed."""

    op: Literal["reload"]


Request = (
    StatusRequest
    | WatchRequest
    | RecordingRequest
    | ArmRequest
    | DisarmRequest
    | StopRequest
    | ResetRequest
    | MoveRequest
    | JogRequest
    | HomeRequest
    | ReleaseRequest
    | TakeRequest
    | ReloadRequest
)

READING = (StatusRequest, WatchRequest, RecordingRequest)
"""Requests that change nothing, and are open to everybody."""

REQUESTS: TypeAdapter[Request] = TypeAdapter(Annotated[Request, Field(discriminator="op")])
