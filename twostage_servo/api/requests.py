"""The control socket's requests: one JSON object a line, told apart by ``op``."""

from dataclasses import dataclass, field
from typing import ClassVar, Final, get_args

from twostage_servo.api.fields import Flag, JsonObject, Number, NumbersByName, Text, holds, kinds_of

MOST_PROBLEMS: Final = 5
"""Problems of a request that its refusal names."""

_FARTHEST: Final = 1e9
_POSITION: Final = Number(description="Absolute set-point", unit="axis unit", minimum=-_FARTHEST, maximum=_FARTHEST)


class BadRequestError(ValueError):
    """No request; the text says why, for whoever wrote it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Request:
    """What all requests have in common.

    Raises
    ------
    BadRequestError
        If a field does not hold what it should: what is wrong is told up to the fifth problem.
    """

    op: ClassVar[str]
    renamed_to: ClassVar[str] = ""
    """The name that takes the place of ``op``, where that is an old one."""

    def __post_init__(self) -> None:
        problems: list[str] = []
        for name, kind in kinds_of(type(self)).items():
            value = getattr(self, name)
            if value is None:
                continue
            if found := kind.problems(name, value):
                problems += found
            else:
                object.__setattr__(self, name, kind.taken(value))
        problems = problems or self._contradictions()
        if problems:
            raise BadRequestError("; ".join(problems[:MOST_PROBLEMS]))

    def _contradictions(self) -> list[str]:
        """Return what is wrong with fields that are right each by itself."""
        return []

    def to_json(self) -> JsonObject:
        """Return the request as it is sent; what is left out has its default."""
        fields = {name: value for name in kinds_of(type(self)) if (value := getattr(self, name)) is not None}
        return {"op": self.op, **fields}


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisRequest(_Request):
    """What is asked of an axis."""

    axis: str | None = field(
        default=None,
        metadata=holds(
            Text(description="Name of the axis; absent for the only one, or for all where that makes sense", longest=64)
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusRequest(AxisRequest):
    """Report the present state."""

    op: ClassVar[str] = "status"


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchRequest(AxisRequest):
    """Send a snapshot every so many ticks, until the client closes."""

    op: ClassVar[str] = "watch"
    every: int = field(
        default=10,
        metadata=holds(
            Number(description="Ticks between two snapshots", unit="ticks", minimum=1, maximum=10_000, whole=True)
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingRequest(AxisRequest):
    """Send the recording of the trip, or of the last ticks."""

    op: ClassVar[str] = "recording"


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmRequest(AxisRequest):
    """Enable the drive and hold."""

    op: ClassVar[str] = "arm"


@dataclass(frozen=True, slots=True, kw_only=True)
class DisarmRequest(AxisRequest):
    """Come to rest and disable the drive."""

    op: ClassVar[str] = "disarm"


@dataclass(frozen=True, slots=True, kw_only=True)
class StopRequest(AxisRequest):
    """Come to rest and hold."""

    op: ClassVar[str] = "stop"
    quick: bool = field(default=False, metadata=holds(Flag(description="With the quick stop deceleration")))


@dataclass(frozen=True, slots=True, kw_only=True)
class ResetRequest(AxisRequest):
    """Clear a trip."""

    op: ClassVar[str] = "reset"


@dataclass(frozen=True, slots=True, kw_only=True)
class MoveRequest(AxisRequest):
    """Take a set-point: `position` or, relative to the set-point in force, `by`; or one for several axes together.

    With `positions` the axes set out in the same tick, and all but the one that takes longest move more slowly, so that
    they arrive together.
    """

    op: ClassVar[str] = "move"
    position: float | None = field(default=None, metadata=holds(_POSITION))
    by: float | None = field(
        default=None,
        metadata=holds(
            Number(description="Relative set-point", unit="axis unit", minimum=-_FARTHEST, maximum=_FARTHEST)
        ),
    )
    velocity: float | None = field(
        default=None,
        metadata=holds(
            Number(
                description="Cruise velocity; the axis' usual one if absent",
                unit="axis unit/s",
                above=0.0,
                maximum=_FARTHEST,
            )
        ),
    )
    positions: dict[str, float] | None = field(
        default=None,
        metadata=holds(NumbersByName(description="Absolute set-points by the axes' names", number=_POSITION, most=64)),
    )

    def _contradictions(self) -> list[str]:
        if (self.position, self.by, self.positions).count(None) != 2:
            return ["give either position or by, or positions for several axes"]
        if self.positions is not None and self.axis is not None:
            return ["positions names its axes; leave axis out"]
        return []


@dataclass(frozen=True, slots=True, kw_only=True)
class JogRequest(AxisRequest):
    """Move for as long as this is asked for again within the jog time-out."""

    op: ClassVar[str] = "jog"
    velocity: float = field(
        metadata=holds(
            Number(
                description="Velocity, whose sign is the direction",
                unit="axis unit/s",
                minimum=-_FARTHEST,
                maximum=_FARTHEST,
            )
        )
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class HomeRequest(AxisRequest):
    """Look for the reference as ``[axis.homing]`` says; with `position`, say where the axis stands now."""

    op: ClassVar[str] = "home"
    position: float | None = field(
        default=None,
        metadata=holds(
            Number(
                description="Position of the place where the axis stands",
                unit="axis unit",
                minimum=-_FARTHEST,
                maximum=_FARTHEST,
            )
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseRequest(_Request):
    """Give control authority back."""

    op: ClassVar[str] = "release"


@dataclass(frozen=True, slots=True, kw_only=True)
class AcquireRequest(_Request):
    """Take control authority that nobody else holds."""

    op: ClassVar[str] = "acquire"


@dataclass(frozen=True, slots=True, kw_only=True)
class PreemptRequest(_Request):
    """Take control authority, also from another client while the axis is at rest."""

    op: ClassVar[str] = "preempt"


@dataclass(frozen=True, slots=True, kw_only=True)
class TakeRequest(PreemptRequest):
    """Do the same: this is its old name."""

    op: ClassVar[str] = "take"
    renamed_to: ClassVar[str] = PreemptRequest.op


@dataclass(frozen=True, slots=True, kw_only=True)
class ReloadRequest(_Request):
    """Read the configuration again, while the axis is disarmed."""

    op: ClassVar[str] = "reload"


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
    | AcquireRequest
    | PreemptRequest
    | TakeRequest
    | ReloadRequest
)

OPERATIONS: Final[dict[str, type[Request]]] = {one.op: one for one in get_args(Request)}
"""The requests by what they are told apart by."""

READING = (StatusRequest, WatchRequest, RecordingRequest)
"""Requests that change nothing, and are open to everybody."""
