"""What one fault in one phase came to."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Cell:
    """What one fault in one phase came to; distances in axis unit.

    Attributes
    ----------
    fault, name, phase
        Which one, and what the axis did when it began.
    expected, observed
        Letters of the reactions, see :data:`~twostage_servo.faults.table.MEANINGS`; of several trips, that of the most
        severe.
    trip
        Code of the trip, or of the refusal; empty if there was none. Where a later trip was more severe, both codes:
        ``missed_ticks+drive_dropped_out``.
    travel
        How far the axis went after the fault: after a stop, from where it was when the fault or the last move began;
        where the fault is tolerated, the largest distance from where it would have been without it.
    bound
        How far it may.
    wrong
        What else is not as it should be; empty if nothing.
    axis
        The axis that has the fault; empty where the fault is one of the whole service.
    limit
        What one encoder cannot tell in this phase, where that is why the reaction is another one; else empty.
    """

    fault: int
    name: str
    phase: str
    expected: str
    observed: str
    trip: str
    travel: float
    bound: float
    wrong: str = ""
    axis: str = ""
    limit: str = ""

    @property
    def met(self) -> bool:
        """Whether reaction, travel and all else are as they should be, or the limit of one encoder is stated."""
        as_expected = self.observed == self.expected or bool(self.limit)
        return as_expected and self.travel <= self.bound and not self.wrong


@dataclass(frozen=True, slots=True)
class NotApplicable:
    """A cell that there cannot be on an axis, and why."""

    fault: int
    name: str
    phase: str
    reason: str
    axis: str = ""
