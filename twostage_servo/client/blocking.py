"""The blocking client: each verb returns when what it asks for is done."""

import contextlib
import math
import time
from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from twostage_servo.api.address import find_socket
from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import Request, WatchRequest
from twostage_servo.api.status import Recording, Status
from twostage_servo.client.connection import Connection
from twostage_servo.client.errors import ServoError
from twostage_servo.client.protocol import Authority, status_in
from twostage_servo.client.steps import Ask, Pause, Reconnect, Step, Until, Verb
from twostage_servo.client.verbs import PARTING_S, Progress, Verbs, is_jogging, number_of

T = TypeVar("T")


def connect(socket: Path | str | None = None, axis: str | None = None, *, timeout_s: float = 5.0) -> "ServoClient":
    """Connect to a running service.

    Use it as a context manager: leaving the block gives control authority back, and an exception in it stops the axis
    before that, if this client has it.

    Parameters
    ----------
    socket
        Path of the control socket; by default where the operator's commands look: ``$TWOSTAGE_SERVO_SOCKET``, the
        user's own service, the system's.
    axis
        Name of the axis that is meant, where the service has several. Without it `arm`, `disarm`, `stop` and `reset`
        concern all of them.
    timeout_s
        Longest wait for the connection, and for an answer; how long a motion may take has nothing to do with it.

    Raises
    ------
    ServoError
        If no service answers there, or who does is not to be trusted.
    """
    return ServoClient(find_socket() if socket is None else Path(socket), axis, timeout_s)


