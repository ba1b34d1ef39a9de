"""The state of the service and of its axes, as ``status`` and ``watch`` tell it.

Positions are in the axis' unit, velocities in that unit per second, efforts in its effort unit; times say their unit.
"""

from typing import Self

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.law_status import LawStatus
from twostage_servo.api.plain import Plain
from twostage_servo.api.records import JsonRecord
from twostage_servo.axis.moves import MoveKind, MoveOutcome
from twostage_servo.axis.reference import ReferenceSource
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode


class AxisStatus(JsonRecord):
    """What an axis does, measures, estimates and sends.

    Attributes
    ----------
    state, cia402
        Its state, and the state of CiA 402 that this refines.
    referenced, reference, reference_lost
        Whether it takes set-points; what its positions rest on (``encoder``, ``homed``); why they are not known.
    position, feedback_age_ms
        Measured position, None while the feedback is stale; age of the newest fresh feedback.
    velocity, disturbance, target
        Estimates, and the set-point; None while the law does not run.
    effort, following_error, saturated
        What was sent; how far the axis is from where it should be; whether the effort is at its limit.
    override_percent
        The speed override in force; 100 while the law does not run.
    """

    name: str
    unit: str
    effort_unit: str
    state: State
    cia402: str
    referenced: bool
    reference: ReferenceSource | None
    reference_lost: str | None
    position: float | None
    feedback_age_ms: float | None
    velocity: float | None
    disturbance: float | None
    effort: float
    target: float | None
    following_error: float
    saturated: bool
    override_percent: float


class MoveStatus(JsonRecord):
    """The latest motion that was asked for; ``number`` tells motions apart."""

    number: int
    start: float
    target: float
    velocity: float
    outcome: MoveOutcome
    kind: MoveKind
    reason: str | None


class TripStatus(JsonRecord):
    """A trip: its code, its cause with the numbers, and what to do next.

    Attributes
    ----------
    tick
        Index of the tick in which it happened.
    reaction
        What became of the motion: the name of the reaction in small letters.
    escalation, codes
        Code of a later, more severe trip; codes of all since the last reset.
    file, file_error
        Where the last ticks were written, or why they were not.
    """

    code: TripCode
    cause: str
    next_action: str
    tick: int
    reaction: str
    escalation: TripCode | None
    codes: list[TripCode]
    file: str | None
    file_error: str | None


class Trouble(JsonRecord):
    """What is wrong with a drive at this moment."""

    code: TripCode
    cause: str
    next_action: str


class DriveStatus(JsonRecord):
    """What a drive says of itself.

    Attributes
    ----------
    enabled
        By its newest feedback, however old that is; None where it does not tell.
    disabling
        Whether it was told to disable, and still has time to report it.
    moved
        How far the axis has moved since then beyond what coasting explains; None where it has not.
    lasting
        What is wrong with it at this moment.
    """

    enabled: bool | None
    disabling: bool
    moved: float | None
    lasting: list[Trouble]


class InputStatus(JsonRecord):
    """Whether the drive's inputs are active; None where it does not report one."""

    safe_torque_off: bool | None
    positive_limit: bool | None
    negative_limit: bool | None
    home_switch: bool | None


class Times(JsonRecord):
    """Percentiles of times, and the longest one, in µs."""

    p50: float
    p90: float
    p99: float
    max: float


class FrameStatus(JsonRecord):
    """Frames of an axis' bus, counted since the start; ``docs/control-socket.md`` tells what each counts."""

    received: int
    sent: int
    rejected: int
    rejected_by_reason: dict[str, int]
    dropped: int
    errors: int
    errors_by_kind: dict[str, int]
    overflowed: int
    overruns: int
    late: int
    lost: int
    doubled: int
    reordered: int
    implausible: int
    recent_errors: int
    predicted: int
    age_us: Times | None
    feedback_to_command_us: Times | None


class BusStatus(JsonRecord):
    """An axis' bus: whether it is open, or why not; its controller, and the drive's state by its heartbeat."""

    channel: str | int
    open: bool
    error: str | None
    drive_state: int | None
    controller: str
    error_counters: tuple[int, ...] | None


