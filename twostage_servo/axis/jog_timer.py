"""How long a jog goes on, and from when on one is taken again."""

from twostage_servo.axis.design import AxisDesign


class JogTimer:
    """Counts the time since a jog was asked for, and since it was last refused.

    Parameters
    ----------
    design
        The axis.
    """

    __slots__ = ("_barred_ticks", "_ticks", "_ticks_left")

    def __init__(self, design: AxisDesign) -> None:
        self._ticks = design.ticks(design.settings.jog_timeout_ms)
        self._ticks_left = 0
        self._barred_ticks = 0  # for so long nobody must ask for a jog before one is taken again

    def begin_tick(self, missed: int) -> None:
        """Open a tick, before which so many were missed."""
        self._ticks_left -= 1 + missed
        self._barred_ticks = max(0, self._barred_ticks - 1 - missed)

    def renew(self) -> None:
        """Let a jog go on for its time-out from now on."""
        self._ticks_left = self._ticks

    def bar(self) -> None:
        """Bar jogs until none was asked for during the time-out: a stop must outlast the requests that renew a jog.

        For a stop by somebody else than who jogs. Whoever asks blindly, every 100 ms, would set the axis moving again.
        """
        self._barred_ticks = self._ticks

    @property
    def is_over(self) -> bool:
        """Whether a jog has not been renewed in time."""
        return self._ticks_left <= 0

    @property
    def is_barred(self) -> bool:
        """Whether no jog is taken now."""
        return self._barred_ticks > 0
