"""What each verb asks the service for, and what it waits for, step by step: how an axis is operated."""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Final, TypeVar

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import (
    AcquireRequest,
    ArmRequest,
    BadRequestError,
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
    StatusRequest,
    StopRequest,
    WatchRequest,
)
from twostage_servo.api.status import AxisReport, Recording, Status
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.state import BRAKING, State
from twostage_servo.client.errors import Interrupted, Refused, ServoError, TimedOut, Tripped
from twostage_servo.client.steps import Pause, Until, Verb, asked

JOG_INTERVAL_S: Final = 0.1
"""Time between two requests of a jog; the service stops it after `axis.jog_timeout_ms` without one."""
LONGEST_RELOAD_S: Final = 65.0
"""Longer than the service lets the process take that reads a configuration again."""
PARTING_S: Final = 1.0
"""Longest wait for the answer to a `release` as one leaves."""
_PROGRESS_TICKS: Final = 5
_ARMING: Final = frozenset({State.ARMING, State.STOPPING})

Progress = Callable[[Status], object]
"""Is called with each status that a verb sees while it waits."""


class Verbs:
    """The verbs of one client.

    Parameters
    ----------
    axis
        Name of the axis that they concern; None: the only one, or all.
    timeout_s
        How long an answer may take, s.
    read
        Makes the status out of an answer.
    clock
        Tells the time, s.
    """

    def __init__(
        self,
        axis: str | None,
        timeout_s: float,
        read: Callable[[Request, JsonObject], Status],
        clock: Callable[[], float],
    ) -> None:
        self._axis = axis
        self._timeout_s = timeout_s
        self._read = read
        self._clock = clock

    def _asked(self, request: Request, patience_s: float | None = None) -> Verb[Status]:
        answer = yield from asked(request, self._timeout_s, self._clock, patience_s)
        return self._read(request, answer)

    def _until(self, condition: Callable[[Status], bool]) -> Verb[Status]:
        status = yield from self.status()
        if condition(status):
            return status
        later: Status = yield Until(_made(WatchRequest, axis=self._axis, every=1), condition)
        return later

    def watch(self, every: int) -> WatchRequest:
        """Return the request for snapshots."""
        return _made(WatchRequest, axis=self._axis, every=every)

    def status(self) -> Verb[Status]:
        """Look."""
        return (yield from self._asked(_made(StatusRequest, axis=self._axis)))

    def recording(self) -> Verb[Recording]:
        """Fetch the last ticks, or those before the trip."""
        answer = yield from asked(_made(RecordingRequest, axis=self._axis), self._timeout_s, self._clock)
        return Recording.from_json(answer)

    def arm(self) -> Verb[Status]:
        """Arm, and wait until the axis holds."""
        yield from self._asked(_made(ArmRequest, axis=self._axis))
        status = yield from self._until(_none_in(_ARMING))
        for report in _tripped_first(status.axes.values()):
            if report.axis.state is not State.HOLDING:
                raise _ended(report, status, f"{report.axis.name} is {report.axis.state}, and does not hold")
        return status

    def disarm(self) -> Verb[Status]:
        """Disarm, and wait until the drive is off."""
        yield from self._asked(_made(DisarmRequest, axis=self._axis))
        return (yield from self.settled())

    def stop(self, *, quick: bool = False, wait: bool = False) -> Verb[Status]:
        """Stop, and wait until the axis is at rest, or not."""
        begun = yield from self._asked(_made(StopRequest, axis=self._axis, quick=quick))
        return (yield from self.settled()) if wait else begun

    def settled(self) -> Verb[Status]:
        """Wait until no axis brakes, and each drive that is told to disable is seen to be off."""
        return (yield from self._until(_none_in(BRAKING)))

    def reset(self) -> Verb[Status]:
        """Clear a trip, and wait until the drive is seen to be off."""
        yield from self._asked(_made(ResetRequest, axis=self._axis))
        return (yield from self._until(_none_in(frozenset())))

    def forget(self) -> Verb[Status]:
        """Let the law forget what it has learned of its plant."""
        return (yield from self._asked(_made(ForgetRequest, axis=self._axis)))

    def acquire(self, *, preempt: bool) -> Verb[Status]:
        """Acquire control authority."""
        return (yield from self._asked(PreemptRequest() if preempt else AcquireRequest()))

    def release(self, patience_s: float | None = None) -> Verb[Status]:
        """Give it back."""
        return (yield from self._asked(ReleaseRequest(), patience_s))

    def reload(self) -> Verb[Status]:
        """Let the service read its configuration again."""
        return (yield from self._asked(ReloadRequest(), LONGEST_RELOAD_S))

    # Motion ----------------------------------------------------------------------------------------------------------

    def move(
        self,
        position: float | Mapping[str, float],
        velocity: float | None,
        *,
        wait: bool,
        timeout_s: float | None,
        progress: Progress | None,
    ) -> Verb[Status]:
        """Move to a set-point, or to one for each of several axes."""
        fields = {"positions": dict(position)} if isinstance(position, Mapping) else {"position": position}
        request = _made(MoveRequest, axis=self._axis, velocity=velocity, **fields)
        return (yield from self._moved(request, wait, timeout_s, progress))

    def move_by(
        self, distance: float, velocity: float | None, *, wait: bool, timeout_s: float | None, progress: Progress | None
    ) -> Verb[Status]:
        """Move to a set-point relative to the one in force."""
        request = _made(MoveRequest, axis=self._axis, by=distance, velocity=velocity)
        return (yield from self._moved(request, wait, timeout_s, progress))

    def _moved(
        self, request: MoveRequest, wait: bool, timeout_s: float | None, progress: Progress | None
    ) -> Verb[Status]:
        begun = yield from self._asked(request)
        if not wait:
            return begun
        return (yield from self._reached(begun, list(request.positions or begun.axes), timeout_s, progress))

    def override(self, percent: float) -> Verb[Status]:
        """Move at a percentage of the speed that is asked for."""
        return (yield from self._asked(_made(OverrideRequest, axis=self._axis, percent=percent)))

    def home(self, position: float | None, *, timeout_s: float | None, progress: Progress | None) -> Verb[Status]:
        """Look for the reference and wait until it is found; with a position, say where the axis stands."""
        begun = yield from self._asked(_made(HomeRequest, axis=self._axis, position=position))
        if all(report.axis.state is not State.HOMING for report in begun.axes.values()):
            return begun
        return (yield from self._reached(begun, list(begun.axes), timeout_s, progress))

    def wait_until_reached(self, *, timeout_s: float | None, progress: Progress | None) -> Verb[Status]:
        """Wait until the motion that is under way has reached its end."""
        status = yield from self.status()
        names = [name for name, report in status.axes.items() if report.move is not None]
        return (yield from self._reached(status, names, timeout_s, progress))

    def _reached(
        self, begun: Status, names: list[str], timeout_s: float | None, progress: Progress | None
    ) -> Verb[Status]:
        numbers = {name: _number_of(begun.axes[name]) for name in names}
        end_s = math.inf if timeout_s is None else self._clock() + timeout_s

        def is_over(status: Status) -> bool:
            if progress is not None:
                progress(status)
            reports = [status.axes[name] for name in names]
            for report in reports:
                if _number_of(report) != numbers[report.axis.name]:
                    text = f"another set-point has replaced this one on {report.axis.name}"
                    raise Interrupted(MoveOutcome.REPLACED, text, status)
            if all(_outcome_of(report) is not MoveOutcome.MOVING for report in reports):
                return True
            if self._clock() >= end_s:
                raise TimedOut(f"the motion has not ended within {timeout_s:g} s; the axis continues", status)
            return False

        status: Status = yield Until(_made(WatchRequest, axis=self._axis, every=_PROGRESS_TICKS), is_over)
        for report in _tripped_first(status.axes[name] for name in names):
            if report.move is not None and report.move.outcome is not MoveOutcome.REACHED:
                raise _ended(report, status)
        return status

    def jog(self, velocity: float, seconds: float, progress: Progress | None) -> Verb[Status]:
        """Jog for a time, or until the limit is reached, and wait until the axis is at rest."""
        status = yield from self._asked(_made(JogRequest, axis=self._axis, velocity=velocity))
        number, is_over = _number_of(status.only), False
        end_s = self._clock() + seconds
        while is_jogging(status, number):
            if progress is not None:
                progress(status)
            left_s = end_s - self._clock()
            if is_over := left_s <= 0.0:
                break
            yield Pause(min(JOG_INTERVAL_S, left_s))
            status = yield from self.jog_again(velocity, number)
        return (yield from self.end_jog(status, number, is_over=is_over))

    def begin_jog(self, velocity: float) -> Verb[Status]:
        """Jog."""
        return (yield from self._asked(_made(JogRequest, axis=self._axis, velocity=velocity)))

    def jog_again(self, velocity: float, number: int | None) -> Verb[Status]:
        """Look before asking again: a jog that a limit or another client has ended is not begun anew."""
        status = yield from self.status()
        if status.axis.state is State.JOGGING and is_jogging(status, number):
            try:
                status = yield from self._asked(_made(JogRequest, axis=self._axis, velocity=velocity))
            except Refused as error:
                if error.code is not RefusalCode.STOPPED:  # by somebody else, as the next status shows
                    raise
        return status

    def end_jog(self, status: Status, number: int | None, *, is_over: bool) -> Verb[Status]:
        """Bring a jog to rest; raise what has ended it before its time."""
        if status.axis.state is State.JOGGING and _number_of(status.only) == number:
            yield from self.stop()
        rest = yield from self.settled()
        reached = _number_of(status.only) == number and _outcome_of(status.only) is MoveOutcome.REACHED
        if not (is_over or reached):
            raise _ended(rest.only, rest)
        return rest


