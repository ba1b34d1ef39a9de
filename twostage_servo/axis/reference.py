"""What the positions of an axis count from, and why that is no longer known."""

import enum

NEVER_HOMED = "the axis has not been homed since the service started"


class ReferenceSource(enum.StrEnum):
    """On what the positions of an axis rest."""

    ENCODER = "encoder"
    """They are those that the encoder counts; nobody has homed the axis."""
    HOMED = "homed"
    """A homing has found the place from which they count, or an operator has said where the axis stands."""


class Reference:
    """Keeps on what positions rest, and why they cannot be trusted where they cannot.

    Parameters
    ----------
    required
        Whether the axis has to be homed before its positions count (``axis.homing.required``).

    Attributes
    ----------
    source
        On what positions rest; None while they cannot be trusted.
    lost_because
        Why they cannot be trusted; empty while they can.
    """

    __slots__ = ("lost_because", "source")

    def __init__(self, *, required: bool) -> None:
        self.source: ReferenceSource | None = None if required else ReferenceSource.ENCODER
        self.lost_because = NEVER_HOMED if required else ""

    @property
    def is_homed(self) -> bool:
        """Whether positions count from a place that a homing has found, or an operator has told."""
        return self.source is ReferenceSource.HOMED

    def find(self) -> None:
        """Record that the origin of the positions is known now."""
        self.source, self.lost_because = ReferenceSource.HOMED, ""

    def lose(self, reason: str) -> None:
        """Trust positions no more; the first reason stays, since it is what the operator has to deal with."""
        if self.source is not None:
            self.source, self.lost_because = None, reason

    def continue_from(self, former: "Reference") -> None:
        """Continue from the state of a former one of the same axis."""
        self.source, self.lost_because = former.source, former.lost_because
