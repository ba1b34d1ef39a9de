"""The other axes of the machine: they move while the fault comes, and do then what `fault_reaction` says."""

import contextlib
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

from twostage_servo.app.closed_loop import ClosedLoop
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import LATCHED, State
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.simulation.node import DriveNode
from twostage_servo.timing.ticks import Tick

if TYPE_CHECKING:
    from twostage_servo.service.axis_group import GroupReaction
    from twostage_servo.service.axis_loop import AxisLoop

_LONGEST_RUN_S = 60.0
"""For so long its way has to be free."""
_FREE_SHARE = 0.9
_TO_REST_S = 3.0
"""How long the other axes may take to come to rest."""


class Companion:
    """An axis beside the one that has the fault.

    Parameters
    ----------
    axis_loop
        The axis in its service.
    drive, node
        Its simulated drive.

    Attributes
    ----------
    axis_loop, drive, node
        As given.
    states
        What it did since the fault, each state once.
    """

    def __init__(self, axis_loop: "AxisLoop", drive: SimulatedDrive, node: DriveNode) -> None:
        self.axis_loop = axis_loop
        self.drive = drive
        self.node = node
        self.states: set[State] = set()
        self._velocity = 0.0
        self._jogs = False

    @property
    def name(self) -> str:
        """The axis' name."""
        return self.axis_loop.name

    @property
    def ready(self) -> bool:
        """Whether it can be armed."""
        return self.axis_loop.axis.ready_to_arm

    def begin(self) -> None:
        """Arm it; it jogs as soon as it holds, to the side where there is more room."""
        axis = self.axis_loop.axis
        limits, place = axis.settings.limits, self.drive.position
        if not axis.referenced:
            axis.set_position(place)
        up, down = limits.position_maximum - place, place - limits.position_minimum
        speed = min(axis.settings.cruise_velocity, _FREE_SHARE * max(up, down) / _LONGEST_RUN_S)
        self._velocity = speed if up >= down else -speed
        self._jogs = True
        axis.arm()

    def forget(self) -> None:
        """Begin to note what it does: the fault comes now."""
        self.states = {self.axis_loop.axis.state}

    def on_tick(self, tick: Tick) -> None:
        """Keep jogging for as long as nothing has stopped it, as an operator does who holds a button."""
        axis = self.axis_loop.axis
        self.states.add(axis.state)
        starts = self._jogs and axis.state is State.HOLDING
        every = max(1, int(axis.settings.jog_timeout_ms / (4.0 * axis.design.period_s * 1e3)))
        if starts or (axis.state is State.JOGGING and (tick.missed or tick.index % every == 0)):
            with contextlib.suppress(Refused):
                axis.jog(self._velocity)
                self._jogs = False

    @property
    def jogs(self) -> bool:
        """Whether it is on its way."""
        return self.axis_loop.axis.state is State.JOGGING

    def complaint(self, reaction: "GroupReaction", *, tripped: bool, shared: bool) -> str:
        """Return what it did wrong, or nothing.

        Parameters
        ----------
        reaction
            What it should do when another axis trips.
        tripped
            Whether that one has tripped.
        shared
            Whether the fault is one of what all axes share, so that it may have tripped as well.
        """
        axis, name = self.axis_loop.axis, self.name
        if axis.trip is not None:
            return "" if shared else f"axis {name} tripped as well: {axis.trip.cause}"
        if shared and not tripped:  # a lost operator, a bus that came back: what it does then is the fault's own row
            return ""
        wanted = {
            "continue": {State.JOGGING},
            "stop": {State.HOLDING},
            "quick_stop": {State.HOLDING},
            "disarm": {State.DISARMED},
        }[reaction if tripped else "continue"]
        if axis.state not in wanted:
            return f"axis {name} is {axis.state}, not {' or '.join(wanted)}"
        speed = abs(self.drive.velocity)
        if State.JOGGING not in wanted and speed > axis.design.rest_velocity:
            return f"axis {name} still moves at {speed:.4g}"
        if tripped and reaction == "quick_stop" and State.QUICK_STOPPING not in self.states:
            return f"axis {name} came to rest without its quick stop"
        return f"axis {name} has latched" if self.states & LATCHED else ""


class Companions:
    """All axes beside the one that has the fault.

    Parameters
    ----------
    loop
        The service and its axes.
    axis_name
        The axis that has the fault.
    until
        Waits until a condition holds, for a simulated time in s at most.
    """

    def __init__(
        self, loop: ClosedLoop, axis_name: str, until: Callable[[Callable[[], bool], float], Awaitable[bool]]
    ) -> None:
        self._axis_loop = loop.axes[axis_name].axis_loop
        self._fault_reaction = loop.parts.machine.fault_reaction
        self._listen = loop.listen
        self._until = until
        self._all = [
            Companion(one.axis_loop, one.drive, one.node) for name, one in loop.axes.items() if name != axis_name
        ]

    async def start(self, longest_s: float) -> None:
        """Arm them and let them jog."""
        for companion in self._all:
            self._listen(companion.on_tick)
        await self._until(lambda: all(companion.ready for companion in self._all), longest_s)
        for companion in self._all:
            companion.begin()
        await self._until(lambda: all(companion.jogs for companion in self._all), longest_s)

    def forget(self) -> None:
        """Note from here on what they do."""
        for companion in self._all:
            companion.forget()

    async def complaint(self, *, shared: bool) -> str:
        """Return what they have done wrong; they are given the time to come to rest."""

        def complaints() -> str:
            tripped = self._axis_loop.axis.trip is not None
            each = (one.complaint(self._fault_reaction, tripped=tripped, shared=shared) for one in self._all)
            return "; ".join(filter(None, each))

        if complaints():
            await self._until(lambda: not complaints(), _TO_REST_S)
        return complaints()