def is_jogging(status: Status, number: int | None) -> bool:
    """Whether the motion of a number is under way: another one, or arming anew, ends it."""
    return _number_of(status.only) == number and _outcome_of(status.only) is MoveOutcome.MOVING


def number_of(status: Status) -> int | None:
    """Return the number of the latest motion of the only axis."""
    return _number_of(status.only)


def _number_of(report: AxisReport) -> int | None:
    return None if report.move is None else report.move.number


def _outcome_of(report: AxisReport) -> MoveOutcome | None:
    return None if report.move is None else report.move.outcome


def _tripped_first(reports: Iterable[AxisReport]) -> list[AxisReport]:
    """Return the same, those first that have tripped: by them the others were stopped."""
    return sorted(reports, key=lambda report: report.trip is None)


def _none_in(states: frozenset[State]) -> Callable[[Status], bool]:
    """Return whether no axis is in one of these states, and no drive still has to report that it is off."""
    return lambda status: (
        not any(report.axis.state in states or report.drive.disabling for report in status.axes.values())
    )


def _ended(report: AxisReport, status: Status, text: str = "") -> ServoError:
    """Return why a motion has ended before its time."""
    if report.trip is not None:
        return Tripped(report.axis.name, report.trip, status)
    outcome = MoveOutcome.STOPPED if text else _outcome_of(report) or MoveOutcome.STOPPED
    why = f": {report.move.reason}" if report.move is not None and report.move.reason else ""
    return Interrupted(outcome, text or f"the motion of {report.axis.name} was {outcome} before its end{why}", status)


R = TypeVar("R", bound=Request)


def _made(kind: Callable[..., R], **fields: object) -> R:
    """Return a request of what the caller has given."""
    try:
        return kind(**fields)
    except BadRequestError as error:
        raise Refused(RefusalCode.BAD_REQUEST, str(error)) from error
