"""Commands to this axis' drive that somebody else has sent: two masters can't hold one axis."""

import math

from twostage_servo.axis.settings import AxisSettings


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
    frame
        The latest one, and what it asks for, in words; empty before the first.
    enables
        Whether the latest one enables the drive; None where that cannot be read from it.
    """

    __slots__ = ("_frames", "_period_ms", "_ticks_lasting", "_ticks_since", "enables", "frame")

    def __init__(self, settings: AxisSettings, period_s: float) -> None:
        self.frame = ""
        self.enables: bool | None = None
        self._frames = 0
        self._ticks_since: int | None = None
        self._period_ms = 1e3 * period_s
        self._ticks_lasting = math.ceil(settings.arming_timeout_ms / self._period_ms)

    def begin_tick(self, missed: int) -> None:
        """Open a tick, before which so many were missed."""
        if self._ticks_since is not None:
            self._ticks_since += 1 + missed

    def take(self, frame: str, *, enables: bool | None) -> None:
        """Take one; see the attributes."""
        self._frames = self._frames + 1 if self.lasts else 1
        self.frame, self.enables, self._ticks_since = frame, enables, 0

    def take_over(self, former: "ForeignCommands") -> None:
        """Know what a former one of the same drive knew."""
        for name in ("_frames", "_ticks_since", "enables", "frame"):
            setattr(self, name, getattr(former, name))

    @property
    def lasts(self) -> bool:
        """Whether the latest one came so lately that more have to be expected."""
        return self._ticks_since is not None and self._ticks_since < self._ticks_lasting

    def came_within(self, duration_ms: float) -> bool:
        """Whether the latest one is no older than so many ms."""
        return self._ticks_since is not None and self._period_ms * self._ticks_since <= duration_ms

    def __str__(self) -> str:
        """Return the latest one, and how many there were and how long ago, unless it is the first, and of this tick."""
        age_ms = self._period_ms * (self._ticks_since or 0)
        if self._frames == 1 and not age_ms:
            return self.frame
        return f"{self.frame} (frame {self._frames}, {age_ms:g} ms ago)"
