"""The asynchronous client: each verb ends when what it asks for is done, and other tasks run meanwhile."""

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator, AsyncIterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from twostage_servo.api.address import find_socket
from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import Request, WatchRequest
from twostage_servo.api.status import Recording, Status
from twostage_servo.client.async_connection import AsyncConnection
from twostage_servo.client.errors import ServoError
from twostage_servo.client.protocol import Authority, status_in
from twostage_servo.client.steps import Ask, Pause, Reconnect, Step, Until, Verb
from twostage_servo.client.verbs import JOG_INTERVAL_S, PARTING_S, Progress, Verbs, is_jogging, number_of

T = TypeVar("T")


class AsyncServoClient:
    """A client of one service, for one axis or for all of them; see :func:`twostage_servo.connect_async`.

    It does what :class:`~twostage_servo.client.blocking.ServoClient` does, under the same names. Several tasks may use
    it: one watches while another one moves the axis.

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
        self._timeout_s = timeout_s
        self._authority = Authority()
        self._verbs = Verbs(axis, timeout_s, self._read, lambda: asyncio.get_running_loop().time())
        self._connection = AsyncConnection(path, timeout_s)

    async def __aenter__(self) -> Self:
        await self._connection.open(self._timeout_s)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if error is not None and self._authority.is_held:
                with contextlib.suppress(ServoError):
                    await self._run(self._verbs.stop())
        finally:
            await self.close()

    async def close(self) -> None:
        """Release control authority and disconnect; motions under way continue."""
        try:
            if self._authority.asked_for:
                with contextlib.suppress(ServoError):
                    await self._run(self._verbs.release(PARTING_S))
        finally:
            self._connection.close()

    async def status(self) -> Status:
        """Return the state of the service and its axes."""
        return await self._run(self._verbs.status())

    def watch(self, every: int = 10) -> AsyncGenerator[Status, None]:
        """Yield a status every so many ticks, over a separate connection, until the generator is closed."""
        return self._snapshots(self._verbs.watch(every))

    async def _snapshots(self, watch: WatchRequest) -> AsyncGenerator[Status, None]:
        connection = AsyncConnection(self._connection.path, self._timeout_s)
        await connection.open(self._timeout_s)
        try:
            async with contextlib.aclosing(connection.snapshots(watch)) as snapshots:
                async for status in snapshots:
                    self._authority.record_holder(status)
                    yield status
        finally:
            connection.close()

    async def recording(self) -> Recording:
        """Return the last 2 s of ticks, or those before the trip."""
        return await self._run(self._verbs.recording())

    async def acquire(self, *, preempt: bool = False) -> Status:
        """Acquire free control authority; with `preempt` also take it from its holder while the axis is at rest."""
        return await self._run(self._verbs.acquire(preempt=preempt))

    async def release(self) -> Status:
        """Release control authority; motions under way continue."""
        return await self._run(self._verbs.release())

    async def arm(self) -> Status:
        """Enable the drive; return when the axis holds."""
        return await self._run(self._verbs.arm())

    async def disarm(self) -> Status:
        """Bring the axis to rest and disable the drive; return when the drive reports that it is disabled."""
        return await self._run(self._verbs.disarm())

    async def stop(self, *, quick: bool = False, wait: bool = True) -> Status:
        """Bring the axis to rest, whoever commands it; with `quick` with the quick stop deceleration.

        It returns at rest, or with `wait=False` as soon as the service has heard it.
        """
        return await self._run(self._verbs.stop(quick=quick, wait=wait))

    async def reset(self) -> Status:
        """Clear a trip; the axis is disarmed afterwards."""
        return await self._run(self._verbs.reset())

    async def forget(self) -> Status:
        """Make the law forget what it has learned of its plant, while the axis is at rest."""
        return await self._run(self._verbs.forget())

    async def reload(self) -> Status:
        """Make the service read its configuration again, while the axis is disarmed."""
        return await self._run(self._verbs.reload())

    async def move(
        self,
        position: float | Mapping[str, float],
        velocity: float | None = None,
        *,
        wait: bool = False,
        timeout: float | None = None,  # noqa: ASYNC109 - the motion goes on after it
        progress: Progress | None = None,
    ) -> Status:
        """Move to a set-point, as :meth:`ServoClient.move` does."""
        return await self._run(self._verbs.move(position, velocity, wait=wait, timeout_s=timeout, progress=progress))

    async def move_by(
        self,
        distance: float,
        velocity: float | None = None,
        *,
        wait: bool = False,
        timeout: float | None = None,  # noqa: ASYNC109 - likewise
        progress: Progress | None = None,
    ) -> Status:
        """Move relative to the set-point in force; see :meth:`move`."""
        return await self._run(self._verbs.move_by(distance, velocity, wait=wait, timeout_s=timeout, progress=progress))

    async def override(self, percent: float) -> Status:
        """See :meth:`.ServoClient.override`."""
        return await self._run(self._verbs.override(percent))

    async def home(
        self,
        position: float | None = None,
        *,
        timeout: float | None = None,  # noqa: ASYNC109 - likewise
        progress: Progress | None = None,
    ) -> Status:
        """Search for the reference and return when it is found; with a position, declare the present one instead."""
        return await self._run(self._verbs.home(position, timeout_s=timeout, progress=progress))

    async def wait_until_reached(
        self,
        timeout: float | None = None,  # noqa: ASYNC109 - likewise
        *,
        progress: Progress | None = None,
    ) -> Status:
        """Return when the motion under way has ended."""
        return await self._run(self._verbs.wait_until_reached(timeout_s=timeout, progress=progress))

    async def wait_until_settled(self) -> Status:
        """Return when no axis brakes and each drive that was told to disable reports that it is disabled."""
        return await self._run(self._verbs.settled())

    async def jog(self, velocity: float, seconds: float = math.inf, *, progress: Progress | None = None) -> Status:
        """Move at a velocity for a time, or to the limit; return at rest."""
        return await self._run(self._verbs.jog(velocity, seconds, progress))

    @contextlib.asynccontextmanager
    async def jogging(self, velocity: float) -> AsyncIterator[None]:
        """Move at a velocity for as long as the block lasts; leaving it brings the axis to rest.

        The jog is asked for again by a task. What ends it before its time is raised as the block ends.
        """
        status = await self._run(self._verbs.begin_jog(velocity))
        number, shall_end = number_of(status), asyncio.Event()
        jog = asyncio.create_task(self._keep_jogging(status, velocity, shall_end))
        try:
            yield
        except BaseException:
            shall_end.set()
            with contextlib.suppress(ServoError):
                await jog
                await self._run(self._verbs.stop())
            raise
        shall_end.set()
        status = await jog
        await self._run(self._verbs.end_jog(status, number, is_over=is_jogging(status, number)))

    async def _keep_jogging(self, status: Status, velocity: float, shall_end: asyncio.Event) -> Status:
        number = number_of(status)
        while is_jogging(status, number) and not shall_end.is_set():
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(JOG_INTERVAL_S):
                    await shall_end.wait()
            if not shall_end.is_set():
                status = await self._run(self._verbs.jog_again(velocity, number))
        return status

    # Steps -----------------------------------------------------------------------------------------------------------

    def _read(self, request: Request, answer: JsonObject) -> Status:
        status = status_in(answer, self._connection.path)
        self._authority.record_answer(request, status)
        return status

    async def _run(self, verb: Verb[T]) -> T:
        """Carry out the steps of a verb, and return what it comes to."""
        try:
            step = next(verb)
            while True:
                try:
                    came = await self._carry_out(step)
                except BaseException as error:  # noqa: BLE001 - the verb decides
                    step = verb.throw(error)
                else:
                    step = verb.send(came)
        except StopIteration as end:
            result: T = end.value
            return result

    async def _carry_out(self, step: Step) -> object:
        match step:
            case Ask(request, patience_s):
                self._authority.record_request(request)
                return await self._connection.ask(request, patience_s)
            case Until(watch, condition):
                async with contextlib.aclosing(self._snapshots(watch)) as snapshots:
                    async for status in snapshots:
                        if condition(status):
                            return status
            case Reconnect(within_s):
                await self._connection.reconnect(within_s)
            case Pause(seconds):
                await asyncio.sleep(seconds)
        return None


@contextlib.asynccontextmanager
async def connect_async(
    socket: Path | str | None = None, axis: str | None = None, *, timeout_s: float = 5.0
) -> AsyncIterator[AsyncServoClient]:
    """Connect to a running service; see :func:`twostage_servo.connect`.

    Use it as ``async with twostage_servo.connect_async() as axis:``.
    """
    async with AsyncServoClient(find_socket() if socket is None else Path(socket), axis, timeout_s) as client:
        yield client
