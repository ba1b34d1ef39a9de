"""The steps that verbs are made of, and the one that asks.

A verb is a generator. It yields steps, which the blocking or the asynchronous client carries out, and is sent what came
of them: the answer, the status, or an error. So each verb is written once, for both clients.
"""

from collections.abc import Callable, Generator
from typing import Any, Final, NamedTuple, TypeVar

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import Request, WatchRequest
from twostage_servo.api.status import Status
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.client.errors import Reason, Refused, ServoError, Unreachable
from twostage_servo.client.protocol import REPEATED

_PAUSE_S: Final = 0.002


class Ask(NamedTuple):
    """Send a request and wait for its answer, for `patience_s` where that is given; brings the object of JSON."""

    request: Request
    patience_s: float | None = None


class Reconnect(NamedTuple):
    """Connect anew within a time (s)."""

    within_s: float


class Pause(NamedTuple):
    """Wait (s)."""

    seconds: float


class Until(NamedTuple):
    """Watch, every so many ticks, until a condition holds; brings the status of then."""

    watch: WatchRequest
    condition: Callable[[Status], bool]


Step = Ask | Reconnect | Pause | Until
T = TypeVar("T")
Verb = Generator[Step, Any, T]


def asked(
    request: Request, timeout_s: float, clock: Callable[[], float], patience_s: float | None = None
) -> Verb[JsonObject]:
    """Ask; a `stop` or `disarm` whose connection ends without an answer is asked for again, over a new one."""
    end_s = clock() + timeout_s
    while True:
        try:
            answer: JsonObject = yield Ask(request, patience_s)
        except (Unreachable, Refused) as error:
            if not isinstance(request, REPEATED) or error.code not in {Reason.LOST, RefusalCode.TOO_MANY_CLIENTS}:
                raise
            yield Pause(_PAUSE_S)
            left_s = end_s - clock()
            if left_s <= 0.0:
                raise
            try:
                yield Reconnect(left_s)
            except ServoError:
                raise error from None
        else:
            return answer
