"""The operators' desk: carries out what clients ask of the axes, one of them at a time."""

import contextlib
from typing import TYPE_CHECKING, Any

import structlog

from twostage_servo.api.requests import (
    READING,
    AcquireRequest,
    ArmRequest,
    AxisRequest,
    DisarmRequest,
    HomeRequest,
    JogRequest,
    MoveRequest,
    PreemptRequest,
    RecordingRequest,
    ReleaseRequest,
    ReloadRequest,
    Request,
    ResetRequest,
    StopRequest,
)
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import BRAKING, COMMANDED, MOVING, State
from twostage_servo.service.authority import Authority
from twostage_servo.service.synchronised_move import velocities_to_arrive_together
from twostage_servo.telemetry.recorder import Record

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Sequence

    from twostage_servo.axis.axis import Axis
    from twostage_servo.service.axis_loop import AxisLoop
    from twostage_servo.service.servo_service import ServoService

_IN_MOTION = MOVING | BRAKING | {State.JOGGING, State.HOMING}


class Desk:
    """Takes requests of clients to a service.

    Parameters
    ----------
    service
        The service whose axes are commanded.

    Attributes
    ----------
    lease
        Who commands.
    reload
        Reads the configuration again and gives the service its new axes; None where there is none to read.
    prepare
        Does the same outside the loop, up to the axes; returns what puts them in force. None where nothing does.
    """

    def __init__(self, service: "ServoService") -> None:
        self._service = service
        self.authority = Authority()
        self.reload: Callable[[], None] | None = None
        self.prepare: Callable[[], Awaitable[Callable[[], None]]] | None = None
        self._preparing: str | None = None  # the client for whom a configuration is being read
        self._prepared: tuple[str, Callable[[], None]] | None = None
        self._log = structlog.get_logger()

    def handle(self, request: Request, client: str) -> dict[str, Any]:
        """Carry out a request of a client, and return what it is told.

        Parameters
        ----------
        request
            What is asked.
        client
            Name of the connection that asks; the same for all of its requests.

        Raises
        ------
        Refused
            If it is not carried out.
        """
        try:
            return self._handle(request, client)
        except Refused:
            raise
        except Exception as error:
            raise self.defect(error) from error

    def carry_out(self, request: Request, client: str) -> None:
        """Carry out a request that changes something, and tell nothing; see :meth:`handle`."""
        try:
            self._carry_out(request, client)
        except Refused:
            raise
        except Exception as error:
            raise self.defect(error) from error

    def defect(self, error: Exception) -> Refused:
        """Let the service end with a defect that a request has shown; return what its client is told."""
        self._service.fail(error)
        return Refused(RefusalCode.INTERNAL_ERROR, f"{type(error).__name__}: {error}; the service is stopping")

    def axis_loop(self, name: str | None) -> "AxisLoop":
        """Return the axis of a name; without one, the only axis.

        Raises
        ------
        Refused
            If there is none of this name, or no name and several axes.
        """
        try:
            return self._service.axis_loop(name)
        except KeyError:
            names = ", ".join(axis_loop.name for axis_loop in self._service.axis_loops)
            text = f"there is no axis {name}" if name is not None else "this concerns one axis, and there are several"
            raise Refused(RefusalCode.WHICH_AXIS, f"{text}: name one of {names}.") from None

    def _handle(self, request: Request, client: str) -> dict[str, Any]:
        name = request.axis if isinstance(request, AxisRequest) else None
        if name is not None:
            self.axis_loop(name)  # which refuses one that there is not
        if isinstance(request, RecordingRequest):
            return {"fields": Record._fields, "records": self.axis_loop(name).recorder.records()}
        if not isinstance(request, READING):
            self._carry_out(request, client)
        return self._service.snapshot(name)

    def _carry_out(self, request: Request, client: str) -> None:
        if isinstance(request, AxisRequest) and request.axis is not None:
            self.axis_loop(request.axis)
        if self._service.is_ending:
            raise Refused(RefusalCode.ENDING, "the service is ending: nothing but reading is possible any more.")
        self._command(request, client)

    def leave(self, client: str) -> None:
        """Take notice that a client's connection has ended; one that has commanded has not given its lease back."""
        if not self.authority.release(client):
            return
        policy = self._service.settings.holder_lost
        for axis_loop in self._service.axis_loops:
            axis = axis_loop.axis
            if axis.state is State.JOGGING:
                axis.stop(f"{client} has gone, who held the jog")
            elif axis.state in COMMANDED and policy != "continue":
                self._log.warning("the lease's holder has gone", axis=axis_loop.name, client=client, policy=policy)
                reason = f"{client} has gone, who commanded the move (service.holder_lost is {policy})"
                if policy == "stop":
                    axis.stop(reason)
                else:
                    axis.disarm(reason)

    def _command(self, request: Request, client: str) -> None:
        match request:
            case StopRequest(quick=quick):  # whoever commands, everybody may bring the axes to rest
                self._stop(self._axis_loops(request), client, quick=quick)
            case DisarmRequest():
                for axis_loop in self._axis_loops(request):
                    axis_loop.axis.disarm()
            case ReleaseRequest():
                self.authority.release(client)
            case AcquireRequest():
                self.authority.demand(client)
            case PreemptRequest():
                at_rest = all(axis_loop.axis.state not in _IN_MOTION for axis_loop in self._service.axis_loops)
                self.authority.take(client, at_rest=at_rest)
            case _:
                with self.authority.demanded(client):
                    self._command_as_holder(request, client)

    def _command_as_holder(self, request: Request, client: str) -> None:
        match request:
            case ArmRequest():
                self._arm(self._axis_loops(request))
            case ResetRequest():
                self._reset(self._axis_loops(request))
            case MoveRequest(positions=None):
                axis_loop = self.axis_loop(request.axis)
                with self._named(axis_loop):
                    self._move(axis_loop.axis, request)
            case MoveRequest():
                self._move_together(request)
            case JogRequest(velocity=velocity):
                axis_loop = self.axis_loop(request.axis)
                with self._named(axis_loop):
                    axis_loop.axis.jog(velocity)
            case HomeRequest(position=position):
                axis_loop = self.axis_loop(request.axis)
                with self._named(axis_loop):
                    if position is None:
                        axis_loop.axis.home()
                    else:
                        axis_loop.axis.set_position(position)
            case ReloadRequest():
                self._reload(client)

    # Which axes ------------------------------------------------------------------------------------------------------

    def _axis_loops(self, request: AxisRequest) -> "Sequence[AxisLoop]":
        return self._service.axis_loops if request.axis is None else [self.axis_loop(request.axis)]

    @contextlib.contextmanager
    def _named(self, axis_loop: "AxisLoop") -> "Iterator[None]":
        """Let a refusal say which axis it is that refuses, where there are several."""
        try:
            yield
        except Refused as error:
            if len(self._service.axis_loops) == 1:
                raise
            raise Refused(error.code, f"axis {axis_loop.name}: {error}") from error

    # What is asked of several at once is asked of all of them or of none ---------------------------------------------

    def _stop(self, axis_loops: "Sequence[AxisLoop]", client: str, *, quick: bool) -> None:
        stoppable = [axis_loop for axis_loop in axis_loops if axis_loop.axis.can_stop]
        if self.authority.holder not in {None, client}:
            for axis_loop in stoppable:
                axis_loop.axis.bar_jog()
        for axis_loop in stoppable or axis_loops:  # none can: the first says why
            with self._named(axis_loop):
                axis_loop.axis.stop(quick=quick)

    def _arm(self, axis_loops: "Sequence[AxisLoop]") -> None:
        for axis_loop in axis_loops:
            with self._named(axis_loop):
                if axis_loop.bus.error is not None:
                    raise Refused(RefusalCode.BUS_CLOSED, f"the bus is not open: {axis_loop.bus.error}")
                axis_loop.axis.check_arming()
        for axis_loop in axis_loops:
            axis_loop.axis.arm()

    def _reset(self, axis_loops: "Sequence[AxisLoop]") -> None:
        tripped = [axis_loop for axis_loop in axis_loops if axis_loop.axis.trip is not None] or axis_loops
        for axis_loop in tripped:
            with self._named(axis_loop):
                axis_loop.axis.check_reset()
        for axis_loop in tripped:
            axis_loop.axis.reset()
            axis_loop.recorder.discard()

    def _move(self, axis: "Axis", request: MoveRequest) -> None:
        speed = axis.settings.cruise_velocity if request.velocity is None else request.velocity
        if request.position is not None:
            axis.move_to(request.position, speed)
        elif request.by is not None:
            axis.move_by(request.by, speed)

    def _move_together(self, request: MoveRequest) -> None:
        assert request.positions is not None  # noqa: S101 - the caller has looked
        moves = []
        for name, position in request.positions.items():
            axis_loop = self.axis_loop(name)
            axis = axis_loop.axis
            speed = axis.settings.cruise_velocity if request.velocity is None else request.velocity
            with self._named(axis_loop):
                axis.check_move(position, speed)
            moves.append((axis, position, speed))
        for (axis, position, _), speed in zip(moves, velocities_to_arrive_together(moves), strict=True):
            axis.move_to(position, max(speed, axis.slowest_velocity))  # a short way beside a very long one

    async def prepare_reload(self, client: str) -> None:
        """Do ahead of a client's `reload` what takes longer than a tick; the request itself is to follow.

        Raises
        ------
        Refused
            If it would be refused, another one is under way, or the configuration cannot be used.
        """
        if self._service.is_ending:
            raise Refused(RefusalCode.ENDING, "the service is ending: nothing but reading is possible any more.")
        if self.prepare is None:
            return
        with self.authority.demanded(client):
            self._check_disarmed()
            if self._preparing is not None:
                raise Refused(RefusalCode.BUSY, f"{self._preparing} has asked for `reload` just now: wait for its end.")
            self._preparing, self._prepared = client, None
            try:
                self._prepared = client, await self.prepare()
            finally:
                self._preparing = None

    def is_prepared(self, client: str) -> bool:
        """Whether what was prepared for a client's `reload` waits for it."""
        return self._prepared is not None and self._prepared[0] == client

    def _reload(self, client: str) -> None:
        prepared, self._prepared = self._prepared, None
        if prepared is not None and prepared[0] == client:
            self._check_disarmed()
            prepared[1]()
            return
        if self.reload is None:
            raise Refused(RefusalCode.NO_CONFIGURATION, "this service runs on settings that stand in no file.")
        self._check_disarmed()
        self.reload()

    def _check_disarmed(self) -> None:
        for axis_loop in self._service.axis_loops:
            if axis_loop.axis.state is not State.DISARMED:
                raise Refused(
                    RefusalCode.ARMED,
                    f"axis {axis_loop.name} is {axis_loop.axis.state}: settings are read again only while disarmed.",
                )
