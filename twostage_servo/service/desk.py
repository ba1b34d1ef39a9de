"""The operators' desk: carries out what clients ask of the axis, one of them at a time."""

from typing import TYPE_CHECKING, Any

import structlog

from twostage_servo.axis.messages import Refused
from twostage_servo.axis.state import BRAKING, MOVING, State
from twostage_servo.service.lease import Lease
from twostage_servo.service.recorder import Record
from twostage_servo.service.requests import (
    READING,
    ArmRequest,
    DisarmRequest,
    HomeRequest,
    JogRequest,
    MoveRequest,
    RecordingRequest,
    ReleaseRequest,
    ReloadRequest,
    Request,
    ResetRequest,
    StopRequest,
    TakeRequest,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from twostage_servo.service.loop import ServoService

_IN_MOTION = MOVING | BRAKING | {State.JOGGING, State.HOMING}
_COMMANDED = MOVING | {State.JOGGING, State.HOMING}


class Desk:
    """Takes requests of clients to a service.

    Parameters
    ----------
    service
        The service whose axis is commanded.

    Attributes
    ----------
    lease
        Who commands.
    reload
        Reads the configuration again and gives the service its new axis; None where there is none to read.
    """

    def __init__(self, service: "ServoService") -> None:
        self._service = service
        self.lease = Lease()
        self.reload: Callable[[], None] | None = None
        self._log = structlog.get_logger().bind(axis=service.axis.settings.name)

    def handle(self, request: Request, client: str) -> dict[str, Any]:
        """Carry out a request of a client.

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
            self._service.fail(error)
            raise Refused("internal_error", f"{type(error).__name__}: {error}; the service is stopping") from error

    def _handle(self, request: Request, client: str) -> dict[str, Any]:
        service = self._service
        if isinstance(request, RecordingRequest):
            return {"fields": Record._fields, "records": service.recorder.records()}
        if not isinstance(request, READING):
            if service.is_ending:
                raise Refused("ending", "the service is ending: nothing but reading is possible any more.")
            self._command(request, client)
        return service.snapshot()

    def leave(self, client: str) -> None:
        """Take notice that a client's connection has ended; one that has commanded has not given its lease back."""
        if not self.lease.release(client):
            return
        axis, policy = self._service.axis, self._service.settings.holder_lost
        if axis.state is State.JOGGING:
            axis.stop(f"{client} has gone, who held the jog")
        elif axis.state in _COMMANDED and policy != "continue":
            self._log.warning("the lease's holder has gone", client=client, policy=policy)
            if policy == "stop":
                axis.stop(f"{client} has gone, who commanded the move (service.holder_lost is stop)")
            else:
                axis.disarm()

    def _command(self, request: Request, client: str) -> None:
        axis = self._service.axis
        match request:
            case StopRequest(quick=quick):  # whoever commands, everybody may bring the axis to rest
                axis.stop(quick=quick)
            case DisarmRequest():
                axis.disarm()
            case ReleaseRequest():
                self.lease.release(client)
            case TakeRequest():
                self.lease.take(client, at_rest=axis.state not in _IN_MOTION)
            case _:
                self.lease.demand(client)
                self._command_as_holder(request)

    def _command_as_holder(self, request: Request) -> None:
        axis = self._service.axis
        match request:
            case ArmRequest():
                if self._service.bus_error is not None:
                    raise Refused("bus_closed", f"the bus is not open: {self._service.bus_error}")
                axis.arm()
            case ResetRequest():
                axis.reset()
                self._service.recorder.discard()
            case MoveRequest():
                self._move(request)
            case JogRequest(velocity=velocity):
                axis.jog(velocity)
            case HomeRequest(position=position):
                if position is None:
                    axis.home()
                else:
                    axis.set_position(position)
            case ReloadRequest():
                self._reload()

    def _move(self, request: MoveRequest) -> None:
        axis = self._service.axis
        speed = axis.settings.cruise_velocity if request.velocity is None else request.velocity
        if request.position is not None:
            axis.move_to(request.position, speed)
        elif request.by is not None:
            axis.move_by(request.by, speed)

    def _reload(self) -> None:
        if self.reload is None:
            raise Refused("no_configuration", "this service runs on settings that stand in no file.")
        if self._service.axis.state is not State.DISARMED:
            raise Refused(
                "armed", f"the axis is {self._service.axis.state}: the configuration is read again only while disarmed."
            )
        self.reload()