class ServoClient:
    """A client of one service, for one axis or for all of them; see :func:`connect`.

    The first command takes control authority, which one client holds at a time; while another one has it, commands
    raise :class:`Refused`. All methods raise :class:`ServoError`.

    Parameters
    ----------
    path
        Path of the control socket.
    axis
        Name of the axis, or None.
    timeout_s
        Longest wait for the connection, and for an answer.
    """

    def __init__(self, path: Path, axis: str | None, timeout_s: float) -> None:
        self._axis = axis
        self._timeout_s = timeout_s
        self._authority = Authority()
        self._verbs = Verbs(axis, timeout_s, self._read, time.monotonic)
        self._connection = Connection(path, timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if error is not None and self._authority.is_held:
                with contextlib.suppress(ServoError):
                    self._run(self._verbs.stop())
        finally:
            self.close()

    def close(self) -> None:
        """Release control authority and disconnect; motions under way continue."""
        try:
            if self._authority.asked_for:
                with contextlib.suppress(ServoError):
                    self._run(self._verbs.release(PARTING_S))
        finally:
            self._connection.close()

    @property
    def reconnected(self) -> int:
        """How often a `stop` or a `disarm` was asked for again, over a connection anew."""
        return self._connection.reconnected

    # Looking ---------------------------------------------------------------------------------------------------------

    def status(self) -> Status:
        """Return the state of the service and its axes."""
        return self._run(self._verbs.status())

    def watch(self, every: int = 10) -> Generator[Status, None, None]:
        """Yield a status every so many ticks, over a separate connection, until the iterator is closed."""
        return self._snapshots(self._verbs.watch(every))

    def _snapshots(self, watch: WatchRequest) -> Generator[Status, None, None]:
        connection = Connection(self._connection.path, self._timeout_s)
        try:
            for status in connection.snapshots(watch):
                self._authority.record_holder(status)
                yield status
        finally:
            connection.close()

    def recording(self) -> Recording:
        """Return the last 2 s of ticks, or those before the trip."""
        return self._run(self._verbs.recording())

    # Control authority -----------------------------------------------------------------------------------------------

    def acquire(self, *, preempt: bool = False) -> Status:
        """Acquire free control authority; with `preempt` also take it from its holder while the axis is at rest."""
        return self._run(self._verbs.acquire(preempt=preempt))

    def release(self) -> Status:
        """Release control authority; motions under way continue."""
        return self._run(self._verbs.release())

    # Commands --------------------------------------------------------------------------------------------------------

    def arm(self) -> Status:
        """Enable the drive; return when the axis holds."""
        return self._run(self._verbs.arm())

    def disarm(self) -> Status:
        """Bring the axis to rest and disable the drive; return when the drive reports that it is disabled."""
        return self._run(self._verbs.disarm())

    def stop(self, *, quick: bool = False, wait: bool = True) -> Status:
        """Bring the axis to rest, whoever commands it; with `quick` with the quick stop deceleration.

        It returns at rest, or with `wait=False` as soon as the service has heard it.
        """
        return self._run(self._verbs.stop(quick=quick, wait=wait))

    def reset(self) -> Status:
        """Clear a trip; the axis is disarmed afterwards."""
        return self._run(self._verbs.reset())

    def forget(self) -> Status:
        """Make the law forget what it has learned of its plant, while the axis is at rest."""
        return self._run(self._verbs.forget())

    def reload(self) -> Status:
        """Make the service read its configuration again, while the axis is disarmed."""
        return self._run(self._verbs.reload())

    def move(
        self,
        position: float | Mapping[str, float],
        velocity: float | None = None,
        *,
        wait: bool = False,
        timeout: float | None = None,
        progress: Progress | None = None,
    ) -> Status:
        """Move to a set-point; with a mapping, several axes by their names, which arrive together.

        Parameters
        ----------
        position
            Set-point in axis unit.
        velocity
            Cruise velocity in axis unit/s; by default that of the configuration.
        wait
            Whether to return only when it is reached.
        timeout
            How long that may take (s) before :class:`TimedOut` is raised; the motion goes on then, unless that ends the
            block.
        progress
            Is called with each status that is seen while waiting.
        """
        return self._run(self._verbs.move(position, velocity, wait=wait, timeout_s=timeout, progress=progress))

    def move_by(
        self,
        distance: float,
        velocity: float | None = None,
        *,
        wait: bool = False,
        timeout: float | None = None,
        progress: Progress | None = None,
    ) -> Status:
        """Move relative to the set-point in force; see :meth:`move`."""
        return self._run(self._verbs.move_by(distance, velocity, wait=wait, timeout_s=timeout, progress=progress))

    def override(self, percent: float) -> Status:
        """Move at a percentage of the speed that is asked for, from 0 to 200, now and until the axis is armed again.

        It never goes beyond the velocity limit. 0 brings the axis to rest, which keeps its set-point and goes on when
        the override rises. Without a name it concerns all axes that are armed.
        """
        return self._run(self._verbs.override(percent))

    def home(
        self, position: float | None = None, *, timeout: float | None = None, progress: Progress | None = None
    ) -> Status:
        """Search for the reference and return when it is found; with a position, declare the present one instead."""
        return self._run(self._verbs.home(position, timeout_s=timeout, progress=progress))

    def wait_until_reached(self, timeout: float | None = None, *, progress: Progress | None = None) -> Status:
        """Return when the motion under way has ended."""
        return self._run(self._verbs.wait_until_reached(timeout_s=timeout, progress=progress))

    def wait_until_settled(self) -> Status:
        """Return when no axis brakes and each drive that was told to disable reports that it is disabled."""
        return self._run(self._verbs.settled())

    def jog(self, velocity: float, seconds: float = math.inf, *, progress: Progress | None = None) -> Status:
        """Move at a velocity for a time, or to the limit; return at rest."""
        return self._run(self._verbs.jog(velocity, seconds, progress))

    @contextlib.contextmanager
    def jogging(self, velocity: float) -> Iterator[None]:
        """Move at a velocity for as long as the block lasts; leaving it brings the axis to rest.

        The jog is asked for again by a thread. What ends it before its time is raised as the block ends.
        """
        from twostage_servo.client.jog_thread import JogThread  # noqa: PLC0415 - few need a thread

        begun = self._run(self._verbs.begin_jog(velocity))
        number = number_of(begun)
        jog = JogThread(begun, lambda: self._run(self._verbs.jog_again(velocity, number)))
        try:
            yield
        except BaseException:
            with contextlib.suppress(ServoError):
                jog.end()
                self._run(self._verbs.stop())
            raise
        status = jog.end()
        self._run(self._verbs.end_jog(status, number, is_over=is_jogging(status, number)))

    # Steps -----------------------------------------------------------------------------------------------------------

    def _read(self, request: Request, answer: JsonObject) -> Status:
        status = status_in(answer, self._connection.path)
        self._authority.record_answer(request, status)
        return status

    def _run(self, verb: Verb[T]) -> T:
        """Carry out the steps of a verb, and return what it comes to."""
        try:
            step = next(verb)
            while True:
                try:
                    came = self._carry_out(step)
                except BaseException as error:  # noqa: BLE001 - the verb decides
                    step = verb.throw(error)
                else:
                    step = verb.send(came)
        except StopIteration as end:
            result: T = end.value
            return result

    def _carry_out(self, step: Step) -> object:
        match step:
            case Ask(request, patience_s):
                self._authority.record_request(request)
                return self._connection.ask(request, patience_s)
            case Until(watch, condition):
                with contextlib.closing(self._snapshots(watch)) as snapshots:
                    for status in snapshots:
                        if condition(status):
                            return status
            case Reconnect(within_s):
                self._connection.reconnect(within_s)
            case Pause(seconds):
                time.sleep(seconds)
        return None
