"""What the other axes of a machine do when one of them trips."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import structlog

from twostage_servo.axis.state import BRAKING, COMMANDED, ENABLED, LATCHED, State
from twostage_servo.service.axis_loop import AxisLoop

if TYPE_CHECKING:
    from twostage_servo.axis.trips import Trip

GroupReaction = Literal["continue", "stop", "quick_stop", "disarm"]


class AxisGroup:
    """Looks at all axes after each has decided on its effort.

    Parameters
    ----------
    reaction
        What becomes of an axis that moves, or holds, while another one trips: it goes on; it comes to rest and holds;
        it does so with its quick stop deceleration; or it comes to rest and is disarmed. Unless it is to go on, one
        that is only just being armed is disarmed.
    """

    def __init__(self, reaction: GroupReaction) -> None:
        self._reaction = reaction
        self._known: dict[str, tuple[Trip | None, Trip | None]] = {}
        self._log = structlog.get_logger().bind(room="group")

    def react(self, axis_loops: Sequence[AxisLoop]) -> None:
        """Let the others react to the trips of this tick."""
        for axis_loop in axis_loops:
            trip, later = axis_loop.axis.trip, axis_loop.axis.escalation
            known, known_later = self._known.get(axis_loop.name, (None, None))
            if trip is known and later is known_later:
                continue
            self._known[axis_loop.name] = trip, later
            if trip is not None and self._reaction != "continue":
                self._stop_others(axis_loop, axis_loops)

    def _stop_others(self, tripped: AxisLoop, axis_loops: Sequence[AxisLoop]) -> None:
        quick = self._reaction == "quick_stop"
        for other in axis_loops:
            axis = other.axis
            if other is tripped or axis.state in LATCHED or axis.state not in ENABLED:
                continue
            before, reason = axis.state, f"{tripped.name} has tripped (machine.fault_reaction is {self._reaction})"
            axis.bar_jog()
            if self._reaction == "disarm":
                axis.disarm(reason)
            elif before in COMMANDED or before is State.ARMING or (quick and before in BRAKING):
                axis.stop(reason, quick=quick)
            if axis.state is not before:
                self._log.warning("another axis has tripped", axis=other.name, tripped=tripped.name, now=axis.state)
