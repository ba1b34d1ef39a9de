"""The schema of a tick: what is kept of one, by name, type and unit.

Whatever has columns takes them from here: the recording, the trip files, the CSV files of `status` and `demo`.
"""

import typing
from dataclasses import dataclass
from typing import Annotated, Any, Final, NamedTuple

from twostage_servo.axis.state import State


@dataclass(frozen=True, slots=True)
class Column:
    """What a column tells.

    Attributes
    ----------
    unit
        Of its numbers; ``axis unit`` and ``effort unit`` are those of the configuration, empty for none.
    meaning
        In a few words.
    """

    unit: str
    meaning: str


class Sample(NamedTuple):
    """One tick as the loop saw it."""

    tick: Annotated[int, Column("", "Index of the tick: whole periods since the service started")]
    missed: Annotated[int, Column("", "Ticks missed since the previous one")]
    lateness_us: Annotated[float, Column("µs", "Time from the deadline of the tick to its start")]
    state: Annotated[State, Column("", "State of the axis")]
    measured_position: Annotated[float | None, Column("axis unit", "Newest position that the drive reported")]
    position: Annotated[float, Column("axis unit", "Estimated position")]
    velocity: Annotated[float, Column("axis unit/s", "Estimated velocity")]
    disturbance: Annotated[float, Column("effort unit", "Estimated disturbance")]
    effort: Annotated[float, Column("effort unit", "Effort that was sent")]
    target: Annotated[float, Column("axis unit", "Set-point in force")]
    speed_reference: Annotated[float, Column("axis unit/s", "Velocity that the law asks for")]
    following_error: Annotated[float, Column("axis unit", "Distance of the axis from its nominal response")]
    time_s: Annotated[float, Column("s", "When the tick was due, since the service started")]


FIELDS: Final = Sample._fields
"""The names of the columns, in their order."""

COLUMNS: Final[dict[str, Column]] = {
    name: hint.__metadata__[0] for name, hint in typing.get_type_hints(Sample, include_extras=True).items()
}
"""What each column tells."""

TYPES: Final[dict[str, Any]] = typing.get_type_hints(Sample)
"""The type of each column."""
