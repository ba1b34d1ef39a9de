"""Why a law has not accepted as its plant what a move has shown."""

import enum
from dataclasses import dataclass


class RejectionCode(enum.StrEnum):
    """Why what a move has shown was not accepted as the plant."""

    FIT_RESIDUAL = "fit_residual"
    UNEXPLAINED_MOTION = "unexplained_motion"
    GAIN_OUT_OF_BOUNDS = "gain_out_of_bounds"
    POLE_OUT_OF_BOUNDS = "pole_out_of_bounds"
    FAR_FROM_EXPECTED = "far_from_expected"


@dataclass(frozen=True, slots=True)
class Rejection:
    """A fit that was not accepted.

    Attributes
    ----------
    code
        Why.
    cause
        The same in words, with the numbers.
    degrades
        Whether the law controls by the gains for a plant that is not known, until a move fits again.
    """

    code: RejectionCode
    cause: str
    degrades: bool

    @property
    def is_of_the_form(self) -> bool:
        """Whether no gain, pole, load and delay explain the motion."""
        return self.code in {RejectionCode.FIT_RESIDUAL, RejectionCode.UNEXPLAINED_MOTION}

    @property
    def is_out_of_bounds(self) -> bool:
        """Whether gain or pole is too far off what is configured."""
        return self.code in {RejectionCode.GAIN_OUT_OF_BOUNDS, RejectionCode.POLE_OUT_OF_BOUNDS}
