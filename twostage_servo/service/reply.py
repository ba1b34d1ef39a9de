"""Who asks, and what becomes of what he asks."""

from collections.abc import Iterator
from typing import NamedTuple, Protocol

from twostage_servo.service.axis_loop import AxisLoop


class Asker(Protocol):
    """Who asks."""

    @property
    def peer(self) -> str:
        """Name of the connection."""

    @property
    def arrived_after_s(self) -> float:
        """When there was nothing of the request yet, s."""

    @property
    def gone(self) -> bool:
        """Whether nobody is there any more."""


class Reply(NamedTuple):
    """What becomes of a request: its answer, made piece by piece, and whether it was carried out.

    Attributes
    ----------
    pieces
        The answer; a request that was dropped has none.
    done
        Whether it was carried out.
    axis
        The axis that it was for; None for all of several.
    """

    pieces: Iterator[bytes]
    done: bool
    axis: AxisLoop | None = None
