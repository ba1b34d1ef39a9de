"""What becomes of a request: it is carried out, refused, or dropped where nobody waits for it any more."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import structlog

from twostage_servo.api.requests import (
    READING,
    AxisRequest,
    DisarmRequest,
    JogRequest,
    RecordingRequest,
    ReleaseRequest,
    ReloadRequest,
    Request,
    StopRequest,
)
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.service import answers
from twostage_servo.telemetry.recorder import Record

if TYPE_CHECKING:
    from twostage_servo.service.request_age import RequestAge
    from twostage_servo.service.servo_service import ServoService
    from twostage_servo.service.status_lines import StatusLines

_NEVER_TOO_LATE: Final = (StopRequest, DisarmRequest, ReleaseRequest)
"""Requests that set nothing in motion: they are carried out however old, and whoever has gone."""
_OK: Final = b'{"ok":true,'


class Asker(Protocol):
    """Who asks."""

    @property
    def peer(self) -> str:
        """Name of the connection."""

    @property
    def arrived_after_s(self) -> float:
        """When there was nothing of the request yet, s."""

    @property
    def gone(self) -> bool:
        """Whether nobody is there any more."""


class Reply(NamedTuple):
    """What becomes of a request: its answer, made piece by piece, and whether it was carried out."""

    pieces: Iterator[bytes]
    done: bool


class RequestHandler:
    """Carries out requests of clients and makes the lines that answer them.

    Parameters
    ----------
    service
        What the requests are for.
    status
        Makes the lines that tell of its state.
    age
        Tells how old requests are.
    """

    def __init__(self, service: "ServoService", status: "StatusLines", age: "RequestAge") -> None:
        self._service = service
        self._status = status
        self._age = age
        self._log = structlog.get_logger().bind(room="control_socket")

    def answer(self, request: Request, asker: Asker) -> Reply:
        """Carry out a request, and return its answer; one that was dropped has none."""
        if not isinstance(request, READING) and not isinstance(request, _NEVER_TOO_LATE) and asker.gone:
            self._log.warning("request dropped, its client has gone", peer=asker.peer, op=request.op)
            return Reply(iter(()), done=False)
        try:
            if not isinstance(request, READING):
                self._carry_out(request, asker)
            return Reply(self._watched_over(self._told(request)), done=True)
        except Refused as error:
            return self._refusal(request, asker, error)

    async def prepare(self, request: Request, asker: Asker) -> Reply | None:
        """Do ahead what a request needs that takes longer than a tick; return its answer if it is refused by then."""
        if not isinstance(request, ReloadRequest) or asker.gone:
            return None
        try:
            self._check_age(request, asker)
            await self._service.desk.prepare_reload(asker.peer)
        except Refused as error:
            return self._refusal(request, asker, error)
        except Exception as error:  # noqa: BLE001 - a defect: the service ends with it
            return self._refusal(request, asker, self._service.desk.defect(error))
        return None

    def _refusal(self, request: Request, asker: Asker, error: Refused) -> Reply:
        self._log.warning("refused", peer=asker.peer, op=request.op, code=error.code, reason=str(error))
        return Reply(iter((answers.failure(error.code, str(error)),)), done=False)

    def _carry_out(self, request: Request, asker: Asker) -> None:
        if not (isinstance(request, ReloadRequest) and self._service.desk.is_prepared(asker.peer)):
            self._check_age(request, asker)
        if not isinstance(request, JogRequest):  # a jog is asked for several times a second
            self._log.info("request", peer=asker.peer, **request.to_json())
        if request.renamed_to:
            self._log.warning("an old name", peer=asker.peer, op=request.op, use=request.renamed_to)
        before = self._stands()
        try:
            self._service.desk.carry_out(request, asker.peer)
        finally:  # a flood of `stop` makes no report after the first
            if not isinstance(request, StopRequest | DisarmRequest) or self._stands() != before:
                self._status.forget()

    def _check_age(self, request: Request, asker: Asker) -> None:
        age_s = self._age.now_s() - asker.arrived_after_s
        if age_s > self._age.longest_s and not isinstance(request, _NEVER_TOO_LATE):
            raise Refused(
                RefusalCode.EXPIRED,
                f"this {request.op} may have waited for {age_s:.1f} s before its turn came, and "
                f"{self._age.longest_s:g} s are the most: look at the axis, and ask again.",
            )

    def _told(self, request: Request) -> Iterator[bytes]:
        service = self._service
        name = request.axis if isinstance(request, AxisRequest) else None
        if name is not None:
            service.desk.axis_loop(name)  # which refuses one that there is not
        if isinstance(request, RecordingRequest):
            return answers.recording(Record._fields, service.desk.axis_loop(name).recorder.records())
        return self._status.line(name, _OK)

    def _watched_over(self, pieces: Iterator[bytes]) -> Iterator[bytes]:
        """Yield the same; a defect that shows in their making ends the service, as any other does."""
        begun = False
        try:
            for piece in pieces:
                yield piece
                begun = True
        except Exception as error:
            refused = self._service.desk.defect(error)
            if begun:  # half a line has been sent: only the end of the connection says that no more will come
                raise
            yield answers.failure(refused.code, str(refused))

    def _stands(self) -> list[tuple[Any, ...]]:
        """Return what a stop changes of each axis, if it changes anything."""
        axes = [axis_loop.axis for axis_loop in self._service.axis_loops]
        return [
            (axis.state, axis.move, None if axis.move is None else axis.move.outcome, axis.trip, axis.referenced)
            for axis in axes
        ]
