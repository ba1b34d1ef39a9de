"""The state that an axis is in, and the way from one to the next."""

from twostage_servo.axis.state import Event, State, next_state


class StateMachine:
    """Goes through the table of :mod:`~twostage_servo.axis.state`, from a disarmed axis on.

    Attributes
    ----------
    state
        Where the axis stands.
    """

    __slots__ = ("state",)

    def __init__(self) -> None:
        self.state = State.DISARMED

    def next(self, event: Event) -> State | None:
        """Return the state that would follow, or None where the event is not admitted now."""
        return next_state(self.state, event)

    def apply(self, event: Event) -> None:
        """Go on to the next state.

        Raises
        ------
        RuntimeError
            If the event is not admitted: whoever applies it has to know.
        """
        state = next_state(self.state, event)
        if state is None:
            raise RuntimeError(f"event {event} is not admitted in state {self.state}")
        self.state = state
