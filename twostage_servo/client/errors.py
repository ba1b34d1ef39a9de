"""What can go wrong between a client and the service."""

import enum

from twostage_servo.api.status import Status, TripStatus
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.refusals import RefusalCode


class ServoError(Exception):
    """Base of all errors that a client raises; the text is for the operator, ``code`` for a program.

    ::

        ServoError
        ├── Refused        the service refuses a request; `code` says why
        ├── Tripped        an axis has tripped; `axis` and `trip` say which and why, `status` how all are now
        ├── Interrupted    a motion has ended early: stopped, or replaced by another one
        ├── TimedOut       a motion has not ended within its time limit; it continues
        ├── Unreachable    no service answers, or its socket cannot be trusted
        └── ConfigError    the given path or configuration names no service
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class Refused(ServoError):  # noqa: N818 - it tells what has happened
    """A request was not carried out.

    Parameters
    ----------
    code
        Why, in a word that stays the same; a text where the service knows a refusal that this client does not.
    message
        The same for the operator, with what to do instead.
    """

    def __init__(self, code: RefusalCode | str, message: str) -> None:
        super().__init__(code, message)


class Tripped(ServoError):  # noqa: N818 - it tells what has happened
    """An axis has tripped; it stays so until `reset`.

    Parameters
    ----------
    axis
        Its name.
    trip
        What happened, and what to do next.
    status
        How the service is now, and each axis that was asked for.
    """

    def __init__(self, axis: str, trip: TripStatus, status: Status) -> None:
        of_several = f"axis {axis}: " if len(status.axes) > 1 else ""
        super().__init__(trip.code, f"{of_several}trip {trip.code}: {trip.cause} {trip.next_action}")
        self.axis = axis
        self.trip = trip
        self.status = status


class Interrupted(ServoError):  # noqa: N818 - it tells what has happened
    """A motion, or arming, has ended before its time.

    Parameters
    ----------
    outcome
        What has become of it.
    message
        The same for the operator.
    status
        How service and axis are now.
    """

    def __init__(self, outcome: MoveOutcome, message: str, status: Status) -> None:
        super().__init__(outcome, message)
        self.outcome = outcome
        self.status = status


class TimedOut(ServoError):  # noqa: N818 - it tells what has happened
    """A motion has not ended within the time that it was given; it goes on.

    Parameters
    ----------
    message
        What was waited for.
    status
        How service and axis are now.
    """

    def __init__(self, message: str, status: Status) -> None:
        super().__init__("timed_out", message)
        self.status = status


class Reason(enum.StrEnum):
    """Why no service can be asked."""

    NO_SERVICE = "unreachable"
    """Nobody answers at the socket."""
    UNTRUSTED = "untrusted_socket"
    """Who answers may be another user's program: nothing was sent."""
    NO_ANSWER = "no_answer"
    """The service does not answer in time."""
    LOST = "connection_lost"
    """The connection has ended."""
    UNREADABLE = "unreadable"
    """What it answers is not understood: it is of another version."""


class Unreachable(ServoError):  # noqa: N818 - it tells what has happened
    """No service answers, or none that is to be trusted."""

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(reason, message)


class ConfigError(ServoError):
    """What should name the service does not: a path that is no socket."""

    def __init__(self, message: str) -> None:
        super().__init__("usage", message)
