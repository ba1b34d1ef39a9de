"""What keeps a service, or a simulated drive, from starting, though its configuration is valid."""

import contextlib
from collections.abc import Iterator

from twostage_servo.portable_error import PortableError


class StartError(PortableError):
    """Ends the start, with a text for the operator.

    Attributes
    ----------
    code
        A stable name of the reason.
    is_usage
        Whether another configuration would help; else the machine is at fault.
    """

    def __init__(self, code: str, message: str, *, is_usage: bool) -> None:
        super().__init__(message)
        self.code = code
        self.is_usage = is_usage


@contextlib.contextmanager
def threads() -> Iterator[None]:
    """Say what to do where the system has no thread left.

    Raises
    ------
    StartError
        In place of the RuntimeError of a thread that cannot be started.
    """
    try:
        yield
    except RuntimeError as error:
        text = f"the service cannot start: {error}. Find what uses up threads or memory (`ulimit -u`, TasksMax=)"
        raise StartError("no_thread", text, is_usage=False) from error
