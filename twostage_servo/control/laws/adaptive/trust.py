"""Whether the law may control by what it identifies: not after a move that no plant of the configured form fits."""

from typing import Final

from twostage_servo.control.laws.rejection import Rejection

_MOST_MOVES_WATCHED: Final = 64
"""Moves in a row that have to fit, at most, before the law controls by what they show again."""


class Trust:
    """What the last moves' fits are worth.

    After a move that no plant fits, the next ones are only watched, until one fits; the next time until two in a row
    fit, then four. Each move that fits while it is controlled by its fit takes one off again.

    Parameters
    ----------
    form_samples
        Samples of a fit from which the form of the plant is known to be right, if they fit one that is out of bounds.

    Attributes
    ----------
    rejection
        Why what the last move has shown was not accepted; None where it was, or nothing has been shown yet.
    """

    __slots__ = ("_form_samples", "_has_the_form", "_moves_needed", "_moves_to_watch", "rejection")

    def __init__(self, form_samples: int) -> None:
        self.rejection: Rejection | None = None
        self._form_samples = form_samples
        self._has_the_form = False
        self._moves_needed, self._moves_to_watch = 1, 0

    @property
    def only_watches(self) -> bool:
        """Whether the next move is to be looked at without being controlled by what it shows."""
        return self._moves_to_watch > 0

    @property
    def is_degraded(self) -> bool:
        """Whether the plant is not known, whatever was found before."""
        return self.rejection is not None and self.rejection.degrades

    @property
    def has_no_plant(self) -> bool:
        """Whether no plant of the configured form has fitted the last move."""
        return self.rejection is not None and self.rejection.is_of_the_form

    def counts(self, why: Rejection) -> bool:
        """Whether a rejection is to be believed.

        An axis so far off its model may not come to rest, and a move that begins so fits no plant: of an axis whose
        form is known to be right that says nothing.
        """
        return not (why.is_of_the_form and self._has_the_form)

    def forget(self) -> None:
        """Forget that the form is right; why the last fit was rejected stays: caution outlasts what was learned."""
        self._has_the_form = False

    def reject(self, why: Rejection, samples: int, *, watched: bool) -> None:
        """Take the rejection of a move that was only watched, or not, and so many samples of which were fitted."""
        self.rejection = why
        self._has_the_form |= why.is_out_of_bounds and samples >= self._form_samples
        if why.is_of_the_form:
            if not watched:
                self._moves_needed = min(2 * self._moves_needed, _MOST_MOVES_WATCHED)
            self._moves_to_watch = self._moves_needed // 2

    def accept(self, *, watched: bool) -> bool:
        """Take a move that fits, and was only watched, or not; return whether its plant may be believed."""
        if watched:
            self._moves_to_watch -= 1
        else:
            self._moves_needed = max(1, self._moves_needed - 1)
        if self._moves_to_watch > 0:
            return False
        self.rejection = None
        return True
