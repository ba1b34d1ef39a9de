"""What becomes of a request: it is carried out, refused, or dropped where nobody waits for it any more."""

from collections.abc import Awaitable, Callable, Iterator, Sequence
from typing import Final, Literal

import structlog

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import (
    READING,
    AcquireRequest,
    ArmRequest,
    AxisRequest,
    DisarmRequest,
    ForgetRequest,
    HomeRequest,
    JogRequest,
    MoveRequest,
    OverrideRequest,
    PreemptRequest,
    RecordingRequest,
    ReleaseRequest,
    ReloadRequest,
    Request,
    ResetRequest,
    StopRequest,
)
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import BRAKING, COMMANDED, State
from twostage_servo.service import answers
from twostage_servo.service.authority import Authority
from twostage_servo.service.axis_commands import AxisCommands
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.reload import Reload
from twostage_servo.service.reply import Asker, Reply
from twostage_servo.service.request_age import RequestAge
from twostage_servo.service.shutdown import Shutdown
from twostage_servo.service.status_lines import StatusLines
from twostage_servo.telemetry.sample import FIELDS

_IN_MOTION: Final = COMMANDED | BRAKING
_NEVER_TOO_LATE: Final = (StopRequest, DisarmRequest, ReleaseRequest)
"""Requests that set nothing in motion: they are carried out however old, and whoever has gone."""
_OK: Final = b'{"ok":true,'

EraseLearned = Callable[[Sequence[AxisLoop]], Awaitable[None]]
HolderLost = Literal["continue", "stop", "disarm"]


