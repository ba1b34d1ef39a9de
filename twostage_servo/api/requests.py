"""The control socket's requests: one JSON object a line, told apart by ``op``."""

from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, model_validator

from twostage_servo.settings.base import Settings, quantity

Position = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]


class _Request(Settings):
    """What all requests have in common."""

    @model_validator(mode="before")
    @classmethod
    def _no_null(cls, fields: Any) -> Any:
        """Refuse null, which JSON writers make of NaN: a field left out means something else."""
        for name, value in fields.items() if isinstance(fields, dict) else ():
            if value is None:
                raise ValueError(f"{name} is null: give it a value, or leave it out")
        return fields


class AxisRequest(_Request):
    """What is asked of an axis."""

    axis: str | None = Field(
        None, description="Name of the axis; absent for the only one, or for all where that makes sense", max_length=64
    )


class StatusRequest(AxisRequest):
    """Report the present state."""

    op: Literal["status"]


class WatchRequest(AxisRequest):
    """Send a snapshot every so many ticks, until the client closes."""

    op: Literal["watch"]
    every: int = quantity(10, unit="ticks", description="Ticks between two snapshots", ge=1, le=10_000)


class RecordingRequest(AxisRequest):
    """Send the recording of the trip, or of the last ticks."""

    op: Literal["recording"]


class ArmRequest(AxisRequest):
    """Enable the drive and hold."""

    op: Literal["arm"]


class DisarmRequest(AxisRequest):
    """Come to rest and disable the drive."""

    op: Literal["disarm"]


class StopRequest(AxisRequest):
    """Come to rest and hold."""

    op: Literal["stop"]
    quick: bool = Field(default=False, description="With the quick stop deceleration")


class ResetRequest(AxisRequest):
    """Clear a trip."""

    op: Literal["reset"]


class MoveRequest(AxisRequest):
    """Take a set-point: `position` or, relative to the set-point in force, `by`; or one for several axes together.

    With `positions` the axes set out in the same tick, and all but the one that takes longest move more slowly, so that
    they arrive together.
    """

    op: Literal["move"]
    position: float | None = quantity(None, unit="axis unit", description="Absolute set-point", ge=-1e9, le=1e9)
    by: float | None = quantity(None, unit="axis unit", description="Relative set-point", ge=-1e9, le=1e9)
    velocity: float | None = quantity(
        None, unit="axis unit/s", description="Cruise velocity; the axis' usual one if absent", gt=0.0, le=1e9
    )

    positions: dict[str, Position] | None = Field(
        None, description="Absolute set-points by the axes' names", min_length=1, max_length=64
    )

    @model_validator(mode="after")
    def _one_set_point(self) -> "MoveRequest":
        if (self.position, self.by, self.positions).count(None) != 2:
            raise ValueError("give either position or by, or positions for several axes")
        if self.positions is not None and self.axis is not None:
            raise ValueError("positions names its axes; leave axis out")
        return self


class JogRequest(AxisRequest):
    """Move for as long as this is asked for again within the jog time-out."""

    op: Literal["jog"]
    velocity: float = quantity(unit="axis unit/s", description="Velocity, whose sign is the direction", ge=-1e9, le=1e9)


class HomeRequest(AxisRequest):
    """Look for the reference as ``[axis.homing]`` says; with `position`, say where the axis stands now."""

    op: Literal["home"]
    position: float | None = quantity(
        None, unit="axis unit", description="Position of the place where the axis stands", ge=-1e9, le=1e9
    )


class ReleaseRequest(_Request):
    """Give the lease back."""

    op: Literal["release"]


class TakeRequest(_Request):
    """Take the lease, also from another client while the axis is at rest."""

    op: Literal["take"]


class ReloadRequest(_Request):
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
