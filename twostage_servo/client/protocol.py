"""The protocol without its socket: requests become bytes, and bytes become answers and snapshots."""

import json
from collections import deque
from typing import Final

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.records import UnreadableError
from twostage_servo.api.requests import READING, DisarmRequest, ReleaseRequest, Request, StopRequest, WatchRequest
from twostage_servo.api.status import Status
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.client.errors import Reason, Refused, ServoError, Unreachable

REPEATED: Final = (StopRequest, DisarmRequest)
"""Asked for again where the connection ends without an answer: asked twice they do no more than once."""
_WITHOUT_AUTHORITY: Final = (*READING, StopRequest, DisarmRequest, ReleaseRequest)
"""Requests by which a client gets no authority."""
_LONGEST_TICK_S: Final = 0.1
_EVENT: Final = "event"


class Protocol:
    """One connection, as a client sees it.

    Each line that comes is either a snapshot or the answer to the oldest request without one. A request whose answer
    nobody waits for any more, since something has interrupted the wait, is answered all the same: :meth:`answer_to`
    passes over it.

    Parameters
    ----------
    where
        What the connection leads to, for the texts of errors.

    Attributes
    ----------
    snapshots
        Those that have come and were not taken yet, oldest first; the last one may be a refusal.
    """

    def __init__(self, where: object) -> None:
        self.snapshots: deque[JsonObject] = deque()
        self._where = where
        self._received = bytearray()
        self._answers: dict[int, JsonObject] = {}
        self._sent = self._answered = 0

    def send(self, request: Request) -> tuple[int, bytes]:
        """Return the number of a request, and the bytes to be sent."""
        self._sent += 1
        return self._sent, json.dumps(request.to_json(), allow_nan=False).encode() + b"\n"

    def receive(self, data: bytes) -> None:
        """Process received bytes.

        Raises
        ------
        Unreachable
            If it is the end of the connection, or no JSON.
        """
        if not data:
            raise self.lost("the connection was closed")
        *lines, rest = (self._received + data).split(b"\n")
        self._received = bytearray(rest)
        for line in lines:
            self._read_line(line)

    def _read_line(self, line: bytes | bytearray) -> None:
        try:
            fields = json.loads(line)
        except ValueError as error:
            raise unreadable(self._where, error) from error
        if not isinstance(fields, dict):
            raise unreadable(self._where, "it is not an object")
        is_asked_for = self._answered < self._sent or fields.get("ok", True)
        if fields.get(_EVENT) or not is_asked_for:  # a service says so before it closes a watcher's connection
            self.snapshots.append(fields)
        else:
            self._answered += 1
            self._answers[self._answered] = fields

    def answer_to(self, number: int) -> JsonObject | None:
        """Return the answer to a request; None if it has not come yet.

        Raises
        ------
        Refused
            If the request was not carried out.
        """
        for before in [one for one in self._answers if one < number]:
            del self._answers[before]
        answer = self._answers.pop(number, None)
        if answer is None and self._answered >= number:
            raise self.lost("its answer was taken by another")
        return answer if answer is None else checked(answer)

    def lost(self, why: object) -> Unreachable:
        """Return the error of a connection that has ended."""
        return Unreachable(Reason.LOST, f"the service at {self._where} is gone: {why}")

    def silent(self) -> Unreachable:
        """Return the error of a service that does not answer in time."""
        text = f"the service at {self._where} does not answer: it hangs, or its machine is overloaded"
        return Unreachable(Reason.NO_ANSWER, text)


class Authority:
    """What a client knows of who commands: it learns its own name from the answer to its first command.

    Attributes
    ----------
    asked_for
        Whether a command was sent since the last `release`, whatever became of it.
    """

    def __init__(self) -> None:
        self.asked_for = False
        self._own: str | None = None
        self._holder: str | None = None

    @property
    def is_held(self) -> bool:
        """Whether this client commands, by what it has been told last."""
        return self._own is not None and self._own == self._holder

    def record_request(self, request: Request) -> None:
        """Record a request that is about to be sent."""
        if not isinstance(request, READING):
            self.asked_for = True

    def record_answer(self, request: Request, status: Status) -> None:
        """Record the answer to a request that was carried out."""
        holder = status.service.authority.holder
        if not isinstance(request, _WITHOUT_AUTHORITY):
            self._own = holder
        elif isinstance(request, ReleaseRequest):
            self.asked_for = False
        self.record_holder(status)

    def record_holder(self, status: Status) -> None:
        """Record who commands."""
        self._holder = status.service.authority.holder


def checked(answer: JsonObject) -> JsonObject:
    """Return an answer, or a snapshot, that is no refusal.

    Raises
    ------
    Refused
        If it is one.
    """
    if answer.get("ok", True):
        return answer
    error = answer["error"]
    code = error["code"]
    raise Refused(RefusalCode(code) if code in set(RefusalCode) else code, error["message"])


def status_in(fields: JsonObject, where: object) -> Status:
    """Return the status that an answer or a snapshot holds.

    Raises
    ------
    Unreachable
        If this client does not understand it.
    """
    try:
        return Status.from_json(fields)
    except UnreadableError as error:
        raise unreadable(where, error) from error


def unreadable(where: object, why: object) -> ServoError:
    """Return the error of an answer that is not understood."""
    text = f"the answer of the service at {where} cannot be understood; it may be another version: {why}"
    return Unreachable(Reason.UNREADABLE, text)


def longest_wait_s(timeout_s: float, watch: WatchRequest) -> float:
    """Return how long the next snapshot may take (s), where an answer may take `timeout_s`."""
    return timeout_s + watch.every * _LONGEST_TICK_S
