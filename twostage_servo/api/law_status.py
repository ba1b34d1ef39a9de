"""The law that drives an axis, and what it has learned of its plant, as ``status`` and ``demo --json`` tell it."""

from twostage_servo.api.records import JsonRecord


class LoadStatus(JsonRecord):
    """What acts against each direction, friction included, in effort unit; None where it is not known."""

    forward: float | None
    backward: float | None


class IdentifiedStatus(JsonRecord):
    """What a law has learned of its plant.

    Attributes
    ----------
    gain, pole
        In axis unit/s² per effort unit, and 1/s.
    delay_ticks
        How many ticks later than designed an effort acts.
    load
        What acted against the last move in each direction.
    moves
        How many moves it has learned from.
    """

    gain: float
    pole: float
    delay_ticks: int
    load: LoadStatus
    moves: int


class RejectionStatus(JsonRecord):
    """Why what the last move has shown of the plant was not accepted.

    Attributes
    ----------
    code
        ``fit_residual``: no gain, pole, load and delay explain the motion. ``unexplained_motion``: nor two consecutive
        positions. ``gain_out_of_bounds``, ``pole_out_of_bounds``: those that do lie too far off what is configured.
        ``far_from_expected``: they are too far off what was known before the move.
    cause
        The same in words, with the numbers.
    degrades
        Whether the law controls as before anything was identified, until a move fits.
    """

    code: str
    cause: str
    degrades: bool


class LawStatus(JsonRecord):
    """The law that drives an axis.

    Attributes
    ----------
    type
        Its name.
    identified
        What it has learned of its plant; None before it has, and of a law that learns nothing.
    accepted
        Whether it controls by that plant as by one that is known; None likewise.
    rejection
        Why what the last move has shown was not accepted; None if it was, or if nothing has been shown.
    file_error
        Why the file of what it has learned could not be written or erased, and what to do; None if all is well.
    """

    type: str
    identified: IdentifiedStatus | None
    accepted: bool | None
    rejection: RejectionStatus | None
    file_error: str | None
