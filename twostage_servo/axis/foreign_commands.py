"""Commands to this axis' drive that somebody else has sent: two masters can't hold one axis."""

import math
from dataclasses import dataclass

from twostage_servo.axis.settings import AxisSettings


@dataclass(slots=True)
class Latest:
    """The latest foreign command.

    Attributes
    ----------
    frame
        What it was, and what it asks for, in words; empty before the first.
    enables
        Whether it enables the drive; None where that cannot be read from it.
    frames
        How many have come in a row.
    ticks_since
        Ticks since it came; None before the first.
    """

    frame: str = ""
    enables: bool | None = None
    frames: int = 0
    ticks_since: int | None = None


class ForeignCommands:
    """Remembers them for as long as arming may take (``axis.arming_timeout_ms``) after the latest one.

    Parameters
    ----------
    settings
        The axis.
    period_s
        Length of a tick in s.

    Attributes
    ----------
    latest
        The latest one.
    """

    __slots__ = ("_period_ms", "_ticks_lasting", "latest")

    def __init__(self, settings: AxisSettings, period_s: float) -> None:
        self.latest = Latest()
        self._period_ms = 1e3 * period_s
        self._ticks_lasting = math.ceil(settings.arming_timeout_ms / self._period_ms)

    def begin_tick(self, missed: int) -> None:
        """Open a tick, before which so many were missed."""
        latest = self.latest
        if latest.ticks_since is not None:
            latest.ticks_since += 1 + missed

    def record(self, frame: str, *, enables: bool | None) -> None:
        """Record one; see :class:`Latest`."""
        self.latest = Latest(frame, enables, self.latest.frames + 1 if self.lasts else 1, 0)

    def continue_from(self, former: "ForeignCommands") -> None:
        """Continue from the state of a former one of the same drive."""
        self.latest = former.latest

    @property
    def lasts(self) -> bool:
        """Whether the latest one came so lately that more have to be expected."""
        return (ticks := self.latest.ticks_since) is not None and ticks < self._ticks_lasting

    def came_within(self, duration_ms: float) -> bool:
        """Whether the latest one is no older than so many ms."""
        return (ticks := self.latest.ticks_since) is not None and self._period_ms * ticks <= duration_ms

    def __str__(self) -> str:
        """Return the latest one, and how many there were and how long ago, unless it is the first, and of this tick."""
        age_ms = self._period_ms * (self.latest.ticks_since or 0)
        if self.latest.frames == 1 and not age_ms:
            return self.latest.frame
        return f"{self.latest.frame} (frame {self.latest.frames}, {age_ms:g} ms ago)"