class AxisReport(JsonRecord):
    """All that is told of one axis."""

    axis: AxisStatus
    move: MoveStatus | None
    trip: TripStatus | None
    drive: DriveStatus
    inputs: InputStatus
    frames: FrameStatus
    bus: BusStatus
    law: LawStatus


class AuthorityStatus(JsonRecord):
    """Who commands: process, user and number of the connection, or None."""

    holder: str | None


class HistogramBin(JsonRecord):
    """Ticks that came so late, and later than the bin before."""

    up_to_us: float
    ticks: int


class TickStatus(JsonRecord):
    """Ticks since the start: how many, how many were missed, how late they came, and how long their phases took."""

    count: int
    missed: int
    lateness_us: Times
    lateness_histogram: list[HistogramBin]
    duration_us: dict[str, Times]


class Refusal(JsonRecord):
    """What the kernel did not grant, and what to do about it."""

    what: str
    asked: str
    why: str
    remedy: str


class GarbageStatus(JsonRecord):
    """Collections of garbage between the ticks."""

    collections: int
    postponed: int
    longest_us: float


class RealtimeStatus(JsonRecord):
    """How the host lets the service be punctual."""

    busy_wait: str | float
    margin_us: float
    output_offset: str | float
    output_offset_us: float | None
    granted: dict[str, str]
    refused: list[Refusal]
    garbage: GarbageStatus | None


class ServiceStatus(JsonRecord):
    """What all axes have in common; ``realtime`` is None in simulated time."""

    version: str
    pid: int
    uptime_s: float
    authority: AuthorityStatus
    ticks: TickStatus
    realtime: RealtimeStatus | None


class Status(Plain):
    """What ``status`` answers, and what ``watch`` tells again and again.

    Attributes
    ----------
    service
        What all axes have in common.
    axes
        The report of each axis that was asked for, by its name.
    """

    service: ServiceStatus
    axes: dict[str, AxisReport]

    @property
    def only(self) -> AxisReport:
        """The report of the only axis.

        Raises
        ------
        LookupError
            If this tells of several.
        """
        if len(self.axes) != 1:
            names = ", ".join(self.axes)
            raise LookupError(f"this status has several axes ({names}): use `axes`, or name one")
        return next(iter(self.axes.values()))

    @property
    def axis(self) -> AxisStatus:
        """The only axis."""
        return self.only.axis

    @property
    def move(self) -> MoveStatus | None:
        """The latest motion of the only axis."""
        return self.only.move

    @property
    def trip(self) -> TripStatus | None:
        """The trip of the only axis."""
        return self.only.trip

    def to_json(self) -> JsonObject:
        """Return the object of JSON: reports of several axes stand under ``axes``, that of one beside the rest."""
        common = self.service.to_json()
        if len(self.axes) == 1:
            return common | self.only.to_json()
        return common | {"axes": {name: report.to_json() for name, report in self.axes.items()}}

    @classmethod
    def from_json(cls, fields: JsonObject) -> Self:
        """Return the status that an object of JSON is.

        Raises
        ------
        UnreadableError
            If it is none.
        """
        if "axes" in fields:
            axes = {name: AxisReport.from_json(report) for name, report in fields["axes"].items()}
        else:
            report = AxisReport.from_json(fields)
            axes = {report.axis.name: report}
        return cls(service=ServiceStatus.from_json(fields), axes=axes)


class Recording(Plain):
    """The last ticks, or those before the trip.

    Attributes
    ----------
    fields
        Names of what is recorded of a tick.
    records
        The ticks, oldest first, each with its values in this order; None for what is not known.
    """

    fields: list[str]
    records: list[list[float | int | str | bool | None]]

    @classmethod
    def from_json(cls, fields: JsonObject) -> Self:
        """Return the recording that an object of JSON is."""
        return cls(fields=list(fields["fields"]), records=list(fields["records"]))