class RequestHandler:
    """Carries out requests of clients, one at a time, and makes the lines that answer them.

    Parameters
    ----------
    axis_loops
        The axes of the service.
    status
        Makes the lines that tell of its state.
    authority
        Knows who commands.
    shutdown
        Ends the service: while it does only reading is possible, and a defect begins it.
    reload
        Reads the configuration again.
    age
        Tells how old requests are.
    holder_lost
        What becomes of a move when the connection ends that commanded it and has not released its authority.
    erase_learned
        Erases what is kept in files of what the laws of axes have learned; None where nothing is.

    Attributes
    ----------
    authority, status, age
        As given.
    """

    def __init__(
        self,
        axis_loops: Sequence[AxisLoop],
        status: StatusLines,
        authority: Authority,
        shutdown: Shutdown,
        reload: Reload,
        age: RequestAge,
        holder_lost: HolderLost,
        erase_learned: EraseLearned | None = None,
    ) -> None:
        self.authority = authority
        self.status = status
        self.age = age
        self._axis_loops = axis_loops
        self._commands = AxisCommands(axis_loops)
        self._shutdown = shutdown
        self._reload = reload
        self._holder_lost: HolderLost = holder_lost
        self._erase_learned = erase_learned
        self._listeners: list[Callable[[Request, str], None]] = []
        self._log = structlog.get_logger().bind(room="control_socket")

    def listen(self, listener: Callable[[Request, str], None]) -> None:
        """Tell somebody, from now on, of each request that was carried out and changes something, with its client."""
        self._listeners.append(listener)

    # For a client on the socket --------------------------------------------------------------------------------------

    def answer(self, request: Request, asker: Asker) -> Reply:
        """Carry out a request, and return its answer; one that was dropped has none."""
        if not isinstance(request, READING) and not isinstance(request, _NEVER_TOO_LATE) and asker.gone:
            event = "request dropped: its client has disconnected"
            self._log.warning(event, peer=asker.peer, op=request.op, **self._axis_of(request))
            return Reply(iter(()), done=False)
        try:
            addressed = self._addressed(request) if isinstance(request, READING) else self._accept(request, asker)
            axis_loop = addressed[0] if len(addressed) == 1 else None
            return Reply(self._watched_over(self._told(request, addressed, axis_loop)), True, axis_loop)
        except Refused as error:
            return self._refusal(request, asker, error)

    async def prepare(self, request: Request, asker: Asker) -> Reply | None:
        """Do ahead what a request needs that takes longer than a tick; return its answer if it is refused by then."""
        if not isinstance(request, ReloadRequest | ForgetRequest) or asker.gone:
            return None
        try:
            self._check_age(request, asker)
            if isinstance(request, ReloadRequest):
                await self.prepare_reload(asker.peer)
            else:
                await self.prepare_forget(request, asker.peer)
        except Refused as error:
            return self._refusal(request, asker, error)
        except Exception as error:  # noqa: BLE001 - a defect: the service ends with it
            return self._refusal(request, asker, self._defect(error))
        return None

    def disconnect(self, client: str) -> None:
        """Handle a disconnect: release the client's authority, and apply what `holder_lost` says to its moves."""
        if not self.authority.release(client):
            return
        policy = self._holder_lost
        for axis_loop in self._axis_loops:
            axis = axis_loop.axis
            if axis.state is State.JOGGING:
                axis.stop(f"{client} has disconnected while it held the jog")
            elif axis.state in COMMANDED and policy != "continue":
                log, event = structlog.get_logger(), "the holder of control authority has disconnected"
                log.warning(event, axis=axis_loop.name, client=client, policy=policy)
                reason = f"{client} has disconnected while it commanded the move (service.holder_lost is {policy})"
                if policy == "stop":
                    axis.stop(reason)
                else:
                    axis.disarm(reason)

    # For somebody in this process ------------------------------------------------------------------------------------

    def handle(self, request: Request, client: str = "this process") -> JsonObject:
        """Carry out a request at once, and return what a client would be told, ready for JSON.

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
            addressed = self._addressed(request)
            if not isinstance(request, READING):
                self._carry_out(request, addressed, client)
            if isinstance(request, RecordingRequest):
                return {"fields": FIELDS, "records": self._commands.only(addressed).recorder.records()}
            return self.status.report.snapshot(addressed)
        except Refused:
            raise
        except Exception as error:
            raise self._defect(error) from error

    async def prepare_reload(self, client: str) -> None:
        """Do ahead of a client's `reload` what takes longer than a tick; the request itself is to follow.

        Raises
        ------
        Refused
            If it would be refused, another one is under way, or the configuration cannot be used.
        """
        self._check_not_ending()
        with self.authority.acquired(client):
            await self._reload.prepare(client)

    async def prepare_forget(self, request: ForgetRequest, client: str) -> None:
        """Erase the files ahead of a client's `forget`, whose answer tells whether they have gone.

        Raises
        ------
        Refused
            If it would be refused.
        """
        self._check_not_ending()
        addressed = self._addressed(request)
        with self.authority.acquired(client):
            self._commands.check_forget(addressed)
            if self._erase_learned is not None:
                await self._erase_learned(addressed)

    # One way ---------------------------------------------------------------------------------------------------------

    def _addressed(self, request: Request) -> Sequence[AxisLoop]:
        """Return the axes that a request is for; here, and only here, its axis' name is looked up."""
        return self._commands.addressed(request.axis if isinstance(request, AxisRequest) else None)

    def _axis_of(self, request: Request) -> dict[str, str]:
        """Return the field by which the log names the axis of a request; none where that is not one of ours alone."""
        if not isinstance(request, AxisRequest):
            return {}
        ours = [axis_loop.name for axis_loop in self._axis_loops]
        together = request.positions if isinstance(request, MoveRequest) else None
        named = [request.axis] if request.axis else list(together or ours)
        return {"axis": named[0]} if len(named) == 1 and named[0] in ours else {}

    def _accept(self, request: Request, asker: Asker) -> Sequence[AxisLoop]:
        """Carry out a request that has come in time; return the axes that it was for."""
        is_prepared = isinstance(request, ReloadRequest) and self._reload.is_prepared(asker.peer)
        if not isinstance(request, ForgetRequest) and not is_prepared:  # else :meth:`prepare` has checked it
            self._check_age(request, asker)
        if not isinstance(request, JogRequest):  # a jog is asked for several times a second
            self._log.info("request", peer=asker.peer, **(self._axis_of(request) | request.to_json()))
        if request.renamed_to:
            self._log.warning("the old name of an operation", peer=asker.peer, op=request.op, use=request.renamed_to)
        before = self._commands.changed_by_stop()
        try:
            addressed = self._addressed(request)
            self._carry_out(request, addressed, asker.peer)
        except Refused:
            raise
        except Exception as error:
            raise self._defect(error) from error
        finally:  # a flood of `stop` makes no report after the first
            if not isinstance(request, StopRequest | DisarmRequest) or self._commands.changed_by_stop() != before:
                self.status.forget()
        return addressed

    def _check_age(self, request: Request, asker: Asker) -> None:
        age_s = self.age.now_s() - asker.arrived_after_s
        if age_s > self.age.longest_s and not isinstance(request, _NEVER_TOO_LATE):
            raise Refused(
                RefusalCode.EXPIRED,
                f"this {request.op} may have waited for {age_s:.1f} s, and at most "
                f"{self.age.longest_s:g} s is allowed: check the axis, and send it again.",
            )

    def _check_not_ending(self) -> None:
        if self._shutdown.is_ending:
            raise Refused(RefusalCode.ENDING, "the service is ending: only requests that read are still possible.")

    def _carry_out(self, request: Request, addressed: Sequence[AxisLoop], client: str) -> None:
        """Carry out a request of a client that changes something, for the axes that it is for.

        Raises
        ------
        Refused
            If it is not carried out.
        """
        self._check_not_ending()
        match request:
            case StopRequest(quick=quick):  # whoever commands, everybody may bring the axes to rest
                others = self.authority.holder not in {None, client}
                self._commands.stop(addressed, quick=quick, bar_jog=others)
            case DisarmRequest():
                self._commands.disarm(addressed)
            case ReleaseRequest():
                self.authority.release(client)
            case AcquireRequest():
                self.authority.acquire(client)
            case PreemptRequest():
                at_rest = all(axis_loop.axis.state not in _IN_MOTION for axis_loop in self._axis_loops)
                self.authority.preempt(client, at_rest=at_rest)
            case _:
                with self.authority.acquired(client):
                    self._carry_out_for_holder(request, addressed, client)
        for listener in self._listeners:
            listener(request, client)

    def _carry_out_for_holder(self, request: Request, addressed: Sequence[AxisLoop], client: str) -> None:
        match request:
            case ArmRequest():
                self._commands.arm(addressed)
            case ResetRequest():
                self._commands.reset(addressed)
            case MoveRequest():
                self._commands.move(addressed, request)
            case JogRequest(velocity=velocity):
                self._commands.jog(addressed, velocity)
            case OverrideRequest(percent=percent):
                self._commands.override(addressed, percent)
            case HomeRequest(position=position):
                self._commands.home(addressed, position)
            case ForgetRequest():
                self._commands.forget(addressed)
            case ReloadRequest():
                self._reload.carry_out(client)
            case _:
                raise TypeError(f"{request.op} has no case here, and would be answered as done")

    # What is told ----------------------------------------------------------------------------------------------------

    def _told(self, request: Request, addressed: Sequence[AxisLoop], axis_loop: AxisLoop | None) -> Iterator[bytes]:
        if isinstance(request, RecordingRequest):
            return answers.recording(FIELDS, self._commands.only(addressed).recorder.records())
        return self.status.line(axis_loop, _OK)

    def _refusal(self, request: Request, asker: Asker, error: Refused) -> Reply:
        told = {"op": request.op, "code": error.code, "reason": str(error)} | self._axis_of(request)
        self._log.warning("refused", peer=asker.peer, **told)
        return Reply(iter((answers.failure(error.code, str(error)),)), done=False)

    def _defect(self, error: Exception) -> Refused:
        """Let the service end with a defect that a request has shown; return what its client is told."""
        self._shutdown.fail(error)
        return Refused(RefusalCode.INTERNAL_ERROR, f"{type(error).__name__}: {error}; the service is stopping")

    def _watched_over(self, pieces: Iterator[bytes]) -> Iterator[bytes]:
        """Yield the same; a defect that shows in their making ends the service, as any other does."""
        begun = False
        try:
            for piece in pieces:
                yield piece
                begun = True
        except Exception as error:
            refused = self._defect(error)
            if begun:  # half a line has been sent: only the end of the connection says that no more will come
                raise
            yield answers.failure(refused.code, str(refused))
