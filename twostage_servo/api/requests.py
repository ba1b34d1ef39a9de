"""The control socket's requests: one JSON object a line, told apart by ``op``."""

from typing import Any, ClassVar, Final, dataclass_transform, get_args

from twostage_servo.api.fields import Flag, JsonObject, Kind, Number, NumbersByName, Text
from twostage_servo.api.plain import Plain
from twostage_servo.axis.moves import LARGEST_OVERRIDE

MOST_PROBLEMS: Final = 5
"""Problems of a request that its refusal names."""

_FARTHEST: Final = 1e9
_POSITION: Final = Number(description="Absolute set-point", unit="axis unit", minimum=-_FARTHEST, maximum=_FARTHEST)


class BadRequestError(ValueError):
    """No request; the text says why, for whoever wrote it."""


class _Field:
    """A field as it stands in the class of a request, until the class is made."""

    def __init__(self, kind: Kind, default: Any) -> None:
        self.kind = kind
        self.default = default


def holds(kind: Kind, *, default: Any = ...) -> Any:
    """Declare a field of this kind; without a default it has to be given."""
    return _Field(kind, default)


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(holds,))
class _Request(Plain):
    """What all requests have in common.

    Raises
    ------
    BadRequestError
        If a field does not hold what it should: what is wrong is told up to the fifth problem.
    """

    op: ClassVar[str]
    renamed_to: ClassVar[str] = ""
    """The name that takes the place of ``op``, where that is an old one."""
    kinds: ClassVar[dict[str, Kind]] = {}
    """What each field holds, by its name."""

    def __init_subclass__(cls) -> None:
        declared = {name: one for name, one in vars(cls).items() if isinstance(one, _Field)}
        cls.kinds = cls.kinds | {name: one.kind for name, one in declared.items()}
        for name, one in declared.items():
            if one.default is ...:
                delattr(cls, name)
            else:
                setattr(cls, name, one.default)
        super().__init_subclass__()

    def __init__(self, **values: Any) -> None:
        super().__init__(**values)
        fields, problems = self.__dict__, list[str]()
        for name, kind in self.kinds.items():
            value = fields[name]
            if value is None:
                continue
            if found := kind.problems(name, value):
                problems += found
            else:
                fields[name] = kind.validated(value)
        problems = problems or self._contradictions()
        if problems:
            raise BadRequestError("; ".join(problems[:MOST_PROBLEMS]))

    def _contradictions(self) -> list[str]:
        """Return what is wrong with fields that are right each by itself."""
        return []

    def to_json(self) -> JsonObject:
        """Return the request as it is sent; what is left out has its default."""
        return {"op": self.op} | {name: value for name in self.kinds if (value := self.__dict__[name]) is not None}


class AxisRequest(_Request):
    """What is asked of an axis."""

    axis: str | None = holds(
        Text(description="Name of the axis; absent for the only one, or for all where that makes sense", longest=64),
        default=None,
    )


class StatusRequest(AxisRequest):
    """Report the present state."""

    op: ClassVar[str] = "status"


class WatchRequest(AxisRequest):
    """Send a snapshot every so many ticks, until the client closes."""

    op: ClassVar[str] = "watch"
    every: int = holds(
        Number(description="Ticks between two snapshots", unit="ticks", minimum=1, maximum=10_000, whole=True),
        default=10,
    )


class RecordingRequest(AxisRequest):
    """Send the recording of the trip, or of the last ticks."""

    op: ClassVar[str] = "recording"


class ArmRequest(AxisRequest):
    """Enable the drive and hold."""

    op: ClassVar[str] = "arm"


class DisarmRequest(AxisRequest):
    """Come to rest and disable the drive."""

    op: ClassVar[str] = "disarm"


class StopRequest(AxisRequest):
    """Come to rest and hold."""

    op: ClassVar[str] = "stop"
    quick: bool = holds(Flag(description="With the quick stop deceleration"), default=False)


class ResetRequest(AxisRequest):
    """Clear a trip."""

    op: ClassVar[str] = "reset"


class MoveRequest(AxisRequest):
    """Move to a set-point: `position` or, relative to the set-point in force, `by`; or several axes together.

    With `positions` the axes set out in the same tick, and all but the one that takes longest move more slowly, so that
    they arrive together.
    """

    op: ClassVar[str] = "move"
    position: float | None = holds(_POSITION, default=None)
    by: float | None = holds(
        Number(description="Relative set-point", unit="axis unit", minimum=-_FARTHEST, maximum=_FARTHEST), default=None
    )
    velocity: float | None = holds(
        Number(
            description="Cruise velocity; the axis' usual one if absent",
            unit="axis unit/s",
            above=0.0,
            maximum=_FARTHEST,
        ),
        default=None,
    )
    positions: dict[str, float] | None = holds(
        NumbersByName(description="Absolute set-points by the axes' names", number=_POSITION, most=64), default=None
    )

    def _contradictions(self) -> list[str]:
        if (self.position, self.by, self.positions).count(None) != 2:
            return ["give either position or by, or positions for several axes"]
        if self.positions is not None and self.axis is not None:
            return ["positions names its axes; leave axis out"]
        return []


class JogRequest(AxisRequest):
    """Move for as long as this is asked for again within the jog time-out."""

    op: ClassVar[str] = "jog"
    velocity: float = holds(
        Number(
            description="Velocity, whose sign is the direction",
            unit="axis unit/s",
            minimum=-_FARTHEST,
            maximum=_FARTHEST,
        )
    )


class OverrideRequest(AxisRequest):
    """Move at a percentage of the speed that is asked for, now and until the axis is armed again; 0 holds it."""

    op: ClassVar[str] = "override"
    percent: float = holds(
        Number(description="Share of the speed of each move and jog", unit="%", minimum=0.0, maximum=LARGEST_OVERRIDE)
    )


class HomeRequest(AxisRequest):
    """Look for the reference as ``[axis.homing]`` says; with `position`, say where the axis stands now."""

    op: ClassVar[str] = "home"
    position: float | None = holds(
        Number(
            description="Position of the place where the axis stands",
            unit="axis unit",
            minimum=-_FARTHEST,
            maximum=_FARTHEST,
        ),
        default=None,
    )


class ForgetRequest(AxisRequest):
    """Forget what the law has learned of its plant, while the axis is at rest."""

    op: ClassVar[str] = "forget"


class ReleaseRequest(_Request):
    """Give control authority back."""

    op: ClassVar[str] = "release"


class AcquireRequest(_Request):
    """Acquire control authority that nobody else holds."""

    op: ClassVar[str] = "acquire"


class PreemptRequest(_Request):
    """Acquire control authority, also from another client while the axis is at rest."""

    op: ClassVar[str] = "preempt"


class TakeRequest(PreemptRequest):
    """Do the same: this is its old name."""

    op: ClassVar[str] = "take"
    renamed_to: ClassVar[str] = PreemptRequest.op


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
    | OverrideRequest
    | HomeRequest
    | ForgetRequest
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
