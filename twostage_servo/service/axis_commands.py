"""What a client's command does to the axes that it is for: to all of them, or to none."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

from twostage_servo.api.requests import MoveRequest
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.moves import USUAL_OVERRIDE
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.synchronised_move import velocities_to_arrive_together


class AxisCommands:
    """Commands to some of the axes of a service.

    Each takes the axes that it is for, as :meth:`addressed` returns them.

    Parameters
    ----------
    axis_loops
        All axes of the service.
    """

    def __init__(self, axis_loops: Sequence[AxisLoop]) -> None:
        self._axis_loops = axis_loops
        self._by_name = {axis_loop.name: axis_loop for axis_loop in axis_loops}

    # Which axes ------------------------------------------------------------------------------------------------------

    def addressed(self, name: str | None) -> Sequence[AxisLoop]:
        """Return the axis of a name; without one, all axes.

        Raises
        ------
        Refused
            If there is none of this name.
        """
        if name is None:
            return self._axis_loops
        if name not in self._by_name:
            raise self._which_axis(f"there is no axis {name}")
        return (self._by_name[name],)

    def only(self, axis_loops: Sequence[AxisLoop]) -> AxisLoop:
        """Return the axis that a command for a single one is for.

        Raises
        ------
        Refused
            If there are several.
        """
        if len(axis_loops) > 1:
            raise self._which_axis("this concerns one axis, and there are several")
        return axis_loops[0]

    def changed_by_stop(self) -> list[tuple[Any, ...]]:
        """Return what a stop or a disarm changes of each axis of the service, if it changes anything."""
        axes = [axis_loop.axis for axis_loop in self._axis_loops]
        return [
            (axis.state, axis.move, None if axis.move is None else axis.move.outcome, axis.trip, axis.referenced)
            for axis in axes
        ]

    def _which_axis(self, why: str) -> Refused:
        return Refused(RefusalCode.WHICH_AXIS, f"{why}: name one of {', '.join(self._by_name)}.")

    @contextlib.contextmanager
    def _named(self, axis_loop: AxisLoop) -> Iterator[Axis]:
        """Let a refusal say which axis it is that refuses, where there are several."""
        try:
            yield axis_loop.axis
        except Refused as error:
            if len(self._axis_loops) == 1:
                raise
            raise Refused(error.code, f"axis {axis_loop.name}: {error}") from error

    # The commands ----------------------------------------------------------------------------------------------------

    def stop(self, axis_loops: Sequence[AxisLoop], *, quick: bool, bar_jog: bool) -> None:
        """Bring axes to rest; with `bar_jog` they take no jog before that has been let go."""
        stoppable = [axis_loop for axis_loop in axis_loops if axis_loop.axis.can_stop]
        if bar_jog:
            for axis_loop in stoppable:
                axis_loop.axis.bar_jog()
        for axis_loop in stoppable or axis_loops:  # none can: the first says why
            with self._named(axis_loop) as axis:
                axis.stop(quick=quick)

    def disarm(self, axis_loops: Sequence[AxisLoop]) -> None:
        """Bring axes to rest and disable their drives."""
        for axis_loop in axis_loops:
            axis_loop.axis.disarm()

    def arm(self, axis_loops: Sequence[AxisLoop]) -> None:
        """Enable the drives; the axes hold."""
        for axis_loop in axis_loops:
            with self._named(axis_loop) as axis:
                if axis_loop.bus.error is not None:
                    raise Refused(RefusalCode.BUS_CLOSED, f"the bus is not open: {axis_loop.bus.error}")
                axis.check_arming()
        for axis_loop in axis_loops:
            axis_loop.axis.arm()

    def reset(self, axis_loops: Sequence[AxisLoop]) -> None:
        """Clear the trips of those that have tripped."""
        tripped = [axis_loop for axis_loop in axis_loops if axis_loop.axis.trip is not None] or axis_loops
        for axis_loop in tripped:
            with self._named(axis_loop) as axis:
                axis.check_reset()
        for axis_loop in tripped:
            axis_loop.axis.reset()
            axis_loop.recorder.discard()

    def forget(self, axis_loops: Sequence[AxisLoop]) -> None:
        """Let those laws forget their plants that learn them, then refuse where the next start would recall one."""
        self.check_forget(axis_loops)
        for axis_loop in self._learning(axis_loops):
            axis_loop.axis.forget()
        for axis_loop in axis_loops:
            if axis_loop.learned_file.would_return:
                with self._named(axis_loop):
                    text = f"the law has forgotten, but {axis_loop.learned_file.error}."
                    raise Refused(RefusalCode.NOT_ERASED, text)

    def check_forget(self, axis_loops: Sequence[AxisLoop]) -> None:
        """Tell whether those laws could forget that learn something."""
        for axis_loop in self._learning(axis_loops):
            with self._named(axis_loop) as axis:
                axis.check_forget()

    def _learning(self, axis_loops: Sequence[AxisLoop]) -> Sequence[AxisLoop]:
        return [axis_loop for axis_loop in axis_loops if axis_loop.axis.learned is not None] or axis_loops

    def move(self, axis_loops: Sequence[AxisLoop], request: MoveRequest) -> None:
        """Give one axis a set-point, or several together."""
        if request.positions is not None:
            self._move_together(request.positions, request.velocity)
            return
        with self._named(self.only(axis_loops)) as axis:
            speed = axis.settings.cruise_velocity if request.velocity is None else request.velocity
            if request.position is not None:
                axis.move_to(request.position, speed)
            elif request.by is not None:
                axis.move_by(request.by, speed)

    def _move_together(self, positions: dict[str, float], velocity: float | None) -> None:
        moves, asked = [], []
        for name, position in positions.items():
            (axis_loop,) = self.addressed(name)
            with self._named(axis_loop) as axis:
                speed = axis.settings.cruise_velocity if velocity is None else velocity
                axis.check_move(position, speed)
            in_force = axis.velocity_in_force(speed)
            moves.append((axis, position, in_force or speed))
            asked.append((speed, axis.override_percent / USUAL_OVERRIDE if in_force else 1.0))
        together = velocities_to_arrive_together(moves)
        for (axis, position, _), (most, share), speed in zip(moves, asked, together, strict=True):
            # What its override makes of it is the speed; and a short way beside a very long one needs nearly none.
            axis.move_to(position, max(min(speed / share, most), axis.slowest_velocity))

    def jog(self, axis_loops: Sequence[AxisLoop], velocity: float) -> None:
        """Let one axis move at a velocity in its unit/s for as long as this is asked for again."""
        with self._named(self.only(axis_loops)) as axis:
            axis.jog(velocity)

    def override(self, axis_loops: Sequence[AxisLoop], percent: float) -> None:
        """Let those of the axes that are armed move at a percentage of the speed that is asked for."""
        armed = [axis_loop for axis_loop in axis_loops if axis_loop.axis.takes_override]
        for axis_loop in armed or axis_loops:  # none is: the first says why
            with self._named(axis_loop) as axis:
                axis.set_override(percent)

    def home(self, axis_loops: Sequence[AxisLoop], position: float | None) -> None:
        """Let one axis look for its reference, or tell it its position."""
        with self._named(self.only(axis_loops)) as axis:
            if position is None:
                axis.home()
            else:
                axis.set_position(position)
