"""The timer by which the drive's firmware sends frames periodically."""

from math import floor

# A cycle that comes early by a rounding is not early.
_ROUNDING_S = 1e-9


class FirmwareTimer:
    """Due at ``anchor + n * period``; what a late cycle missed is skipped.

    Parameters
    ----------
    anchor_s
        When it is due first, s.
    period_s
        Its period, s.

    Attributes
    ----------
    due_s
        When it is due next, less a rounding, s.
    """

    __slots__ = ("_anchor_s", "_period_s", "due_s")

    def __init__(self, anchor_s: float, period_s: float) -> None:
        self._period_s = period_s
        self.restart(anchor_s)

    def restart(self, anchor_s: float) -> None:
        """Make it due at another anchor."""
        self._anchor_s = anchor_s
        self.due_s = anchor_s - _ROUNDING_S

    def restart_period(self, now_s: float) -> None:
        """Make it due at the next multiple of the period."""
        periods = floor((now_s - self._anchor_s + _ROUNDING_S) / self._period_s) + 1
        self.due_s = self._anchor_s + periods * self._period_s - _ROUNDING_S
