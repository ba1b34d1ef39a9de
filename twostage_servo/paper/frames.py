"""What CAN frames change: the figures of a run over frames beside those of the law alone, as plain numbers."""

from dataclasses import dataclass
from typing import Any, Final

EXTRA_DELAY_MS: Final = 10.0
"""One tick more of transport, to see what it does."""


@dataclass(frozen=True, slots=True)
class FramesComparison:
    """The proposed law behind frames, and how far it differs from the law alone.

    Attributes
    ----------
    position_quantum, effort_quantum
        What a frame rounds position (mm) and effort (V) to.
    position_difference, effort_difference
        Largest difference between the run over frames and the law alone, without noise: of the positions at the drive's
        sampling instants, in mm, and of the efforts, in V.
    effort_difference_unexplained
        The same difference of efforts when the law alone is given the same rounding: what is left to explain, in V.
    ticks
        Number of ticks compared.
    frames, delayed
        overshoot (mm), settling_time_s, speed_overshoot (mm/s) and final_error (mm) of the run over frames with the
        example's noise, and with :data:`EXTRA_DELAY_MS` of transport delay on top.
    """

    position_quantum: float
    effort_quantum: float
    position_difference: float
    effort_difference: float
    effort_difference_unexplained: float
    ticks: int
    frames: dict[str, Any]
    delayed: dict[str, Any]
